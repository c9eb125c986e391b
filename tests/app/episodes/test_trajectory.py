import numpy as np
import pytest

from app.episodes.trajectory import (
    CANDIDATES,
    LOOK_S,
    PLAN_S,
    REST_S,
    LookFrame,
    ReplayClock,
    Round,
    Trajectory,
    TrajectoryRecorder,
    read_trajectory,
    write_trajectory,
)
from osfcore.control.events import ActionExecuted, Looking, Observed, Stepped
from osfcore.errors import CorruptFile
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.planning.mppi import PlanSketch
from osfcore.progress import Progress

NAMES = ("mug", "can")
LOW = Light.from_angles(0.3, np.deg2rad(MIN_LIGHT_ELEVATION_DEG))  # rounded, it would be too low


def poses(rng, *shape):
    quaternions = rng.normal(size=(*shape, 4))
    return Pose(rng.normal(size=(*shape, 3)), quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))


def state(rng, pusher=True):
    return SceneState(NAMES, poses(rng, 2), LOW, rng.normal(size=3) if pusher else None)


def estimate(rng, doubts=("", "")):
    return EstimatedState(state(rng), np.zeros(2), np.zeros(2), 0.0, doubts, "")


def plan(rng, ways, horizon):
    futures = poses(rng, 1, horizon, 2)
    best = Rollouts(NAMES, futures.position, futures.quaternion, rng.normal(size=(1, horizon, 3)))
    return PlanSketch(3, rng.normal(size=(ways, horizon, 2)), np.sort(rng.normal(size=ways)), best)


@pytest.fixture
def trajectory():
    rng = np.random.default_rng(0)
    looks = (
        LookFrame("first", 0.0, float("nan"), state(rng, pusher=False), poses(rng, 0, 2)),
        LookFrame("first", 1.0, 0.5, state(rng), poses(rng, 5, 2)),
        LookFrame("goal", 0.5, 2.0, state(rng), poses(rng, 3, 2)),
    )
    rounds = (
        Round(0, estimate(rng), None),
        Round(1, estimate(rng, ("", "hidden")), plan(rng, 4, 7)),
        Round(3, estimate(rng), plan(rng, 2, 5)),
        Round(4, estimate(rng), None),
    )
    return Trajectory(tuple(state(rng) for _ in range(5)), poses(rng, 2), looks, rounds)


def close(a, b):
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_what_was_written_is_read_again(trajectory, tmp_path):
    write_trajectory(tmp_path / "t.npz", trajectory)
    read = read_trajectory(tmp_path / "t.npz")
    assert read.names == NAMES
    for mine, theirs in zip(trajectory.states, read.states, strict=True):
        close(mine.poses.position, theirs.poses.position)
        close(mine.poses.quaternion, theirs.poses.quaternion)
        close(mine.light.position, theirs.light.position)
        close(mine.pusher, theirs.pusher)
    close(trajectory.goal.quaternion, read.goal.quaternion)
    for mine, theirs in zip(trajectory.looks, read.looks, strict=True):
        assert (mine.look, mine.done) == (theirs.look, theirs.done)
        close(mine.candidates.position, theirs.candidates.position)
        assert (mine.state.pusher is None) == (theirs.state.pusher is None)
    for mine, theirs in zip(trajectory.rounds, read.rounds, strict=True):
        assert mine.action == theirs.action
        assert [bool(doubt) for doubt in mine.estimate.doubts] == [bool(doubt) for doubt in theirs.estimate.doubts]
        assert (mine.plan is None) == (theirs.plan is None)
        if mine.plan is not None:
            close(mine.plan.ways, theirs.plan.ways)
            close(mine.plan.costs, theirs.plan.costs)
            close(mine.plan.best.positions, theirs.plan.best.positions)
            close(mine.plan.best.pusher, theirs.plan.best.pusher)


def test_one_that_has_just_begun_is_read_again(tmp_path):
    begun = Trajectory((state(np.random.default_rng(1)),), None, (), ())
    write_trajectory(tmp_path / "t.npz", begun)
    read = read_trajectory(tmp_path / "t.npz")
    assert (read.goal, read.looks, read.rounds) == (None, (), ())
    assert ReplayClock(read).length_s == 0


@pytest.mark.parametrize("spoil", [lambda data: b"", lambda data: data[: len(data) // 2], lambda data: b"PK" + data])
def test_a_damaged_file_is_told(trajectory, tmp_path, spoil):
    path = tmp_path / "t.npz"
    write_trajectory(path, trajectory)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(CorruptFile):
        read_trajectory(path)


def test_arrays_of_another_kind_are_told(tmp_path):
    np.savez(tmp_path / "t.npz", names=np.array(["mug"]))
    with pytest.raises(CorruptFile):
        read_trajectory(tmp_path / "t.npz")


# The clock


def test_pushes_are_replayed_in_real_time_after_the_looks(trajectory):
    clock = ReplayClock(trajectory)
    glance_s = clock.looks_s - LOOK_S["first"]  # the goal was found at once
    assert 0 < glance_s < LOOK_S["goal"]
    spent = np.diff(clock.step_s)
    np.testing.assert_allclose(spent, [PLAN_S + actions * STEP_S + REST_S for actions in (1, 2, 1)], atol=1e-12)
    assert clock.step_s[0] == clock.looks_s
    assert clock.length_s == clock.step_s[-1]


def test_a_moment_shows_what_was_known_then(trajectory):
    clock, rounds = ReplayClock(trajectory), trajectory.rounds
    assert clock.moment(0.0).look is trajectory.looks[0]
    assert clock.moment(LOOK_S["first"] - 1e-6).look is trajectory.looks[1]
    assert clock.moment(clock.looks_s - 1e-6).look is trajectory.looks[2]
    for number, at_s in enumerate(clock.step_s):
        moment = clock.moment(at_s)
        assert (moment.look, moment.estimate, moment.action) == (None, rounds[number], rounds[number].action)
    planning = clock.moment(clock.step_s[1] + PLAN_S / 2)
    assert (planning.action, planning.plan, planning.estimate) == (1.0, rounds[2], rounds[1])
    assert planning.planned == pytest.approx(0.5)
    pushing = clock.moment(clock.step_s[1] + PLAN_S + 1.5 * STEP_S)
    assert pushing.action == pytest.approx(2.5)
    assert pushing.planned == 1.0
    assert clock.moment(clock.step_s[3] - REST_S / 2).plan is None  # nothing was planned
    assert clock.moment(1e6).estimate is clock.moment(clock.length_s).estimate


def test_actions_never_go_back(trajectory):
    clock = ReplayClock(trajectory)
    actions = [clock.moment(at_s).action for at_s in np.linspace(-1, clock.length_s + 1, 500)]
    assert np.all(np.diff(actions) >= 0)
    assert (actions[0], actions[-1]) == (0.0, 4.0)


# The recorder


class Table:
    def __init__(self, states):
        self.states = iter(states)

    def truth(self):
        return next(self.states)


def look(which, number, total, candidates=None):
    step = EstimateStep(Progress(number, total, ""), "light", state(np.random.default_rng(number)), candidates)
    return Looking(0, which, step)


def test_looks_of_any_length_are_kept_evenly_with_their_end(tmp_path):
    for total in (1, 10, 64, 65, 1000):
        recorder = TrajectoryRecorder(state(np.random.default_rng(0)))
        for number in range(total):
            recorder.take(look("first", number, total - 1), Table([]))
        done = [frame.done for frame in recorder.trajectory.looks]
        assert len(done) <= 66
        assert done == sorted(set(done))
        assert done[-1] == (1.0 if total > 1 else 0.0)
        assert np.diff(done).max(initial=0) <= max(4 / 64, 1 / max(total - 1, 1)) + 1e-9


def test_states_follow_actions_and_only_some_candidates_are_kept():
    rng = np.random.default_rng(2)
    states = [state(rng) for _ in range(3)]
    recorder = TrajectoryRecorder(states[0])
    table = Table(states[1:])
    recorder.take(look("first", 1, 2, poses(rng, 200, 2)), table)
    recorder.take(look("next", 1, 2), table)
    recorder.take(Observed(0, None), table)
    recorder.take(ActionExecuted(1, np.zeros(3)), table)
    recorder.take(ActionExecuted(2, np.zeros(3)), table)
    believed = estimate(rng)
    recorder.take(Stepped(2, 9, believed, np.zeros(2), np.zeros(2), 0.0, np.zeros((2, 2, 3)), {}), table)
    kept = recorder.trajectory
    assert list(kept.states) == states
    (frame,) = kept.looks
    assert len(frame.candidates.position) == CANDIDATES
    (round_,) = kept.rounds
    assert (round_.action, round_.estimate, round_.plan) == (2, believed, None)
