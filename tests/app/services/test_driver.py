import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.services.driver import Driver, DriverChanged
from tests.app.conftest import until


def test_the_first_page_drives_and_all_are_told():
    told = []
    driver = Driver(told.append)
    assert driver.now() == DriverChanged(None, 0)
    driver.arrive("a")
    driver.arrive("b")
    assert told == [DriverChanged("a", 1), DriverChanged("a", 2)]


def test_whoever_came_next_drives_when_the_driver_leaves():
    driver = Driver(lambda _: None)
    for page in "abc":
        driver.arrive(page)
    driver.leave("a")
    assert driver.now() == DriverChanged("b", 2)
    driver.leave("c")
    assert driver.now() == DriverChanged("b", 1)
    driver.leave("b")
    assert driver.now() == DriverChanged(None, 0)


def test_a_page_that_reconnects_keeps_the_wheel():
    driver = Driver(lambda _: None)
    for page in ("a", "b", "a"):
        driver.arrive(page)
    assert driver.now().visitors == 2
    driver.leave("a")
    assert driver.now() == DriverChanged("a", 2)


@pytest.mark.slow
def test_a_driver_whose_page_loads_again_keeps_the_wheel_and_one_who_left_does_not():
    driver = Driver(lambda _: None, grace_s=2.0)
    for page in "ab":
        driver.arrive(page)
    driver.leave("a")
    assert driver.now() == DriverChanged("a", 1)
    driver.arrive("a")
    time.sleep(2.5)
    assert driver.now() == DriverChanged("a", 2)
    driver.leave("a")
    until(lambda: driver.now() == DriverChanged("b", 1))


def test_whoever_does_not_drive_may_not_and_programs_always_may():
    driver = Driver(lambda _: None)
    assert driver.may_drive("a")
    for page in "ab":
        driver.arrive(page)
    assert [driver.may_drive(who) for who in ("a", "b", None)] == [True, False, True]


def test_anybody_may_take_over():
    told = []
    driver = Driver(told.append)
    driver.arrive("a")
    driver.arrive("b")
    assert driver.take("b") == DriverChanged("b", 2) == told[-1]


def test_who_took_over_and_has_no_page_open_does_not_drive_for_ever():
    driver = Driver(lambda _: None)
    driver.arrive("a")
    driver.take("nobody")
    driver.leave("a")
    assert driver.now() == DriverChanged(None, 0)
    driver.take("nobody")
    driver.arrive("b")
    assert driver.now() == DriverChanged("b", 1)


@given(moves=st.lists(st.tuples(st.sampled_from(["arrive", "leave", "take"]), st.sampled_from("abc")), max_size=40))
def test_somebody_drives_exactly_while_pages_are_open(moves):
    told, open_pages = [], []
    driver = Driver(told.append)
    for what, page in moves:
        if what == "leave" and page not in open_pages:
            continue
        if what == "take" and page not in open_pages:
            continue
        getattr(driver, what)(page)
        if what == "arrive":
            open_pages.append(page)
        elif what == "leave":
            open_pages.remove(page)
        now = driver.now()
        assert now == told[-1]
        assert now.visitors == len(set(open_pages))
        assert now.driver in (open_pages or [None])


def test_who_comes_alone_need_not_wait_for_a_driver_who_left():
    driver = Driver(lambda _: None, grace_s=60.0)
    driver.arrive("a")
    driver.leave("a")
    assert driver.may_drive("b"), "its stream may open a moment later"
    driver.arrive("c")
    assert [driver.may_drive(who) for who in "ac"] == [False, True]
