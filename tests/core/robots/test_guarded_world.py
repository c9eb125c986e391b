"""Guarded world: guarded world, outlined world."""

import contextlib
import threading

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.workspace import STEP_S
from osfcore.robots.guarded_world import GuardedWorld, OutlinedWorld
from osfcore.robots.robot import ConnectionLost, RobotStopped, SafetyLimits
from tests.core.robots.robots import NAMES, Marble, simulated

# Guarded world


BOX = (-0.1, -0.05, 0.12, 0.2)
LIMITS = SafetyLimits(BOX, 0.1)
RIGHT = np.array([0.3, 0.0, 0.0])
velocities = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)).map(lambda v: np.array([*v, 0.0]))
shares = st.floats(0.0, 1.0)


def guarded(world, limits=LIMITS, **more):
    guard = GuardedWorld(world, limits, **more)
    guard.observe()
    return guard


@settings(suppress_health_check=[HealthCheck.too_slow])  # on a busy machine drawing takes its time
@given(
    st.lists(st.tuples(velocities, st.booleans()), max_size=12),
    st.lists(shares, max_size=40),
    st.tuples(st.floats(BOX[0], BOX[2]), st.floats(BOX[1], BOX[3])),
    st.floats(0.02, 0.42),
)
def test_no_actions_lead_out_of_the_box_or_go_too_fast_whatever_holds_the_pusher(actions, done, begin, speed):
    world = Marble(begin, done)
    guard = guarded(world, SafetyLimits(BOX, speed))
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
    guarded(world, SafetyLimits(top_speed_m_s=0.05)).act(action)
    np.testing.assert_allclose(world.place, STEP_S * action[:2], atol=1e-12)


def test_what_is_allowed_reaches_the_world_as_it_is():
    world = Marble()
    guard = guarded(world, SafetyLimits(top_speed_m_s=0.42))
    guard.act(RIGHT)
    np.testing.assert_allclose(world.velocities, [RIGHT], atol=1e-12)
    assert guard.held_back == ()


def test_a_way_ends_at_the_wall_and_goes_on_along_it_and_that_is_told():
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
    with pytest.raises(InvalidInput, match="move it there by hand"):
        guarded(far).act(-RIGHT)
    assert far.velocities == far.told == []


def test_nothing_moves_before_its_place_is_known():
    with pytest.raises(InvalidInput, match="place of the pusher is unknown"):
        GuardedWorld(Marble(), LIMITS).act(RIGHT)


def test_no_action_of_ours_is_refused_and_changes_nothing():
    world = Marble()
    guard = guarded(world)
    with pytest.raises(InvalidInput, match="action"):
        guard.act(np.array([0.5, 0.0, 0.0]))
    assert world.told == []
    assert not guard.is_stopped


def test_it_asks_once_before_the_first_motion():
    asked = []
    world = Marble()
    guard = guarded(world, permit=lambda: not asked.append(world.told.copy()))
    guard.act(RIGHT)
    guard.act(-RIGHT)
    assert asked == [[]]
    assert world.told == ["start"]


def test_nothing_moves_if_nobody_allows_it():
    world = Marble()
    guard = guarded(world, permit=lambda: False)
    with pytest.raises(RobotStopped, match="nobody allowed it to move"):
        guard.act(RIGHT)
    assert world.velocities == []
    assert "start" not in world.told


def test_after_a_stop_every_action_is_refused_with_the_first_reason():
    world = Marble()
    guard = guarded(world)
    guard.act(RIGHT)
    guard.stop("a key was pressed")
    guard.stop("for another reason")
    for _ in range(2):
        with pytest.raises(RobotStopped, match=r"^The robot was stopped: a key was pressed\.$"):
            guard.act(RIGHT)
    assert world.told == ["start", "stop", "stop"]


def test_a_stop_from_another_thread_ends_a_motion_that_is_under_way():
    begun, told = threading.Event(), threading.Event()

    class Slow(Marble):
        def act(self, action):
            super().act(action)
            begun.set()
            assert told.wait(10)

        def stop(self):
            super().stop()
            told.set()

    world = Slow()
    guard = guarded(world, SafetyLimits(top_speed_m_s=0.1))
    other = threading.Thread(target=lambda: begun.wait(10) and guard.stop("somebody wanted it"))
    other.start()
    with pytest.raises(RobotStopped, match="somebody wanted it"):
        guard.act(RIGHT)
    other.join()
    assert len(world.velocities) == 1  # of three
    assert guard.is_stopped


@pytest.mark.parametrize("error", [ConnectionLost("http://robot", "cut"), RuntimeError("broken"), KeyboardInterrupt()])
def test_whatever_goes_wrong_on_the_way_stops_the_robot(error):
    class Broken(Marble):
        def act(self, action):
            raise error

    world = Broken()
    guard = guarded(world)
    with pytest.raises(type(error)):
        guard.act(RIGHT)
    assert world.told == ["start", "stop"]
    with pytest.raises(RobotStopped):
        guard.act(RIGHT)


def test_a_robot_that_cannot_be_told_to_stop_is_no_other_error():
    class Gone(Marble):
        def stop(self):
            raise ConnectionLost("http://robot", "cut")

    guard = guarded(Gone())
    guard.act(RIGHT)
    guard.stop("a key was pressed")
    with pytest.raises(RobotStopped, match="a key"):
        guard.act(RIGHT)
    assert guard.observe().pusher is not None


def test_a_connection_that_is_lost_while_looking_stops_the_robot():
    class Blind(Marble):
        is_blind = False

        def observe(self, *, masks=False):
            if self.is_blind:
                raise ConnectionLost("http://robot", "cut")
            return super().observe()

    world = Blind()
    guard = guarded(world)
    guard.act(RIGHT)
    world.is_blind = True
    with pytest.raises(ConnectionLost):
        guard.observe()
    assert world.told[-1] == "stop"


def test_closing_stops_and_releases():
    world = Marble()
    guard = guarded(world)
    guard.act(RIGHT)
    guard.close()
    assert world.told == ["start", "stop", "close"]


def test_a_world_without_motors_is_guarded_alike():
    class Plain:
        def __init__(self):
            self.world = Marble()
            self.observe, self.act, self.reset, self.close = (
                self.world.observe, self.world.act, self.world.reset, self.world.close)  # fmt: skip

    plain = Plain()
    guard = guarded(plain)
    guard.act(RIGHT)
    guard.stop("enough")
    with pytest.raises(RobotStopped):
        guard.act(RIGHT)
    assert plain.world.told == []


@pytest.mark.parametrize(
    ("box", "speed", "words"),
    [
        ((0.1, 0.0, -0.1, 0.1), 0.1, "x0 < x1"),
        ((0.0, 0.0, float("nan"), 0.1), 0.1, "finite"),
        (BOX, 0.0, "top speed"),
        (BOX, 50.0, "top speed"),
    ],
)
def test_limits_that_are_none_are_refused(box, speed, words):
    with pytest.raises(InvalidInput, match=words):
        SafetyLimits(box, speed)


def test_two_limits_hold_together():
    both = LIMITS.within(SafetyLimits((0.0, 0.0, 0.3, 0.3), 0.05))
    assert (both.box, both.top_speed_m_s) == ((0.0, 0.0, 0.12, 0.2), 0.05)
    with pytest.raises(InvalidInput, match="partly inside"):
        LIMITS.within(SafetyLimits((0.2, 0.2, 0.3, 0.3)))


# Outlined world


@pytest.fixture(scope="module")
def table(library):
    with contextlib.closing(simulated(library, size=256)) as table:
        yield table


class Bare:
    """The table, which keeps its masks for itself."""

    def __init__(self, table):
        self.act, self.reset, self.close, self._table = table.act, table.reset, table.close, table

    def observe(self, *, masks=False):
        return self._table.observe()


def boxes_around(seen, cameras, names=NAMES, margin=6):
    boxes = {}
    for view in cameras:
        for name in names:
            rows, columns = np.nonzero(seen.masks[view, seen.names.index(name)])
            box = columns.min() - margin, rows.min() - margin, columns.max() + margin, rows.max() + margin
            boxes.setdefault(seen.cameras[view].name, {})[name] = tuple(map(float, box))
    return boxes


def test_boxes_become_masks_of_the_cameras_that_have_them_all(table):
    seen = table.observe(masks=True)
    boxes = boxes_around(seen, (1, 3)) | boxes_around(seen, (0,), NAMES[:1])
    world = OutlinedWorld(Bare(table), boxes)
    found = world.observe(masks=True)
    assert [camera.name for camera in found.cameras] == ["1", "3"]
    true = seen.masks[[1, 3]]
    iou = (found.masks & true).sum(axis=(2, 3)) / (found.masks | true).sum(axis=(2, 3))
    assert iou.min() > 0.75  # shadows are dark, too
    later = world.observe()
    assert (len(later.cameras), later.masks) == (4, None)


def test_masks_of_the_world_come_first(table):
    seen = OutlinedWorld(table, {}).observe(masks=True)
    np.testing.assert_array_equal(seen.masks, table.observe(masks=True).masks)


@pytest.mark.parametrize(
    ("boxes", "error", "words"),
    [
        ({}, InvalidInput, "around each object in at least one camera"),
        ({"0": {NAMES[0]: (10.0, 10.0, 90.0, 90.0)}}, InvalidInput, "around each object"),
        ({"above": {}}, UnknownName, "no camera named 'above'"),
        ({"0": {"025_mug": (10.0, 10.0, 90.0, 90.0)}}, UnknownName, "no object on the table named '025_mug'"),
    ],
)
def test_boxes_that_do_not_do_are_told(table, boxes, error, words):
    with pytest.raises(error, match=words):
        OutlinedWorld(Bare(table), boxes).observe(masks=True)
