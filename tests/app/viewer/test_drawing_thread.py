"""The thread that draws: nothing that was noted stays undrawn, and nothing is drawn more often than asked for."""

import threading
import time

import pytest

from app.viewer.drawing_thread import DrawingThread
from tests.app.conftest import until


class Counted:
    """A thread that counts its drawings, and what had been noted when each began."""

    def __init__(self, interval_s=0.0, draw=lambda: None):
        self.noted, self.drawn, self.at = 0, [], []
        self._also = draw
        self.thread = DrawingThread("counted", self._draw, interval_s)

    def _draw(self):
        with self.thread.changed:
            self.drawn.append(self.noted)
        self.at.append(time.monotonic())
        self._also()

    def note(self, after_s=0.0):
        with self.thread.changed:
            self.noted += 1
            self.thread.wake(after_s)


@pytest.fixture
def make():
    made = []

    def make(*args, **kwargs):
        made.append(Counted(*args, **kwargs))
        made[-1].thread.start()
        return made[-1]

    yield make
    for counted in made:
        counted.thread.stop()


def test_nothing_is_drawn_before_something_is_noted(make):
    counted = make()
    assert counted.thread.is_idle
    time.sleep(0.05)
    assert counted.drawn == []


def test_what_is_noted_while_it_draws_is_drawn_afterwards(make):
    begun, go_on = threading.Event(), threading.Event()

    def wait():
        begun.set()
        go_on.wait(5)

    counted = make(draw=wait)
    counted.note()
    assert begun.wait(5)
    counted.note()
    counted.note()
    assert not counted.thread.is_idle
    go_on.set()
    until(lambda: counted.thread.is_idle)
    assert counted.drawn == [1, 3]


def test_many_notes_are_drawn_no_more_often_than_asked_for_and_the_last_one_is(make):
    counted = make(interval_s=0.05)
    for _ in range(60):
        counted.note()
        time.sleep(0.003)
    until(lambda: counted.thread.is_idle)
    assert counted.drawn[-1] == 60
    assert all(after - before >= 0.045 for before, after in zip(counted.at, counted.at[1:], strict=False))


def test_it_can_be_woken_later_and_sooner_than_that(make):
    counted = make()
    start = time.monotonic()
    counted.note(after_s=1.0)
    assert counted.thread.is_idle  # nothing is due yet
    until(lambda: counted.drawn)
    assert counted.at[0] - start >= 0.995
    counted.note(after_s=1000)
    counted.note()
    until(lambda: counted.drawn == [1, 3])


def test_a_defect_is_logged_and_what_is_noted_next_is_drawn(make, caplog):
    counted = make(draw=lambda: 1 / 0)
    counted.note()
    until(lambda: counted.thread.is_idle)
    counted.note()
    until(lambda: counted.thread.is_idle)
    assert counted.drawn == [1, 2]
    assert "counted could not draw" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_after_it_was_stopped_nothing_is_drawn(make):
    counted = make(interval_s=10)
    counted.note()
    until(lambda: counted.thread.is_idle)
    counted.note()
    counted.thread.stop()  # at once, although the next drawing is due much later
    counted.thread.stop()
    counted.note()
    assert counted.drawn == [1]


def test_one_that_never_began_can_be_stopped():
    DrawingThread("never", lambda: None).stop()
