import pytest

from app.jobs.process import JobClock


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def clock(now):
    return JobClock(lambda: now[0])


def test_time_left_goes_by_what_was_done(clock, now):
    assert clock.left_s(0, 10) is None  # nothing to go by yet
    now[0] += 4
    assert clock.left_s(2, 10) == pytest.approx(16)


def test_pauses_do_not_count(clock, now):
    clock.left_s(0, 10)
    now[0] += 2
    clock.switch(is_running=False)
    now[0] += 1000
    clock.switch(is_running=True)
    now[0] += 2
    assert clock.left_s(2, 10) == pytest.approx(16)


def test_time_before_the_total_is_known_tells_nothing_of_the_rest(clock, now):
    assert clock.left_s(0, 0) is None
    now[0] += 600
    assert clock.left_s(0, 10) is None
    now[0] += 3
    assert clock.left_s(1, 10) == pytest.approx(27)
