"""MPPI over predicted futures (paper, section 4.4).

Deviations: sequences are not drawn around the last plan alone but from three sources (the last plan, pushes worth
trying, random walks), and the softmax average is taken over a second round, drawn around the best of the first: the
average of a way around the left and one around the right leads into the object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.plan.goals import Cost, PoseGoal
from osfcore.plan.proposals import Proposals
from osfcore.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts
from osfcore.scene import MAX_SPEED_M_S, SceneState

Rollout = Callable[[SceneState, Float[np.ndarray, "K T 3"], SceneState | None], Rollouts]


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """How pushes are planned.

    Attributes:
        samples: sequences of actions in each of both rounds (K).
        horizon: actions in each (T).
        temperature: of the softmax, as a share of the spread of costs in the better half of the second round.
        noise_m_s: sigma of velocities around the plan [m/s].
        knots: velocities drawn per sequence, with straight lines between them.
    """

    samples: int = 192
    horizon: int = 15
    temperature: float = 0.15
    noise_m_s: float = 0.06
    knots: int = 5

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        for what, value, low, high in (
            ("number of samples", self.samples, 8, MAX_SEQUENCES),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("temperature", self.temperature, 1e-6, 1e6),
            ("noise [m/s]", self.noise_m_s, 0.0, MAX_SPEED_M_S),
            ("number of knots", self.knots, 1, MAX_HORIZON),
        ):
            if not low <= value <= high:
                raise InvalidInput(what, value, f"between {low} and {high}")


@dataclass(frozen=True, eq=False, slots=True)
class PlanRound:
    """One round of a plan.

    Attributes:
        number: of the round, from 0.
        actions: the plan so far [m/s].
        cost: of the best sequence so far.
        rollouts: all futures of the round.
        costs: theirs.
    """

    number: int
    actions: Float[np.ndarray, "T 3"]
    cost: float
    rollouts: Rollouts
    costs: Float[np.ndarray, "K"]


class Planner:
    """Plans pushes toward goals, again and again from the last plan.

    Args:
        rollout: predicts futures: state, actions, and the state one action ago if known.
        proposals: of pushes worth trying.
        settings: of the plan.
    """

    def __init__(self, rollout: Rollout, proposals: Proposals, settings: PlanSettings | None = None) -> None:
        self._rollout, self._proposals = rollout, proposals
        self.settings = settings or PlanSettings()
        self._last: Float[np.ndarray, "T 3"] | None = None

    def forget(self) -> None:
        """Begin anew: the goal or the scene is another one."""
        self._last = None

    def executed(self, count: int) -> None:
        """The first actions of the last plan have been taken."""
        if self._last is not None:
            self._last = np.concatenate([self._last[count:], np.zeros((min(count, len(self._last)), 3))])

    def plan(
        self,
        state: SceneState,
        goal: PoseGoal,
        cost: Cost,
        rng: np.random.Generator,
        before: SceneState | None = None,
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
        rollouts = self._rollout(state, first, before)
        costs = cost(rollouts)
        best = int(costs.argmin())
        yield PlanRound(0, first[best], float(costs[best]), rollouts, costs)
        second = self._around(first[best], self.settings.samples, rng)
        rollouts = self._rollout(state, second, before)
        costs = cost(rollouts)
        mean = np.einsum("k,kta->ta", _softmax(costs, self.settings.temperature), second)
        self._last = mean
        yield PlanRound(1, mean, float(costs.min()), rollouts, costs)

    def _first_round(self, state: SceneState, goal: PoseGoal, rng: np.random.Generator) -> Float[np.ndarray, "K T 3"]:
        """The last plan and some around it, pushes worth trying, and random walks."""
        settings = self.settings
        still = np.zeros((settings.horizon, 3))
        last = still if self._last is None else self._resized(self._last)
        off = max(int((np.linalg.norm(goal.offsets_m(state), axis=1) > 0).sum()), 1)
        pushes = self._proposals.draw(state, goal, max(settings.samples // (2 * off), 1), settings.horizon, rng)
        rest = max(settings.samples - len(pushes) - 1, 2)
        walks = self._around(still, rest // 3 + 1, rng, MAX_SPEED_M_S / 2)
        return np.concatenate([self._around(last, rest - rest // 3, rng), pushes, walks])

    def _resized(self, plan: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """The plan at today's horizon, which may have been changed since."""
        horizon = self.settings.horizon
        return np.concatenate([plan[:horizon], np.zeros((max(horizon - len(plan), 0), 3))])

    def _around(
        self, plan: Float[np.ndarray, "T 3"], count: int, rng: np.random.Generator, noise_m_s: float | None = None
    ) -> Float[np.ndarray, "K T 3"]:
        """The plan itself, and sequences around it whose differences change slowly."""
        settings = self.settings
        noise = settings.noise_m_s if noise_m_s is None else noise_m_s
        knots = rng.normal(0, noise, (count, settings.knots, 2))
        knots[0] = 0
        place = np.linspace(0, settings.knots - 1, settings.horizon)
        low = np.floor(place).astype(int).clip(0, max(settings.knots - 2, 0))
        share = (place - low)[:, None]
        smooth = (1 - share) * knots[:, low] + share * knots[:, np.minimum(low + 1, settings.knots - 1)]
        return (plan + np.pad(smooth, ((0, 0), (0, 0), (0, 1)))).clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)


def _softmax(costs: Float[np.ndarray, "K"], temperature: float) -> Float[np.ndarray, "K"]:
    spread = max(float(np.median(costs) - costs.min()), 1e-9)
    weights = np.exp(-(costs - costs.min()) / (temperature * spread))
    return weights / weights.sum()
