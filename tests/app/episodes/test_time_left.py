import numpy as np
import pytest

from app.episodes.progress import TimeLeft
from osfcore.control.events import ActionExecuted, Finished, Looking, Stepped
from osfcore.estimation.steps import EstimateStep
from osfcore.progress import Progress

MOST = 40


class Course:
    """Events at known times, and what was said of them."""

    def __init__(self):
        self.now = 100.0
        self.timer = TimeLeft(lambda: self.now)
        self.said = []

    def take(self, event, after_s=0.0):
        self.now += after_s
        self.said.append(self.timer.take(event, MOST))
        return self.said[-1]


def look(done, total, which="first"):
    return Looking(0, which, EstimateStep(Progress(done, total, ""), "search", None))


def stepped(number, off_m):
    return Stepped(number, MOST, None, np.array([off_m, 0.0]), np.zeros(2), 0.0, np.zeros((1, 1, 3)), {})


def pushed(course, count, each_s, first_m, gain_m):
    course.take(stepped(0, first_m))
    for number in range(1, count + 1):
        course.take(ActionExecuted(number, np.zeros(3)), each_s)
        course.take(stepped(number, first_m - gain_m * number))


def test_a_look_of_any_length_is_known_better_the_longer_it_lasts():
    for whole_s in (10.0, 120.0):
        course = Course()
        errors = []
        for done in range(11):
            share = done / 10
            _, left = course.take(look(done, 10), whole_s / 10 if done else 0.0)
            errors.append((1 - share) * whole_s - left)  # all but what comes after the look
        after = errors[-1]
        errors = np.abs(np.array(errors) - after)
        assert np.all(np.diff(errors) <= 1e-9)
        assert errors[5] < errors[0] / 3


@pytest.mark.parametrize("each_s", [1.0, 7.0])
def test_pushes_at_a_constant_rate_end_about_when_it_is_said(each_s):
    course = Course()
    pushed(course, 15, each_s, 0.2, 0.01)
    _, left = course.said[-1]
    assert 5 * each_s <= left < 15 * each_s  # as many as are needed, or some more, as usual


def test_there_are_never_more_pushes_than_allowed():
    course = Course()
    pushed(course, MOST - 1, 2.0, 0.2, 1e-6)
    assert course.said[-1][1] == pytest.approx(2.0, abs=0.1)


def test_what_is_left_does_not_jump_when_nothing_seems_to_get_nearer_or_all_at_once():
    course = Course()
    pushed(course, 5, 1.0, 0.2, 0.0)
    for number, off_m in enumerate((0.199, 0.1, 0.03, 0.02, 0.2, 0.19), start=6):
        course.take(ActionExecuted(number, np.zeros(3)), 1.0)
        course.take(stepped(number, off_m))
    left = [one for _, one in course.said[::2]]
    assert max(np.diff(left)) < 1.01  # a second has passed between them
    assert min(np.diff(left)) > -0.3 * max(left)


def test_the_share_never_falls_and_ends_at_one():
    course = Course()
    course.take(look(1, 4), 5.0)
    pushed(course, 20, 3.0, 0.2, 0.004)
    course.take(stepped(20, 0.25))  # somebody moved an object
    share, left = course.take(Finished(20, "reached", "Done.", None))
    shares = [share for share, _ in course.said]
    assert shares == sorted(shares)
    assert (share, left) == (1.0, 0.0)


def test_a_pause_does_not_count():
    course, paused = Course(), Course()
    for one in (course, paused):
        pushed(one, 6, 2.0, 0.2, 0.01)
    paused.now += 500.0
    paused.timer.go_on()
    assert course.take(stepped(6, 0.14), 1.0) == paused.take(stepped(6, 0.14), 1.0)


def test_who_does_not_look_for_goal_poses_needs_no_time_for_it():
    with_goal, without = (TimeLeft(lambda: 0.0, finds).take(look(0, 10), MOST)[1] for finds in (True, False))
    assert without < with_goal


def test_where_distances_are_not_known_all_pushes_are_still_to_come():
    course = Course()
    unknown = np.zeros(0)
    for number in range(31):
        course.take(Stepped(number, MOST, None, unknown, unknown, 0.0, np.zeros((1, 1, 3)), {}), 3.0)
        _, left = course.take(ActionExecuted(number + 1, unknown))
    assert left == pytest.approx(3.0 * (MOST - 31), abs=4.0)
