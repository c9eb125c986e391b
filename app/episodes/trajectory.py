"""The course of an episode, dense enough to be drawn again: what was looked at, believed, planned and done.

A report says what each round came to; this says what was on view meanwhile. It is one compressed `.npz` of float32
arrays, some ten kilobytes a round, written anew after each round so that an episode can be looked through as it runs.
"""

from __future__ import annotations

import io
import zipfile
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float, Int

from osfcore.control.events import ActionExecuted, Event, GoalFound, Looking, Planning, Stepped
from osfcore.errors import CorruptFile
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import write_atomically
from osfcore.planning.mppi import PlanRound, PlanSketch, sketch_of

LookAt = Literal["first", "goal"]
LOOKS: tuple[LookAt, ...] = ("first", "goal")


@dataclass(frozen=True, eq=False, slots=True)
class LookFrame:
    """An estimator at work on the first frame or on the goal image, at one moment.

    Attributes:
        look: which of the two.
        done: share of the work that was done, from 0 to 1.
        loss: of the whole, in units of its stage; NaN where there is none.
        state: the best scene so far.
        candidates: poses that were tried for each object, a (C, N) batch; none is C = 0.
    """

    look: LookAt
    done: float
    loss: float
    state: SceneState
    candidates: Pose


@dataclass(frozen=True, eq=False, slots=True)
class Round:
    """A round of the loop, or how it was before the first.

    Attributes:
        action: executed before its end.
        estimate: at its end.
        plan: that its actions followed; None before the first round, and where nothing was planned.
    """

    action: int
    estimate: EstimatedState
    plan: PlanSketch | None


@dataclass(frozen=True, eq=False, slots=True)
class Trajectory:
    """The course of an episode so far.

    Attributes:
        states: true ones, at the beginning and after each action of 0.2 s.
        goal: poses where everything should be, in the order of the states' objects; None until they are known.
        looks: at first frame and goal image, in the order in which they came.
        rounds: in the order in which they came.
    """

    states: tuple[SceneState, ...]
    goal: Pose | None
    looks: tuple[LookFrame, ...]
    rounds: tuple[Round, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the objects."""
        return self.states[0].names

    def state_at(self, action: float) -> SceneState:
        """The true state after some actions; between two whole numbers, on the way."""
        number = min(max(int(action), 0), len(self.states) - 1)
        first, then = self.states[number], self.states[min(number + 1, len(self.states) - 1)]
        share = min(max(action - number, 0.0), 1.0)
        turn = quaternion_log(quaternion_multiply(then.poses.quaternion, quaternion_conjugate(first.poses.quaternion)))
        quaternions = quaternion_multiply(quaternion_exp(share * turn), first.poses.quaternion)
        positions = (1 - share) * first.poses.position + share * then.poses.position
        pusher = first.pusher
        if first.pusher is not None and then.pusher is not None:
            pusher = (1 - share) * first.pusher + share * then.pusher
        return SceneState(first.names, Pose(positions, quaternions), first.light, pusher)


# The file


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    data = io.BytesIO()
    np.savez_compressed(data, **_arrays(trajectory))  # pyright: ignore[reportArgumentType]
    write_atomically(path, data.getvalue())


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory in a file.

    Raises:
        CorruptFile: if it cannot be read or holds something else.
    """
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            return _trajectory(dict(arrays))
    except OSError as error:
        raise CorruptFile(path, error.strerror or str(error)) from error
    except (ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise CorruptFile(path, "it does not hold the course of an episode") from error


def _arrays(trajectory: Trajectory) -> dict[str, np.ndarray]:
    states, looks, rounds, count = trajectory.states, trajectory.looks, trajectory.rounds, len(trajectory.names)
    plans = [round_.plan for round_ in rounds if round_.plan is not None]
    best = [Pose(plan.best.positions[0], plan.best.quaternions[0]) for plan in plans]
    arrays = {
        "names": np.array(trajectory.names),
        **_states("states", states),
        "looks/which": np.array([LOOKS.index(look.look) for look in looks], np.int8),
        "looks/progress": np.array([(look.done, look.loss) for look in looks], np.float32).reshape(-1, 2),
        **_states("looks", [look.state for look in looks]),
        "looks/tried": np.array([len(look.candidates.position) for look in looks], np.int32),
        "looks/candidates": _stacked([_rows(look.candidates) for look in looks], count, 7),
        "rounds/action": np.array([round_.action for round_ in rounds], np.int32),
        **_states("rounds", [round_.estimate.state for round_ in rounds]),
        "rounds/doubted": np.array([[bool(doubt) for doubt in round_.estimate.doubts] for round_ in rounds]),
        "rounds/has_plan": np.array([round_.plan is not None for round_ in rounds], bool),
        "plans/horizon": np.array([len(plan.best.pusher[0]) for plan in plans], np.int32),
        "plans/ways": _stacked([plan.ways.reshape(-1, 2) for plan in plans], 2),
        "plans/costs": _stacked([plan.costs for plan in plans]),
        "plans/count": np.array([len(plan.costs) for plan in plans], np.int32),
        "plans/best": _stacked([_rows(pose) for pose in best], count, 7),
        "plans/pusher": _stacked([plan.best.pusher[0] for plan in plans], 3),
    }
    if trajectory.goal is not None:
        arrays["goal"] = _rows(trajectory.goal)
    return {name: _small(name, array) for name, array in arrays.items()}


def _trajectory(arrays: Mapping[str, np.ndarray]) -> Trajectory:
    names = tuple(str(name) for name in arrays["names"])
    states = _read_states(names, "states", arrays)
    if not states:
        raise ValueError("no states")
    goal = arrays.get("goal")
    return Trajectory(
        tuple(states),
        None if goal is None else _pose(goal),
        tuple(_read_looks(names, arrays)),
        tuple(_read_rounds(names, arrays)),
    )


def _states(prefix: str, states: Sequence[SceneState]) -> dict[str, np.ndarray]:
    count = len(states[0].names) if states else 0
    nowhere = np.full(3, np.nan)
    return {
        f"{prefix}/poses": np.array([_rows(state.poses) for state in states]).reshape(len(states), count, 7),
        f"{prefix}/light": np.array([state.light.position for state in states]).reshape(-1, 3),
        f"{prefix}/pusher": np.array([nowhere if s.pusher is None else s.pusher for s in states]).reshape(-1, 3),
    }


def _read_states(names: tuple[str, ...], prefix: str, arrays: Mapping[str, np.ndarray]) -> list[SceneState]:
    rows = zip(arrays[f"{prefix}/poses"], arrays[f"{prefix}/light"], arrays[f"{prefix}/pusher"], strict=True)
    return [
        SceneState(
            names, _pose(poses), Light(light.astype(float)), None if np.isnan(pusher).any() else pusher.astype(float)
        )
        for poses, light, pusher in rows
    ]


def _read_looks(names: tuple[str, ...], arrays: Mapping[str, np.ndarray]) -> list[LookFrame]:
    tried = _split(arrays["looks/candidates"], arrays["looks/tried"])
    states = _read_states(names, "looks", arrays)
    rows = zip(arrays["looks/which"], arrays["looks/progress"], states, tried, strict=True)
    return [
        LookFrame(LOOKS[which], float(done), float(loss), state, _pose(poses))
        for which, (done, loss), state, poses in rows
    ]


def _read_rounds(names: tuple[str, ...], arrays: Mapping[str, np.ndarray]) -> list[Round]:
    plans = iter(_read_plans(names, arrays))
    states = _read_states(names, "rounds", arrays)
    none = np.zeros(len(names))
    rounds = []
    for action, state, doubted, has_plan in zip(
        arrays["rounds/action"], states, arrays["rounds/doubted"], arrays["rounds/has_plan"], strict=True
    ):
        doubts = tuple("doubtful" if is_doubted else "" for is_doubted in doubted)
        estimate = EstimatedState(state, none, none, 0.0, doubts, "")
        rounds.append(Round(int(action), estimate, next(plans) if has_plan else None))
    return rounds


def _read_plans(names: tuple[str, ...], arrays: Mapping[str, np.ndarray]) -> list[PlanSketch]:
    horizons, counts = arrays["plans/horizon"], arrays["plans/count"]
    best, pusher = _split(arrays["plans/best"], horizons), _split(arrays["plans/pusher"], horizons)
    ways = _split(arrays["plans/ways"], horizons * counts)
    costs = _split(arrays["plans/costs"], counts)
    return [
        PlanSketch(
            0,
            way.reshape(len(cost), -1, 2),
            cost,
            Rollouts(names, poses[None, ..., :3], poses[None, ..., 3:], hand[None]),
        )
        for way, cost, poses, hand in zip(ways, costs, best, pusher, strict=True)
    ]


def _rows(poses: Pose) -> Float[np.ndarray, "*batch 7"]:
    return np.concatenate([poses.position, poses.quaternion], axis=-1)


def _pose(rows: Float[np.ndarray, "*batch 7"]) -> Pose:
    return Pose(rows[..., :3].astype(float), rows[..., 3:].astype(float))


def _stacked(parts: Sequence[np.ndarray], *shape: int) -> Float[np.ndarray, "R *shape"]:
    """Join parts of any length; without any, the array has length 0."""
    return np.concatenate([*parts, np.zeros((0, *shape))]).astype(np.float32)


def _split(rows: np.ndarray, lengths: Int[np.ndarray, "P"]) -> list[np.ndarray]:
    """Rows in pieces of the lengths that are given; refused unless they add up."""
    if lengths.sum() != len(rows) or np.any(lengths < 0):
        raise ValueError("lengths do not add up")
    return np.split(rows, np.cumsum(lengths)[:-1]) if len(lengths) else []


def _small(name: str, array: np.ndarray) -> np.ndarray:
    """In single precision, but for lights: rounded, one that is as low as may be would be too low."""
    return array.astype(np.float32) if array.dtype == np.float64 and not name.endswith("/light") else array


# Keeping the course of an episode as its events come


CANDIDATES = 24  # kept of each object
_MOST_LOOKS = 64  # kept of each look; of more, every other one is dropped


class Truth(Protocol):
    """What knows where everything truly is."""

    def truth(self) -> SceneState:
        """The true state now."""
        ...


class TrajectoryRecorder:
    """Keeps what is worth drawing again of an episode.

    Args:
        start: the true state before the first action.

    Attributes:
        states: true ones, at the beginning and after each action.
    """

    def __init__(self, start: SceneState) -> None:
        self.states = [start]
        self._goal: Pose | None = None
        self._looks: dict[str, _Thinned] = {}
        self._rounds: list[Round] = []
        self._plan: PlanRound | None = None

    @property
    def trajectory(self) -> Trajectory:
        """The course so far."""
        looks = tuple(look for thinned in self._looks.values() for look in thinned.kept)
        return Trajectory(tuple(self.states), self._goal, looks, tuple(self._rounds))

    def take(self, event: Event, table: Truth) -> None:
        """Note an event, and where everything truly is after an action."""
        names = self.states[0].names
        match event:
            case Looking() if event.look == "first" or event.look == "goal":
                self._looks.setdefault(event.look, _Thinned()).add(_frame(event.look, event.step))
            case GoalFound(goal):
                self._goal = goal.poses[[goal.names.index(name) for name in names]]
            case Planning():
                self._plan = event.round
            case ActionExecuted():
                self.states.append(table.truth())
            case Stepped(number, _, estimate):
                plan = None if self._plan is None else sketch_of(number, self._plan)
                self._rounds.append(Round(number, estimate, plan))
                self._plan = None
            case _:
                pass


class _Thinned:
    """At most so many of a sequence whose length is not known beforehand, evenly spaced, and the last one."""

    def __init__(self) -> None:
        self._every, self._count = 1, 0
        self._frames: list[LookFrame] = []
        self._last: LookFrame | None = None

    def add(self, frame: LookFrame) -> None:
        if self._count % self._every == 0:
            self._frames.append(frame)
        if len(self._frames) > _MOST_LOOKS:
            self._frames, self._every = self._frames[::2], 2 * self._every
        self._count, self._last = self._count + 1, frame

    @property
    def kept(self) -> list[LookFrame]:
        last = self._last
        return self._frames if last is None or self._frames[-1] is last else [*self._frames, last]


def _frame(look: LookAt, step: EstimateStep) -> LookFrame:
    progress = step.progress
    candidates = Pose.identity(0, len(step.state.names))
    if step.candidates is not None:
        tried = len(step.candidates.position)
        candidates = step.candidates[np.unique(np.linspace(0, tried - 1, min(CANDIDATES, tried)).astype(int))]
    done = min(progress.done / max(progress.total, 1), 1.0)
    return LookFrame(look, done, step.loss, step.state, candidates)


# When what is on view in a replay: looks in short, a moment for each plan, pushes in real time


LOOK_S = {"first": 3.0, "goal": 1.6}
_GLANCE_S = 0.6  # for a look whose result was there at once
PLAN_S, REST_S = 0.35, 0.05  # a plan is on view before its actions, and the new estimate after them


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """What is on view at one moment.

    Attributes:
        action: executed so far; between two whole numbers one is being executed.
        look: an estimator at work; None after the looks.
        estimate: the last round that is over; None before the first.
        plan: the round whose plan is being followed; None where there is none.
        planned: how much of the plan's future is played, as a share.
    """

    action: float
    look: LookFrame | None = None
    estimate: Round | None = None
    plan: Round | None = None
    planned: float = 0.0


class ReplayClock:
    """The times of one trajectory.

    Args:
        trajectory: of an episode, perhaps of one that goes on.

    Attributes:
        looks_s: how long the looks take [s].
        step_s: when each round is over, from the beginning of the replay [s]; the first one right after the looks.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._looks: list[tuple[float, float, list[LookFrame]]] = []  # with their beginnings and lengths
        end_s = 0.0
        for look in LOOKS:
            frames = [frame for frame in trajectory.looks if frame.look == look]
            if frames:
                length_s = LOOK_S[look] if len(frames) > 1 else _GLANCE_S
                self._looks.append((end_s, length_s, frames))
                end_s += length_s
        self.looks_s = end_s
        ends, before = [], 0
        for number, round_ in enumerate(trajectory.rounds):
            end_s += 0.0 if number == 0 else PLAN_S + STEP_S * (round_.action - before) + REST_S
            before = round_.action
            ends.append(end_s)
        self.step_s = tuple(ends)

    @property
    def length_s(self) -> float:
        """Of the whole replay."""
        return self.step_s[-1] if self.step_s else self.looks_s

    def moment(self, at_s: float) -> Moment:
        """What is on view at a time; the first or last moment for times out of range."""
        rounds = self._trajectory.rounds
        if at_s < self.looks_s or not rounds:
            return self._looking(at_s)
        number = min(bisect_left(self.step_s, at_s - 1e-9), len(rounds) - 1)
        if number == 0 or at_s >= self.step_s[number] - 1e-9:
            return Moment(float(rounds[number].action), estimate=rounds[number])
        before, now = rounds[number - 1], rounds[number]
        spent_s = at_s - self.step_s[number - 1] - PLAN_S
        action = min(before.action + max(spent_s, 0.0) / STEP_S, float(now.action))
        plan = now if now.plan is not None else None
        return Moment(action, None, before, plan, min(max(1 + spent_s / PLAN_S, 0.0), 1.0))

    def _looking(self, at_s: float) -> Moment:
        for begin_s, length_s, frames in reversed(self._looks):
            if at_s >= begin_s or begin_s == 0:
                share = min(max((at_s - begin_s) / length_s, 0.0), 1.0)
                frame = min(frames, key=lambda frame: abs(frame.done - share))
                return Moment(0.0, look=frame)
        return Moment(0.0)
