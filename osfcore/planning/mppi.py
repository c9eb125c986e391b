"""MPPI (Williams et al., 2015) over rollouts of the dynamics model: lines 9 to 18 of the paper's Algorithm 1.

K sequences of T actions, a_k, are sampled, rolled out and scored, S_k = cost(rollout(a_k)). The plan is their average

    a = sum_k w_k a_k,        w_k = exp(-(S_k - min S) / lambda) / sum_j exp(-(S_j - min S) / lambda),

and the next plan is warm-started from it, shifted by the actions that were executed.

Deviations from the paper:

- Samples come from three sources: perturbations of the nominal sequence, push proposals, and random walks. Successful
  pushes of different samples are then recombined.
- The average is taken over a second round of samples, around the best of the first. Over the first round it would fail:
  the mean of a path around the left and one around the right of an object leads into the object.
- The second round has a shorter horizon, since later actions are planned again before they are executed. Only every
  third plan has a first round. Plans in which the pusher only walks for now have no second round.
- The average, or the best sample, replaces the plan so far if it costs less over the whole horizon.
- The cost of the finalists is the mean over starts of the pusher a few millimetres apart. A push that slips off the
  object from one of these starts is likely to slip off in the world as well.
- lambda is relative to the spread of the costs, temperature * (median S - min S).
- Noise is added at knots of the pusher's path and not to its velocity, so that its variance does not grow along the
  horizon.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, check_ranges
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S
from osfcore.planning.costs import Cost, PoseGoal
from osfcore.planning.paths import actions_along

_SOON, _TOUCHED_M = 3, 1e-4  # a plan is refined where it moves something by so much after as many actions or fewer
COMPARED = 3  # sequences that are rolled out once more after the second round, over the whole horizon
_FINALISTS = 24  # sequences of the first round that are rolled out from other begins
_BEGINS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_RANDOM_WALK_M = 0.06  # standard deviation of random walks at their knots
WAYS = 24  # of the pusher that a sketch keeps

Rollout = Callable[[SceneState, Float[np.ndarray, "K T 3"], SceneState | None], Rollouts]


class PushSource(Protocol):
    """Proposes sequences of pushes. It is a protocol, so that the page can draw plans without loading torch."""

    def draw(
        self, state: SceneState, goal: PoseGoal, count: int, horizon: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "P T 3"]:
        """Return sequences of actions [m/s].

        Args:
            state: state of the scene, with a pusher.
            goal: the goal poses.
            count: number of sequences wanted. Fewer may come back, and none if nothing needs a push.
            horizon: actions in each sequence (T).
            rng: random generator.
        """
        ...

    def recombine(self, goal: PoseGoal, rollouts: Rollouts, count: int) -> Float[np.ndarray, "P T 3"]:
        """Return at most `count` sequences that combine successful pushes of different futures.

        Args:
            goal: the goal poses.
            rollouts: futures that begin in one state.
            count: largest number of sequences.
        """
        ...


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """Settings of `MPPIPlanner`.

    Attributes:
        samples: sequences of actions in each of the two rounds (K).
        horizon: actions in each sequence (T).
        temperature: temperature of the softmax, as a share of the difference between median and least cost in the
            second round.
        noise_m: standard deviation of the pusher's path around the plan [m].
        knot_every: actions from one knot of the noise to the next. Between knots the noise is linear.
        refined: actions at the beginning of the plan that the second round changes.
        proposals_every: plans of which one has a first round. The others refine the nominal sequence alone.
        recombined: sequences that combine successful pushes of the first round; 0 for none.
        begins_m: offset of the pusher's start in the rollouts over which costs are averaged [m]; 0 for no averaging.

    Raises:
        InvalidInput: if a value is out of range.
    """

    samples: int = 160
    horizon: int = 30
    temperature: float = 0.03
    noise_m: float = 0.008
    knot_every: int = 3
    refined: int = 12
    proposals_every: int = 3
    recombined: int = 12
    begins_m: float = 0.003

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            ("number of samples", self.samples, 8, MAX_SEQUENCES),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("temperature", self.temperature, 1e-6, 1e6),
            ("noise [m]", self.noise_m, 0.0, PUSHER_REACH_M),
            ("actions between knots", self.knot_every, 1, MAX_HORIZON),
            ("refined actions", self.refined, 1, MAX_HORIZON),
            ("plans of which one draws proposals", self.proposals_every, 1, MAX_HORIZON),
            ("number of recombined sequences", self.recombined, 0, MAX_SEQUENCES),
            ("distance of begins [m]", self.begins_m, 0.0, PUSHER_REACH_M),
        )


@dataclass(frozen=True, eq=False, slots=True)
class PlanRound:
    """One round of a plan.

    Attributes:
        number: 0 for the first round, which samples whole plans; 1 for the second, which refines the best one.
        actions: the plan so far [m/s]. After the second round, its first actions may be the softmax average.
        rollouts: all futures of the round. Those of the second round are shorter.
        costs: costs of the futures.
        chosen: index of the chosen sequence; None for the one with the least cost.
    """

    number: int
    actions: Float[np.ndarray, "T 3"]
    rollouts: Rollouts
    costs: Float[np.ndarray, "K"]
    chosen: int | None = None

    @property
    def best(self) -> Rollouts:
        """The future of the chosen sequence, with K = 1. The future of the plan itself is close to it."""
        return self.rollouts[int(self.costs.argmin()) if self.chosen is None else self.chosen]


@dataclass(frozen=True, eq=False, slots=True)
class PlanSketch:
    """The part of a planning round that a picture shows.

    Attributes:
        step: actions executed so far.
        ways: paths of the pusher in the world [m], in order of their costs.
        costs: costs of the paths, ascending.
        best: the future with the least cost, with K = 1.
    """

    step: int
    ways: Float[np.ndarray, "W T1 2"]
    costs: Float[np.ndarray, "W"]
    best: Rollouts


def sketch_of(step: int, round_: PlanRound) -> PlanSketch:
    """Return the best future, and paths spread evenly over all ranks of cost."""
    order = np.argsort(round_.costs, kind="stable")
    chosen = order[np.round(np.linspace(0, len(order) - 1, min(WAYS, len(order)))).astype(int)]
    ways = round_.rollouts.pusher[chosen, :, :2].astype(np.float32)
    return PlanSketch(step, ways, round_.costs[chosen], round_.best)


class MPPIPlanner:
    """A receding-horizon planner (MPPI) that starts each plan from the last one.

    Its plan is the "nominal sequence" of actions. `plan` improves it, `nominal` returns its next actions, and `shift`
    drops those that were executed.

    Args:
        rollout: function that predicts futures from a state, actions, and the state one action earlier or None.
        proposals: source of pushes that are likely to be useful.
        settings: settings of the plan.

    Example:
        >>> from osfcore.planning.mppi import PlanSettings
        >>> planner = MPPIPlanner(
        ...     push_model.rollout,
        ...     PushProposals(load_shapes(None, fields, [name])),
        ...     PlanSettings(samples=32, horizon=10),
        ... )
        >>> first, second = planner.plan(state, goal, PoseCost(goal), np.random.default_rng(0))
        >>> bool(first.costs.min() < 0.24)  # less than doing nothing
        True
        >>> planner.nominal(3).shape  # the next three actions [m/s]
        (3, 3)
    """

    def __init__(self, rollout: Rollout, proposals: PushSource, settings: PlanSettings | None = None) -> None:
        self._rollout, self._proposals = rollout, proposals
        self.settings = settings or PlanSettings()
        self._nominal: Float[np.ndarray, "T 3"] | None = None
        self._refinements = 0  # plans since the last first round
        self._known: PlanRound | None = None  # the nominal sequence's own future, the last time it was rolled out

    def reset(self) -> None:
        """Forget the nominal sequence, because the goal or the scene has changed."""
        self._nominal = self._known = None

    def nominal(self, count: int) -> Float[np.ndarray, "count 3"]:
        """Return the next actions of the nominal sequence [m/s]; zeros after its end, or without a plan."""
        plan = np.zeros((0, 3)) if self._nominal is None else self._nominal[:count]
        return np.concatenate([plan, np.zeros((count - len(plan), 3))])

    def shift(self, count: int) -> None:
        """Drop executed actions from the beginning of the nominal sequence, from which the next plan starts."""
        if self._known is not None:
            self._known = replace(self._known, rollouts=self._known.rollouts.after(count))
        if self._nominal is not None:
            self._nominal = np.concatenate([self._nominal[count:], np.zeros((min(count, len(self._nominal)), 3))])

    def plan(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None = None
    ) -> Iterator[PlanRound]:
        """Plan in up to two rounds.

        The first round samples new sequences. It runs in every third plan (`proposals_every`), and whenever the nominal
        sequence has ended. The second round refines the nominal sequence. It is skipped while the pusher still walks
        without touching anything soon.

        Args:
            state: state of the scene, with a pusher.
            goal: goal poses, toward which pushes are proposed.
            cost: cost of futures, which the plan minimises.
            rng: random generator of all samples.
            before: state of the same objects one action earlier, which gives their velocities; at rest if None.

        Yields:
            Each round after it was computed.

        Raises:
            InvalidInput: if the state has no pusher.
        """
        if state.pusher is None:
            raise InvalidInput("pusher of the state to plan from", "missing", "its centre [m]")
        self._refinements += 1
        if self._nominal is None or self._refinements >= self.settings.proposals_every or not self._nominal[0].any():
            self._refinements = 0
            round_ = self._first_round(state, goal, cost, rng, before)
            yield round_
            self._follow(round_)
        nominal = self.nominal(self.settings.horizon)  # which may have been changed since
        if self._known is not None and _walks(self._known.rollouts) > _SOON:
            self._nominal = nominal
            yield replace(self._known, number=1, actions=nominal)
            return
        begin, rest = np.split(nominal, [self.settings.refined])
        keep_end = self.settings.knot_every < len(begin) and len(rest) > 0
        second = self._perturbed(begin, self.settings.samples, rng, self.settings.noise_m, keep_end=keep_end)
        second[1] = _hurried(begin)
        round_ = self._evaluate(1, state, second, cost, before)
        mean = np.einsum("k,kta->ta", _mppi_weights(round_.costs, self.settings.temperature), second)
        plans = np.stack([np.concatenate([head, rest]) for head in (mean, begin, round_.actions)])
        # Over the whole horizon: later pushes need the objects where they were expected.
        whole = self._chosen(self._evaluate(1, state, plans, cost, before), plans, state, cost, before)
        self._follow(whole)
        yield replace(round_, actions=whole.actions)

    def _follow(self, round_: PlanRound) -> None:
        """Make the chosen sequence of a round the nominal one."""
        assert round_.chosen is not None
        self._nominal = round_.actions
        self._known = replace(round_, rollouts=round_.best, costs=round_.costs[[round_.chosen]], chosen=None)

    def _first_round(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None
    ) -> PlanRound:
        actions = self._sample_first_round(state, goal, rng)
        round_ = self._evaluate(0, state, actions, cost, before)
        count = self.settings.recombined
        more = self._proposals.recombine(goal, round_.rollouts, count) if count else actions[:0]
        if len(more):
            actions = np.concatenate([actions, more])
            other = self._evaluate(0, state, more, cost, before)
            rollouts = Rollouts.joined([round_.rollouts, other.rollouts])
            round_ = PlanRound(0, round_.actions, rollouts, np.concatenate([round_.costs, other.costs]))
        return self._chosen(round_, actions, state, cost, before)

    def _chosen(
        self, round_: PlanRound, actions: Float[np.ndarray, "K T 3"], state: SceneState, cost: Cost,
        before: SceneState | None,
    ) -> PlanRound:  # fmt: skip
        """Return the round with the sequence as its plan that costs least on average over starts of the pusher."""
        finalists = np.argsort(round_.costs, kind="stable")[: _FINALISTS if self.settings.begins_m else 1]
        total = round_.costs[finalists]
        if len(finalists) > 1:
            assert state.pusher is not None
            for begin in self.settings.begins_m * np.pad(_BEGINS, ((0, 0), (0, 1))):
                elsewhere = replace(state, pusher=state.pusher + begin)
                total = total + cost(self._rollout(elsewhere, actions[finalists], before))
        chosen = int(finalists[total.argmin()])
        return replace(round_, actions=actions[chosen], chosen=chosen)

    def _evaluate(
        self, number: int, state: SceneState, actions: Float[np.ndarray, "K T 3"], cost: Cost, before: SceneState | None
    ) -> PlanRound:
        rollouts = self._rollout(state, actions, before)
        costs = cost(rollouts)
        return PlanRound(number, actions[int(costs.argmin())], rollouts, costs)

    def _sample_first_round(
        self, state: SceneState, goal: PoseGoal, rng: np.random.Generator
    ) -> Float[np.ndarray, "K T 3"]:
        """Return the nominal sequence and perturbations of it, random walks, and push proposals."""
        settings = self.settings
        nominal, share = self.nominal(settings.horizon), settings.samples // 8
        walks = self._perturbed(np.zeros_like(nominal), share, rng, _RANDOM_WALK_M)
        around = self._perturbed(nominal, share, rng, settings.noise_m)
        if share > 1:
            around[1] = _hurried(nominal)
        pushes = self._proposals.draw(state, goal, settings.samples - 2 * share, settings.horizon, rng)
        return np.concatenate([around, walks, pushes])

    def _perturbed(
        self,
        plan: Float[np.ndarray, "T 3"],
        count: int,
        rng: np.random.Generator,
        noise_m: float,
        *,
        keep_end: bool = False,
    ) -> Float[np.ndarray, "K T 3"]:
        """Perturb the path of a sequence by noise that is linear between knots.

        Args:
            plan: the sequence [m/s].
            count: number of sequences to return.
            rng: random generator of the noise.
            noise_m: standard deviation of the noise at the knots [m].
            keep_end: whether the end of the path stays the same.

        Returns:
            `count` sequences; the first is the plan itself.
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


def _hurried(plan: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the same path at full speed. The average of many sequences would pause wherever one of them does."""
    path = STEP_S * np.pad(np.cumsum(plan[:, :2], axis=0), ((1, 0), (0, 0)))
    return actions_along(path, len(plan))


def _walks(future: Rollouts) -> int:
    """Return the number of actions before the first that moves something; 0 if none does."""
    shift = np.linalg.norm(future.positions[0] - future.positions[0, :1], axis=-1).max(axis=-1, initial=0.0)
    moving = np.flatnonzero(shift > _TOUCHED_M)
    return int(moving[0]) - 1 if len(moving) else 0


def _mppi_weights(costs: Float[np.ndarray, "K"], temperature: float) -> Float[np.ndarray, "K"]:
    """Return the softmax weights w_k, with lambda = temperature * (median S - min S)."""
    spread = max(float(np.median(costs) - costs.min()), 1e-9)
    weights = np.exp(-(costs - costs.min()) / (temperature * spread))
    return weights / weights.sum()
