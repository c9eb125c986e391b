"""When what of an episode is on view in its replay: looks in short, a moment for each plan, pushes in real time."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

from app.episodes.trajectory import LOOKS, LookFrame, Round, Trajectory
from osfcore.geometry.workspace import STEP_S

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

    looks_s: float
    step_s: tuple[float, ...]

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
