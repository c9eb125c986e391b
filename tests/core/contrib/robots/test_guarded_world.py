import contextlib
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from osfcore.contrib.robots.guarded_world import GuardedWorld, OutlinedWorld
from osfcore.contrib.robots.robot import ConnectionLost, RobotStopped, SafetyLimits
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S
from tests.support.errors import about
from tests.support.robots import NAMES, simulated

BOX = (-0.1, -0.05, 0.12, 0.2)
LIMITS = SafetyLimits(BOX, 0.1)
RIGHT = np.array([0.3, 0.0, 0.0])
velocities = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)).map(lambda v: np.array([*v, 0.0]))
shares = st.floats(0.0, 1.0)


class Marble:
    """A pusher alone: does such shares of its motions, the last one first, and all of those after them.

    It says where it is, or, if it is `blind`, where it began.
    """

    def __init__(self, place=(0.0, 0.0), shares=(), fails=(), *, blind=False):
        self.place, self.shares, self.fails, self.blind = np.array(place, float), list(shares), dict(fails), blind
        self.way, self.velocities, self.calls = [self.place.copy()], [], []

    def reset(self, seed):
        return self.observe()

    def observe(self, *, masks=False):
        self._fail("observe")
        place = self.way[0] if self.blind else self.place
        return Observation((), np.zeros((0, 1, 1, 3), np.float32), (), None, np.array([*place, 0.06]), 0.0)

    def act(self, action):
        self._fail("act")
        share = self.shares.pop() if self.shares else 1.0
        self.velocities.append(np.array(action))
        self.place = self.place + share * STEP_S * action[:2]
        self.way.append(self.place.copy())

    def start(self):
        self.calls.append("start")

    def stop(self):
        self.calls.append("stop")
        self._fail("stop")

    def close(self):
        self.calls.append("close")

    def _fail(self, what):
        if what in self.fails:
            raise self.fails[what]


def guarded(world, limits=LIMITS, **more):
    guard = GuardedWorld(world, limits, **more)
    guard.observe()
    return guard


def move_and_look(guard, *actions):
    for action in actions:
        guard.act(action)
        guard.observe()


@settings(suppress_health_check=[HealthCheck.too_slow])  # on a busy machine drawing takes its time
@given(
    st.lists(st.tuples(velocities, st.booleans()), max_size=12),
    st.lists(shares, max_size=40),
    st.tuples(st.floats(BOX[0], BOX[2]), st.floats(BOX[1], BOX[3])),
    st.floats(0.02, 0.42),
    st.booleans(),
)
def test_no_actions_lead_out_of_the_box_or_go_too_fast_whatever_holds_the_pusher(actions, done, begin, speed, blind):
    world = Marble(begin, done, blind=blind)
    guard = guarded(world, SafetyLimits(BOX, speed))
    with contextlib.suppress(RobotStopped):  # one that seems to stand still for long
        for action, looks in actions:
            guard.act(action)
            if looks:
                guard.observe()
    way = np.array(world.way)
    assert np.all(way >= np.array(BOX[:2]) - 1e-9)
    assert np.all(way <= np.array(BOX[2:]) + 1e-9)
    assert all(np.linalg.norm(velocity) <= speed + 1e-9 for velocity in world.velocities)


@given(velocities)
def test_a_slow_robot_goes_the_same_way(action):
    world = Marble()
    guard = guarded(world, SafetyLimits(top_speed_m_s=0.05))
    guard.act(action)
    np.testing.assert_allclose(world.place, STEP_S * action[:2], atol=1e-12)
    assert guard.held_back == ()


def test_a_way_ends_at_the_wall_and_goes_on_along_it_and_that_is_kept():
    world = Marble((0.1, 0.0))
    guard = guarded(world)
    guard.act(np.array([0.3, 0.3, 0.0]))
    np.testing.assert_allclose(world.place, [0.12, 0.06], atol=1e-9)
    (one,) = guard.held_back
    np.testing.assert_allclose(one.done, [0.1, 0.3, 0.0], atol=1e-9)


def test_a_pusher_slightly_outside_returns_and_one_far_outside_is_not_moved():
    near = Marble((0.125, 0.0))
    guard = guarded(near)
    guard.act(RIGHT)
    np.testing.assert_allclose(near.place, [0.125, 0.0], atol=1e-12)
    guard.act(-RIGHT)
    assert near.place[0] < 0.12
    far = Marble((0.3, 0.0))
    with pytest.raises(InvalidInput, check=about("position of the pusher")):
        guarded(far).act(-RIGHT)
    assert far.velocities == far.calls == []


def test_a_pusher_that_always_says_the_same_place_is_stopped_before_it_is_asked_to_go_far():
    for begin in (0.0, -0.02, -0.08):
        world = Marble((begin, 0.0), blind=True)
        guard = guarded(world)
        with pytest.raises(RobotStopped, check=about("hardly moved")):
            move_and_look(guard, *[-RIGHT] * 10)
        assert world.calls == ["start", "stop"]
        assert BOX[0] - 1e-9 <= world.place[0] < -0.05


def test_a_reset_of_a_robot_proves_no_place():
    world = Marble(blind=True)
    guard = guarded(world)
    guard.act(RIGHT)
    guard.reset(0)
    guard.act(RIGHT)
    with pytest.raises(RobotStopped, check=about("hardly moved")):
        guard.reset(0)


def test_a_pusher_that_goes_back_and_forth_without_moving_is_stopped():
    guard = guarded(Marble(shares=[0.0] * 100))
    with pytest.raises(RobotStopped, check=about("hardly moved")):
        move_and_look(guard, RIGHT, -RIGHT, RIGHT)


@pytest.mark.parametrize("share", [3.0, -1.0])
def test_a_pusher_that_goes_too_far_or_another_way_is_stopped(share):
    world = Marble(shares=[share] * 3)
    guard = guarded(world)
    guard.act(-RIGHT)
    with pytest.raises(RobotStopped, check=about("away from its commanded path")):
        guard.observe()
    assert world.calls == ["start", "stop"]
    with pytest.raises(RobotStopped):
        guard.act(RIGHT)


def test_a_pusher_that_an_object_holds_once_goes_on_and_may_be_anywhere_between_until_it_moves():
    world = Marble(shares=[0.0] * 3)
    guard = guarded(world)
    for action, place, held_back in ((RIGHT, 0.0, 0), (RIGHT, 0.06, 0), (RIGHT, 0.12, 0), (RIGHT, 0.12, 1)):
        guard.act(action)
        guard.observe()
        np.testing.assert_allclose(world.place, [place, 0.0], atol=1e-12)
        assert len(guard.held_back) == held_back
    world = Marble((0.05, 0.0), shares=[0.0] * 3)
    guard = guarded(world)
    move_and_look(guard, RIGHT, RIGHT)
    np.testing.assert_allclose(world.place, [0.06, 0.0], atol=1e-12)  # it may have been at 0.11 already
    (one,) = guard.held_back
    np.testing.assert_allclose(one.done, [0.05, 0.0, 0.0], atol=1e-12)


def test_a_controller_that_lags_and_one_that_goes_on_a_little_are_not_stopped():
    for share in (0.5, 1.4):
        world = Marble(shares=[share] * 400)
        guard = guarded(world, SafetyLimits())
        move_and_look(guard, *[RIGHT, RIGHT, -RIGHT, -RIGHT] * 10)
        assert world.calls == ["start"]


def test_a_pusher_that_is_moved_by_hand_before_it_is_started_is_where_it_is_seen():
    world = Marble()
    guard = guarded(world)
    world.place = np.array([-0.08, 0.1])
    guard.observe()
    guard.act(RIGHT)
    guard.observe()
    assert world.calls == ["start"]


def test_nothing_moves_before_its_place_is_known_or_for_what_is_no_action():
    world = Marble()
    with pytest.raises(InvalidInput, check=about("position of the pusher")):
        GuardedWorld(world, LIMITS).act(RIGHT)
    guard = guarded(world)
    with pytest.raises(InvalidInput, check=about("action")):
        guard.act(np.array([0.5, 0.0, 0.0]))
    assert world.calls == []
    guard.check()


def test_it_asks_once_before_the_first_motion_and_nothing_moves_if_nobody_allows_it():
    asked, world = [], Marble()
    guard = guarded(world, permit=lambda: not asked.append(world.calls.copy()))
    guard.act(RIGHT)
    guard.act(-RIGHT)
    assert asked == [[]]
    assert world.calls == ["start"]
    world = Marble()
    with pytest.raises(RobotStopped, check=about("nobody allowed it")):
        guarded(world, permit=lambda: False).act(RIGHT)
    assert world.velocities == []
    assert "start" not in world.calls


@pytest.mark.parametrize("error", [ConnectionLost("http://robot", "cut"), RuntimeError("broken")])
def test_after_a_stop_every_action_is_refused_with_the_first_reason_and_closing_stops_again(error):
    world = Marble(fails={"stop": error})
    guard = guarded(world)
    guard.act(RIGHT)
    guard.stop("a key was pressed")
    assert guard.observe().pusher is not None
    guard.stop("for another reason")
    for _ in range(2):
        with pytest.raises(RobotStopped, check=about("a key was pressed")):
            guard.act(RIGHT)
    guard.close()
    assert world.calls == ["start", "stop", "stop", "stop", "close"]


def test_a_stop_from_another_thread_ends_a_motion_that_is_under_way():
    begun, stopped = threading.Event(), threading.Event()

    class Slow(Marble):
        def act(self, action):
            super().act(action)
            begun.set()
            assert stopped.wait(10)

        def stop(self):
            super().stop()
            stopped.set()

    world = Slow()
    guard = guarded(world, SafetyLimits(top_speed_m_s=0.1))
    other = threading.Thread(target=lambda: begun.wait(10) and guard.stop("somebody wanted it"))
    other.start()
    with pytest.raises(RobotStopped, check=about("somebody wanted it")):
        guard.act(RIGHT)
    other.join()
    assert len(world.velocities) == 1  # of three


@pytest.mark.parametrize("what", ["act", "observe"])
@pytest.mark.parametrize("error", [ConnectionLost("http://robot", "cut"), RuntimeError("broken"), KeyboardInterrupt()])
def test_whatever_goes_wrong_stops_the_robot(what, error):
    world = Marble()
    guard = guarded(world)
    guard.act(RIGHT)
    world.fails[what] = error
    with pytest.raises(type(error)):
        guard.act(RIGHT) if what == "act" else guard.observe()
    assert world.calls == ["start", "stop"]
    with pytest.raises(RobotStopped):
        guard.act(RIGHT)


def test_two_limits_hold_together_and_limits_that_are_none_are_refused():
    both = LIMITS.within(SafetyLimits((0.0, 0.0, 0.3, 0.3), 0.05))
    assert (both.box, both.top_speed_m_s) == ((0.0, 0.0, 0.12, 0.2), 0.05)
    with pytest.raises(InvalidInput, check=about("safety box")):
        LIMITS.within(SafetyLimits((0.2, 0.2, 0.3, 0.3)))
    for box in ((0.1, 0.0, -0.1, 0.1), (0.0, 0.0, float("nan"), 0.1)):
        with pytest.raises(InvalidInput, check=about("safety box")):
            SafetyLimits(box)
    for speed in (0.0, 50.0):
        with pytest.raises(InvalidInput, check=about("top speed")):
            SafetyLimits(BOX, speed)


# Masks from boxes


@pytest.fixture(scope="module")
def seen(library):
    with contextlib.closing(simulated(library, size=256)) as table:
        return table.observe(masks=True)


class Still(Marble):
    """A world that always looks the same."""

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def observe(self, *, masks=False):
        return self.seen if masks else replace(self.seen, masks=None)


def boxes_around(seen, cameras, names=NAMES, margin=6):
    boxes = {}
    for view in cameras:
        for name in names:
            rows, columns = np.nonzero(seen.masks[view, seen.names.index(name)])
            box = columns.min() - margin, rows.min() - margin, columns.max() + margin, rows.max() + margin
            boxes.setdefault(seen.cameras[view].name, {})[name] = tuple(map(float, box))
    return boxes


def test_boxes_become_masks_of_the_cameras_that_have_them_all(seen):
    bare = Still(replace(seen, masks=None))
    world = OutlinedWorld(bare, boxes_around(seen, (1, 3)) | boxes_around(seen, (0,), NAMES[:1]))
    found = world.observe(masks=True)
    assert [camera.name for camera in found.cameras] == ["1", "3"]
    true = seen.masks[[1, 3]]
    iou = (found.masks & true).sum(axis=(2, 3)) / (found.masks | true).sum(axis=(2, 3))
    assert iou.min() > 0.75  # shadows are dark, too
    later = world.observe()
    assert (len(later.cameras), later.masks) == (4, None)
    assert OutlinedWorld(Still(seen), {}).observe(masks=True) is seen  # masks of the world come first


def test_boxes_that_their_outlines_do_not_fill_are_doubted(seen):
    world = OutlinedWorld(Still(replace(seen, masks=None)), boxes_around(seen, (1,), margin=25))
    world.observe(masks=True)
    assert world.doubts
    assert all("in the picture of 1" in doubt for doubt in world.doubts)
    world.observe()  # later pictures are not outlined
    assert world.doubts


@pytest.mark.parametrize(
    ("boxes", "error", "what"),
    [
        ({"0": {NAMES[0]: (10.0, 10.0, 90.0, 90.0)}}, InvalidInput, "boxes"),
        ({"above": {}}, UnknownName, "above"),
        ({"0": {"025_mug": (10.0, 10.0, 90.0, 90.0)}}, UnknownName, "025_mug"),
    ],
)
def test_boxes_that_do_not_do_are_refused(seen, boxes, error, what):
    with pytest.raises(error, check=about(what)):
        OutlinedWorld(Still(replace(seen, masks=None)), boxes).observe(masks=True)
