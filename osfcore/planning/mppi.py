"""MPPI over predicted futures (paper, section 4.4).

Deviations: sequences are not drawn around the last plan alone but from three sources (the last plan, pushes worth
trying, random walks), and the softmax average is taken over a second round, drawn around the best of the first: the
average of a way around the left and one around the right leads into the object. That round looks less far ahead: what
comes later will be planned again before it is done. Noise is added to the pusher's path,
not to its velocity, so that what comes late in a sequence is disturbed no more than what comes early.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S
from osfcore.planning.pose_cost import Cost, PoseGoal

_WALK_M = 0.06  # noise of random walks

Rollout = Callable[[SceneState, Float[np.ndarray, "K T 3"], SceneState | None], Rollouts]


@runtime_checkable
class PushSource(Protocol):
    """Pushes worth trying. What it takes to find them stays out of here: plans are looked at where no torch is."""

    def draw(
        self, state: SceneState, goal: PoseGoal, count: int, horizon: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "P T 3"]:
        """About `count` sequences of actions [m/s]."""
        ...


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """How pushes are planned.

    Attributes:
        samples: sequences of actions in each of both rounds (K).
        horizon: actions in each (T).
        temperature: of the softmax, as a share of the spread of costs in the better half of the second round.
        noise_m: sigma of the pusher's path around the plan [m].
        knot_every: actions between the places where the noise is drawn, with straight lines between them.
        refined: actions that the second round looks at and changes.
    """

    samples: int = 160
    horizon: int = 30
    temperature: float = 0.03
    noise_m: float = 0.008
    knot_every: int = 3
    refined: int = 12

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        for what, value, low, high in (
            ("number of samples", self.samples, 8, MAX_SEQUENCES),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("temperature", self.temperature, 1e-6, 1e6),
            ("noise [m]", self.noise_m, 0.0, PUSHER_REACH_M),
            ("actions between knots", self.knot_every, 1, MAX_HORIZON),
            ("refined actions", self.refined, 1, MAX_HORIZON),
        ):
            if not low <= value <= high:
                raise InvalidInput(what, value, f"between {low} and {high}")


@dataclass(frozen=True, eq=False, slots=True)
class PlanRound:
    """One round of a plan.

    Attributes:
        number: of the round, from 0.
        actions: the plan so far [m/s]: the best sequence of the first round; in the second its first actions are the
            softmax average.
        rollouts: all futures of the round; those of the second are shorter.
        costs: theirs.
    """

    number: int
    actions: Float[np.ndarray, "T 3"]
    rollouts: Rollouts
    costs: Float[np.ndarray, "K"]

    @property
    def best(self) -> Rollouts:
        """The future of the sequence that costs least, K = 1; the plan's own lies close to it."""
        return self.rollouts[int(self.costs.argmin())]


class Planner:
    """Plans pushes toward goals, again and again from the last plan.

    Args:
        rollout: predicts futures: state, actions, and the state one action ago if known.
        proposals: of pushes worth trying.
        settings: of the plan.
    """

    def __init__(self, rollout: Rollout, proposals: PushSource, settings: PlanSettings | None = None) -> None:
        self._rollout, self._proposals = rollout, proposals
        self.settings = settings or PlanSettings()
        self._last: Float[np.ndarray, "T 3"] | None = None

    def forget(self) -> None:
        """Begin anew: the goal or the scene is another one."""
        self._last = None

    def upcoming(self, count: int) -> Float[np.ndarray, "count 3"]:
        """The next actions of the last plan; at rest after its end, and where there is no plan [m/s]."""
        plan = np.zeros((0, 3)) if self._last is None else self._last[:count]
        return np.concatenate([plan, np.zeros((count - len(plan), 3))])

    def executed(self, count: int) -> None:
        """The first actions of the last plan have been taken."""
        if self._last is not None:
            self._last = np.concatenate([self._last[count:], np.zeros((min(count, len(self._last)), 3))])

    def plan(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None = None
    ) -> Iterator[PlanRound]:
        """Two rounds; the actions of the last one are the plan.

        Args:
            state: of the scene, with its pusher.
            goal: what proposals aim at.
            cost: what futures cost.
            rng: draws everything.
            before: the same objects one action ago.
        """
        first = self._first_round(state, goal, rng)
        round_ = self._scored(0, state, first, cost, before)
        yield round_
        begin, rest = np.split(round_.actions, [self.settings.refined])
        keep_end = self.settings.knot_every < len(begin) and len(rest) > 0
        second = self._around(begin, self.settings.samples, rng, self.settings.noise_m, keep_end=keep_end)
        round_ = self._scored(1, state, second, cost, before)
        mean = np.einsum("k,kta->ta", _softmax(round_.costs, self.settings.temperature), second)
        self._last = np.concatenate([mean, rest])
        yield replace(round_, actions=self._last)

    def _scored(
        self, number: int, state: SceneState, actions: Float[np.ndarray, "K T 3"], cost: Cost, before: SceneState | None
    ) -> PlanRound:
        rollouts = self._rollout(state, actions, before)
        costs = cost(rollouts)
        return PlanRound(number, actions[int(costs.argmin())], rollouts, costs)

    def _first_round(self, state: SceneState, goal: PoseGoal, rng: np.random.Generator) -> Float[np.ndarray, "K T 3"]:
        """The last plan and some around it, pushes worth trying, and random walks."""
        settings = self.settings
        still = np.zeros((settings.horizon, 3))
        last = still if self._last is None else self._resized(self._last)
        share = settings.samples // 8
        walks = self._around(still, share, rng, _WALK_M)
        kept = self._around(last, share, rng, settings.noise_m)
        pushes = self._proposals.draw(state, goal, settings.samples - 2 * share, settings.horizon, rng)
        return np.concatenate([kept, walks, pushes])

    def _resized(self, plan: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """The plan at today's horizon, which may have been changed since."""
        horizon = self.settings.horizon
        return np.concatenate([plan[:horizon], np.zeros((max(horizon - len(plan), 0), 3))])

    def _around(
        self,
        plan: Float[np.ndarray, "T 3"],
        count: int,
        rng: np.random.Generator,
        noise_m: float,
        *,
        keep_end: bool = False,
    ) -> Float[np.ndarray, "K T 3"]:
        """The plan itself, and sequences whose paths lie around its own.

        Args:
            plan: what they lie around.
            count: how many.
            rng: draws the noise.
            noise_m: its sigma [m].
            keep_end: all end where the plan ends.
        """
        horizon, every = len(plan), self.settings.knot_every
        times = np.minimum(np.arange(-(-horizon // every) + 1) * every, horizon)
        knots = rng.normal(0, noise_m, (count, len(times), 2))
        knots[0] = 0
        knots[:, 0] = 0  # the pusher is where it is
        if keep_end:
            knots[:, -1] = 0
        moments = np.arange(horizon + 1)
        low = (np.searchsorted(times, moments, side="right") - 1).clip(0, len(times) - 2)
        share = ((moments - times[low]) / (times[low + 1] - times[low]))[:, None]
        path = (1 - share) * knots[:, low] + share * knots[:, low + 1]
        velocity = np.pad(np.diff(path, axis=1) / STEP_S, ((0, 0), (0, 0), (0, 1)))
        return (plan + velocity).clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)


def _softmax(costs: Float[np.ndarray, "K"], temperature: float) -> Float[np.ndarray, "K"]:
    spread = max(float(np.median(costs) - costs.min()), 1e-9)
    weights = np.exp(-(costs - costs.min()) / (temperature * spread))
    return weights / weights.sum()
