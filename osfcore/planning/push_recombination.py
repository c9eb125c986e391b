"""Recombination of rollouts: pushes that succeeded in some futures, done one after another in the best order.

A sampled sequence pushes several objects, and few samples push all of them well. Each future is cut into stages: the
actions from the first that moves an object up to the first that moves another one instead. What a stage does to an
object that nothing moved before, it does as well if it comes first. Sequences of up to three stages of different
objects are ranked by what they take from the cost of `pose_cost`, if stages do not disturb each other,

    sum_i g_i (2 + (T - t_i) / T),        t_i <= T,

with g_i what stage i takes from the sum of the objects' costs, and t_i when it ends. The best are returned as sequences
of actions with collision-free paths between the stages, to be rolled out. (As crossover recombines solutions in genetic
algorithms; here what is exchanged is known to work.)
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.planning.path_planning import FreeSpace, ShortestPaths, actions_along
from osfcore.planning.pose_cost import TERMINAL_WEIGHT
from osfcore.planning.push_order import OutlinesAt

_MOVED_M, _MOVED_Q = 1e-4, 1e-3  # by an action: in place, and a component of the quaternion
_STAGES = 3  # of a sequence, each of another object
_KEPT = 4  # stages of each object, which begin at different places
_APART_M = 0.003
_OBJECTS = 6  # those whose stages take most from the cost
_GAIN_M = 0.005  # a stage takes as much from the cost at least
_ACTION_PRICE_M = 0.003  # what an action counts where stages of one object are compared
_DETOUR = 1.0  # actions by which a path is longer than the straight one, about


@dataclass(frozen=True, eq=False, slots=True)
class PushStage:
    """Actions that bring an object nearer to its goal.

    Attributes:
        number: of the object.
        actions: velocities of the pusher [m/s].
        start: where the pusher begins [m].
        end: where it ends [m].
        pose: of the object then.
        gain: what is taken from the sum of the objects' costs [m].
    """

    number: int
    actions: Float[np.ndarray, "t 3"]
    start: Float[np.ndarray, "2"]
    end: Float[np.ndarray, "2"]
    pose: Pose
    gain: float


def recombined(
    rollouts: Rollouts, costs: Float[np.ndarray, "K T1 N"], outlines: OutlinesAt, count: int
) -> Float[np.ndarray, "C T 3"]:
    """Sequences made of stages of other sequences.

    Args:
        rollouts: futures of those, from one state.
        costs: of each object in them, before the first and after each action [m].
        outlines: tells those of an object at a pose [m].
        count: of sequences at most; fewer or none come back where no stage brings anything nearer.
    """
    horizon = rollouts.positions.shape[1] - 1
    pusher = rollouts.pusher[0, 0, :2]
    walks = _Walks(pusher, Pose(rollouts.positions[0, 0], rollouts.quaternions[0, 0]), outlines)
    chains = _best_chains(push_stages(rollouts, costs), pusher, horizon, count)
    sequences = [_actions(chain, walks, horizon) for chain in chains]
    return np.array(sequences).reshape(-1, horizon, 3)


def push_stages(rollouts: Rollouts, costs: Float[np.ndarray, "K T1 N"]) -> dict[int, list[PushStage]]:
    """The best stages of each object that any brings nearer, the best first.

    Args:
        rollouts: futures from one state.
        costs: of each object in them, before the first and after each action [m].
    """
    moves = _moves(rollouts)
    horizon, total = moves.shape[1], costs.sum(axis=2)
    first = np.where(moves.any(axis=1), moves.argmax(axis=1), horizon)
    found: dict[int, list[tuple[float, int, int, int]]] = defaultdict(list)
    for k, n in np.argwhere(first < horizon).tolist():
        begin = int(first[k, n])
        end = begin + 1 + _actions_alone(moves[k, begin + 1 :], n, first[k] > begin)
        gains = total[k, begin] - total[k, begin + 1 : end + 1]
        worth = gains - _ACTION_PRICE_M * np.arange(1, len(gains) + 1)
        last = int(worth.argmax())
        if gains[last] >= _GAIN_M:
            found[n].append((float(worth[last]), k, begin, begin + 1 + last))
    return {n: _distinct(n, sorted(every, reverse=True), rollouts, total) for n, every in found.items()}


def _actions_alone(moves: Bool[np.ndarray, "t N"], n: int, fresh: Bool[np.ndarray, "N"]) -> int:
    """Actions before the first that moves another object which nothing moved before, or another one instead of n."""
    others = moves & (np.arange(moves.shape[1]) != n)
    ends = (others & (fresh | ~moves[:, n, None])).any(axis=1)
    return int(ends.argmax()) if ends.any() else len(moves)


def _moves(rollouts: Rollouts) -> Bool[np.ndarray, "K T N"]:
    """Which objects each action moves."""
    shift = np.linalg.norm(np.diff(rollouts.positions, axis=1), axis=-1)
    turn = np.abs(np.diff(rollouts.quaternions, axis=1)).max(axis=-1)
    return (shift > _MOVED_M) | (turn > _MOVED_Q)


def _distinct(
    n: int, found: Sequence[tuple[float, int, int, int]], rollouts: Rollouts, total: Float[np.ndarray, "K T1"]
) -> list[PushStage]:
    """The first few stages that begin at different places, of (worth, sequence, first action, end)."""
    kept: list[PushStage] = []
    for _, k, begin, end in found:
        path = rollouts.pusher[k, begin : end + 1]
        if all(np.linalg.norm(path[0, :2] - other.start) > _APART_M for other in kept):
            actions = np.diff(path * [1, 1, 0], axis=0) / STEP_S
            pose = Pose(rollouts.positions[k, end, n], rollouts.quaternions[k, end, n])
            gain = float(total[k, begin] - total[k, end])
            actions = actions.clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)  # rounding
            kept.append(PushStage(n, actions, path[0, :2], path[-1, :2], pose, gain))
        if len(kept) == _KEPT:
            break
    return kept


def _best_chains(
    stages: Mapping[int, list[PushStage]], pusher: Float[np.ndarray, "2"], horizon: int, count: int
) -> list[list[PushStage]]:
    """Stages of different objects in the orders that take most from the cost, as far as is known before a rollout."""
    ranked = sorted(stages, key=lambda n: -max(stage.gain for stage in stages[n]))[:_OBJECTS]
    scored: list[tuple[float, list[PushStage]]] = []
    for order in permutations(ranked, min(_STAGES, len(ranked))):
        if order:
            scored += _scored_chains([stages[n] for n in order], pusher, horizon, count)
    scored.sort(key=lambda one: -one[0])
    return [chain for _, chain in scored[:count]]


def _scored_chains(
    choices: Sequence[list[PushStage]], pusher: Float[np.ndarray, "2"], horizon: int, count: int
) -> list[tuple[float, list[PushStage]]]:
    """The best choices of one stage of each object in a given order, with what they take from the cost."""
    at, when, score = pusher[None], np.zeros(1), np.zeros(1)
    for own in choices:
        starts, ends = (np.array([getattr(stage, place) for stage in own]) for place in ("start", "end"))
        takes, gains = (np.array(of, float) for of in zip(*((len(one.actions), one.gain) for one in own), strict=True))
        walk = np.ceil(np.abs(at[:, None] - starts).max(axis=-1) / (MAX_SPEED_M_S * STEP_S)) + _DETOUR
        done = when[:, None] + walk + takes
        gain = np.where(done <= horizon, gains * (TERMINAL_WEIGHT + (horizon - done) / horizon), 0.0)
        score, when, at = (score[:, None] + gain).ravel(), done.ravel(), np.tile(ends, (len(at), 1))
    best = np.argsort(-score, kind="stable")[:count]
    rows = np.unravel_index(best, [len(own) for own in choices])
    return [
        (float(score[k]), [own[i] for own, i in zip(choices, row, strict=True)])
        for k, row in zip(best, zip(*rows, strict=True), strict=True)
    ]


class _Walks:
    """Shortest paths to stages, when those before them have been done; computed once for each that begins alike."""

    def __init__(self, pusher: Float[np.ndarray, "2"], here: Pose, outlines: OutlinesAt) -> None:
        self._pusher, self._here, self._outlines = pusher, here, outlines
        self._known: dict[tuple[int, ...], ShortestPaths] = {}

    def to(self, stage: PushStage, done: Sequence[PushStage]) -> Float[np.ndarray, "n 2"]:
        """Corners of the path to the start of a stage [m]."""
        key = tuple(map(id, done))
        if key not in self._known:
            moved = {one.number: one.pose for one in done}
            places = [moved.get(n) or self._here[n] for n in range(len(self._here.position))]
            space = FreeSpace([part for n, pose in enumerate(places) for part in self._outlines(n, pose)])
            self._known[key] = space.paths_from(done[-1].end if done else self._pusher)
        return self._known[key].to(stage.start)


def _actions(chain: Sequence[PushStage], walks: _Walks, horizon: int) -> Float[np.ndarray, "T 3"]:
    """Walks and stages in turn, as long as there is time; then rest."""
    actions = np.zeros((0, 3))
    for number, stage in enumerate(chain):
        walk = actions_along(walks.to(stage, chain[:number]), horizon)
        moving = np.flatnonzero(walk.any(axis=1))
        walk = walk[: moving[-1] + 1 if len(moving) else 0]
        actions = np.concatenate([actions, walk, stage.actions])
        if len(actions) >= horizon:
            break
    return np.pad(actions[:horizon], ((0, max(horizon - len(actions), 0)), (0, 0)))
