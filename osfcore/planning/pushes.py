"""Push proposals for MPPI: sequences that push one object after another to its goal.

This file has the order of the objects with detours around others, tables of straight pushes and their effects,
sequences of up to three pushes, and recombination of pushes that succeeded in different futures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, islice, permutations
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree

from osfcore.dynamics.shapes import ObjectShape, ShapeTable, part_outlines
from osfcore.geometry.poses import (
    UPRIGHT_RAD,
    Pose,
    planar_turn,
    planar_turns,
    quaternion_conjugate,
    quaternion_multiply,
    rotation_angle,
)
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S, WORKSPACE_HALF_M
from osfcore.planning.costs import ARM_M, TERMINAL_WEIGHT, PoseGoal, object_costs
from osfcore.planning.paths import CELL_M, CLEARANCE_M, FreeSpace, ShortestPaths, actions_along, duration_s

# The order in which objects are pushed, and their intermediate goals: blocked goals, swaps and detours.
#
# - An object whose goal is occupied waits until the other object has left.
# - If objects wait for each other, one of them is first pushed to a buffer, a free place near its way.
# - An object whose straight way is blocked is pushed to the corners of the shortest path around the obstacle.
#
# Buffers and dependency graphs are those of tabletop rearrangement (Han et al., 2018). Detours are paths of a disc as
# wide as the object.


_PERMUTATIONS = 720  # looked at; all of six objects
_BUFFER_CELLS = 4  # grid cells from one candidate for a buffer to the next
_MIN_DETOUR_M = 0.03  # of a path from the straight way; less is left to the pushes
_CHECKED = 60  # places on a straight way
_CORNERS = 3  # of a detour; a longer one is no way to push something along
_ROOM_M = WORKSPACE_HALF_M + 0.05  # of an object's centre from the table's, on each axis

Outlines = list[Float[np.ndarray, "_ 2"]]  # of an object's convex parts
OutlinesAt = Callable[[int, Pose], Outlines]


@dataclass(frozen=True, eq=False, slots=True)
class Stage:
    """A goal or an intermediate goal of one object.

    Attributes:
        number: index of the object.
        target: pose `T_world_object` to push it to.
    """

    number: int
    target: Pose


def push_orders(
    now: Sequence[Pose],
    goals: Sequence[Pose],
    off: Sequence[int],
    outlines: OutlinesAt,
    count: int,
    rng: np.random.Generator,
) -> list[tuple[Stage, ...]]:
    """Return orders of stages that bring all objects to their goals.

    Args:
        now: present poses of the objects.
        goals: goal poses of the objects.
        off: indices of the objects that are not at their goals.
        outlines: function that returns the outlines of an object at a pose [m].
        count: largest number of orders.
        rng: random generator, which draws among possible orders.
    """
    waits = _dependencies(now, goals, off, outlines)
    every = list(permutations(off)) if len(off) <= 6 else [tuple(rng.permutation(off)) for _ in range(_PERMUTATIONS)]
    possible = [order for order in every if _is_possible(order, waits, frozenset())]
    if possible:
        chosen = [possible[k] for k in rng.permutation(len(possible))[:count]]
        plain = [tuple(Stage(n, goals[n]) for n in order) for order in chosen]
    else:
        plain = list(_with_buffers(now, goals, every, waits, outlines, count, rng))
    both = ((_with_detours(order, now, outlines), order) for order in plain)
    return [one for around, straight in both for one in (around, straight)[: 1 + (len(around) > len(straight))]][:count]


def _dependencies(
    now: Sequence[Pose], goals: Sequence[Pose], off: Sequence[int], outlines: OutlinesAt
) -> dict[int, frozenset[int]]:
    """Return for each object the objects that occupy its goal and will leave it."""
    taken = {n: FreeSpace(outlines(n, now[n]), 0.0).clearance < CLEARANCE_M for n in off}
    wanted = {n: FreeSpace(outlines(n, goals[n]), 0.0).clearance <= 0 for n in off}
    return {n: frozenset(other for other in off if other != n and np.any(wanted[n] & taken[other])) for n in off}


def _is_possible(order: Sequence[int], waits: dict[int, frozenset[int]], away: frozenset[int]) -> bool:
    gone = set(away)
    for n in order:
        if not waits[n] <= gone:
            return False
        gone.add(n)
    return True


def _with_buffers(
    now: Sequence[Pose], goals: Sequence[Pose], every: Sequence[tuple[int, ...]], waits: dict[int, frozenset[int]],
    outlines: OutlinesAt, count: int, rng: np.random.Generator,
) -> Iterator[tuple[Stage, ...]]:  # fmt: skip
    """Yield orders that begin by moving one object to a buffer, or one plain order if there is none."""
    found = 0
    for k in rng.permutation(len(every)):
        order = every[k]
        aside = next((n for n in order[::-1] if _is_possible(order, waits, frozenset([n]))), None)
        buffer = None if aside is None else _buffer(aside, now, goals, outlines)
        if aside is not None and buffer is not None:
            yield (Stage(aside, buffer), *(Stage(n, goals[n]) for n in order))
            found += 1
            if found == count:
                return
    if not found:
        yield tuple(Stage(n, goals[n]) for n in every[0])


def _buffer(n: int, now: Sequence[Pose], goals: Sequence[Pose], outlines: OutlinesAt) -> Pose | None:
    """Return a free place for an object near its way, clear of the present and goal poses of all others."""
    others = [part for k in range(len(now)) for pose in (now[k], goals[k]) if k != n for part in outlines(k, pose)]
    space = FreeSpace([*others, *outlines(n, goals[n])], 0.0)
    radius = np.linalg.norm(np.concatenate(outlines(n, now[n])) - now[n].position[:2], axis=1).max()
    along = np.arange(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, _BUFFER_CELLS * CELL_M)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    free = places[space.clearance_at(places) >= radius + CLEARANCE_M]
    if not len(free):
        return None
    ends = (now[n].position[:2], goals[n].position[:2])
    way = np.sum([np.linalg.norm(free - end, axis=1) for end in ends], axis=0)
    return _moved(now[n], free[way.argmin()])


def _with_detours(order: Sequence[Stage], now: Sequence[Pose], outlines: OutlinesAt) -> tuple[Stage, ...]:
    places, stages = list(now), []
    for stage in order:
        n = stage.number
        corners = _corners(n, places, stage.target, outlines)
        stages += [*(Stage(n, _moved(places[n], corner)) for corner in corners), stage]
        places[n] = stage.target
    return tuple(stages)


def _corners(n: int, places: Sequence[Pose], target: Pose, outlines: OutlinesAt) -> Float[np.ndarray, "C 2"]:
    """Return the corners of an object's way around others; none if the straight way is clear."""
    others = [part for k in range(len(places)) if k != n for part in outlines(k, places[k])]
    begin, end = places[n].position[:2], target.position[:2]
    none = np.zeros((0, 2))
    if not others or np.linalg.norm(end - begin) < 2 * _MIN_DETOUR_M:
        return none
    way = (end - begin) / max(float(np.linalg.norm(end - begin)), 1e-9)
    breadth = float(np.ptp(np.concatenate(outlines(n, places[n])) @ np.array([-way[1], way[0]])))  # across the way
    space = FreeSpace(others, breadth / 2)
    if np.all(space.is_free(np.linspace(begin, end, _CHECKED))):
        return none
    path = space.paths_from(begin).to(end)
    corners = cv2.approxPolyDP(path.astype(np.float32), _MIN_DETOUR_M, closed=False)[1:-1, 0].astype(float)
    return none if len(corners) > _CORNERS or np.abs(corners).max(initial=0.0) > _ROOM_M else corners


def _moved(pose: Pose, place: Float[np.ndarray, "2"]) -> Pose:
    return Pose(np.array([*place, pose.position[2]]), pose.quaternion)


# The effect of straight pushes on one object: a table of pushes from all sides and of the resulting motions.
#
# The table is in a frame at the object's centre of mass that turns with its yaw. It is valid for all positions and yaw
# angles of the object, as long as the object rests on the same side. The learned dynamics model fills the table: over
# 24 cm its median error is 3 to 5 deg, that of the quasi-static limit surface 10 to 20 deg.


_SPARE_M = 0.003  # from where a push starts to what must stay clear
_PLACES = 36  # of contact, around the outline
_SLANTS_RAD = (-0.6, -0.3, 0.0, 0.3, 0.6)  # of the direction from the normal
_SPEED_M_S = 0.2
_ACTIONS = 6  # of each push
_BETWEEN = 4  # lengths for each action, by interpolation
_PIXEL_M = 0.001
_CORNER_M = 0.001  # by how much the outline may be simplified
_ROUND = 24  # directions in which the loop around an object is rounded


class PushPredictor(Protocol):
    """Predicts pushes from several starts of the pusher: `PushModel.rollout`."""

    def __call__(
        self,
        state: SceneState,
        actions: Float[np.ndarray, "K T 3"],
        before: SceneState | None = None,
        pushers: Float[np.ndarray, "K 2"] | None = None,
    ) -> Rollouts:
        """Predict poses under K sequences of T actions, each with its own start of the pusher [m]."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class PushOutcomes:
    """P straight pushes and the poses of the object after S lengths of each, in the object's planar frame.

    Attributes:
        starts: position of the pusher's centre at the start, clear of the object [m].
        directions: unit vectors.
        lengths: lengths of the way from the start [m].
        centres: centres of mass [m].
        quaternions: orientations.
        loop: closed path around the object, clear of it, counterclockwise [m].
    """

    starts: Float[np.ndarray, "P 2"]
    directions: Float[np.ndarray, "P 2"]
    lengths: Float[np.ndarray, "S"]
    centres: Float[np.ndarray, "P S 2"]
    quaternions: Float[np.ndarray, "P S 4"]
    loop: Float[np.ndarray, "L 2"]


def push_outcomes(
    predict: PushPredictor | None,
    state: SceneState,
    centre: Float[np.ndarray, "3"],
    outlines: Sequence[Float[np.ndarray, "_ 2"]],
) -> PushOutcomes:
    """Return the table of pushes of an object.

    Args:
        predict: predicts the effect of pushes; None for an empty table.
        state: state of a scene with this object alone.
        centre: centre of mass, in the object's frame [m].
        outlines: outlines of its convex parts seen from above [m].
    """
    pose = state.poses[0]
    origin = pose.apply(centre)[:2]
    outline = silhouette(outlines) - origin
    starts, directions = _candidates(outline) if predict is not None else (np.zeros((0, 2)), np.zeros((0, 2)))
    lengths = _SPEED_M_S * STEP_S / _BETWEEN * np.arange(1, _ACTIONS * _BETWEEN + 1)
    if predict is None or not len(starts):
        none = np.zeros((len(starts), len(lengths), 4))
        return PushOutcomes(starts, directions, lengths, none[..., :2], none, _loop(outline))
    actions = np.broadcast_to(np.pad(_SPEED_M_S * directions, ((0, 0), (0, 1)))[:, None], (len(starts), _ACTIONS, 3))
    futures = predict(state, actions, None, starts + origin)
    poses = Pose(futures.positions[:, :, 0], futures.quaternions[:, :, 0])
    centres = _between(poses.apply(centre)[..., :2] - origin)
    quaternions = _between(poses.quaternion)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return PushOutcomes(starts, directions, lengths, centres, quaternions, _loop(outline))


def _between(values: Float[np.ndarray, "P T1 D"]) -> Float[np.ndarray, "P S D"]:
    """Interpolate linearly in time, without the first moment."""
    share = np.arange(1, _BETWEEN + 1)[:, None] / _BETWEEN
    parts = values[:, :-1, None] * (1 - share) + values[:, 1:, None] * share
    return parts.reshape(len(values), -1, values.shape[2])


def silhouette(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "V 2"]:
    """Trace the outer outline of a union of convex outlines, counterclockwise, within a millimetre [m].

    Gaps that the pusher does not fit into are closed. Pieces that are still separate are joined by their convex hull.
    """
    every = np.concatenate(list(outlines))
    border = PUSHER_RADIUS_M + 3 * _PIXEL_M
    low = every.min(axis=0) - border
    columns, rows = np.ceil((every.max(axis=0) + border - low) / _PIXEL_M).astype(int) + 1
    solid = np.zeros((rows, columns), np.uint8)
    for part in outlines:
        cv2.fillConvexPoly(solid, np.rint((part - low) / _PIXEL_M).astype(np.int32), 1)
    width = 2 * round(PUSHER_RADIUS_M / _PIXEL_M) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    contours, _ = cv2.findContours(
        cv2.morphologyEx(solid, cv2.MORPH_CLOSE, disc), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    outer = contours[0] if len(contours) == 1 else cv2.convexHull(np.concatenate(contours))
    points = cv2.approxPolyDP(outer, _CORNER_M / _PIXEL_M, closed=True)[:, 0] * _PIXEL_M + low
    area = np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1))
    return points if area > 0 else points[::-1].copy()


def _candidates(outline: Float[np.ndarray, "V 2"]) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2"]]:
    """Return starts and directions of pushes from all sides."""
    points = _spaced(outline, _PLACES)
    tangent = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    angle = np.arctan2(-normal[:, 1], -normal[:, 0])[:, None] + np.array(_SLANTS_RAD)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    back = (CLEARANCE_M + _SPARE_M) / np.cos(_SLANTS_RAD)[:, None]
    starts = ((points + PUSHER_RADIUS_M * normal)[:, None] - back * directions).reshape(-1, 2)
    border = _spaced(outline, 8 * _PLACES)
    distance = np.linalg.norm(starts[:, None] - border, axis=2).min(axis=1)
    clear = distance >= PUSHER_RADIUS_M + CLEARANCE_M
    return starts[clear], directions.reshape(-1, 2)[clear]


def _spaced(outline: Float[np.ndarray, "V 2"], count: int) -> Float[np.ndarray, "count 2"]:
    """Return equally spaced points along a closed line."""
    return _along_closed(outline, lambda length: (np.arange(count) + 0.5) / count * length)


def _along_closed(
    outline: Float[np.ndarray, "V 2"], places: Callable[[float], Float[np.ndarray, "n"]]
) -> Float[np.ndarray, "n 2"]:
    """Return points of a closed line at distances from its first corner; `places` computes them from its length."""
    closed = np.vstack([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = places(along[-1])
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in range(2)], axis=1)


def _loop(outline: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "L 2"]:
    """Return the convex hull, widened by the pusher and its clearance."""
    angles = 2 * np.pi * np.arange(_ROUND) / _ROUND
    wide = (PUSHER_RADIUS_M + CLEARANCE_M + 2 * _SPARE_M) / np.cos(np.pi / _ROUND)
    rim = wide * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = (outline[:, None] + rim).reshape(-1, 2)
    return points[ConvexHull(points).vertices]


# Straight pushes of one object: where the pusher starts behind it, and where it ends.


_ANGLE_RAD = 0.2  # sigma of the push's direction around that of the goal
_ASIDE = 0.2  # sigma of the push's offset from the middle, of half the object's breadth
_LENGTHS = (0.6, 1.15)  # of the distance to go
_APART_M = 0.005
_MEETS_M = PUSHER_RADIUS_M + 0.01  # beside the pusher's line, what of an outline it may meet


def outline_points(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "n 2"]:
    """Return points at most 5 mm apart all along the outlines of an object's convex parts [m]."""

    def places(length: float) -> Float[np.ndarray, "n"]:
        return np.linspace(0, length, max(int(np.ceil(length / _APART_M)), 1), endpoint=False)

    return np.concatenate([points for own in outlines for points in (own, _along_closed(own, places))])


def straight_pushes(
    outline: Float[np.ndarray, "K 2"], offset: Float[np.ndarray, "2"], count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "count 2"], Float[np.ndarray, "count 2"]]:
    """Draw straight pushes that move an object about as far as its goal is away.

    Args:
        outline: points all along the object's outline from above, see `outline_points` [m].
        offset: vector from the object to its goal [m], not zero.
        count: number of pushes.
        rng: random generator of directions, offsets from the middle, and lengths.

    Returns:
        Starts of the pusher's centre, clear of the object, and its ends [m].
    """
    direction_to, distance = np.arctan2(offset[1], offset[0]), np.linalg.norm(offset)
    turn = rng.normal(0, _ANGLE_RAD, count)
    aside_by, share = rng.normal(0, _ASIDE, count).clip(-1, 1), rng.uniform(*_LENGTHS, count)
    angle = direction_to + turn
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    along, across = outline @ direction.T, outline @ side.T  # K x P
    low, high = across.min(axis=0), across.max(axis=0)
    aside = (low + high) / 2 + aside_by * (high - low) / 2
    back = np.where(np.abs(across - aside) <= _MEETS_M, along, np.inf).min(axis=0)
    back = np.where(np.isfinite(back), back, along.min(axis=0))
    touching = back - PUSHER_RADIUS_M
    lateral = aside[:, None] * side
    starts = (touching - CLEARANCE_M - _SPARE_M)[:, None] * direction + lateral
    return starts, (touching + distance * share)[:, None] * direction + lateral


# Recombination of rollouts: pushes that succeeded in some futures, done one after another in the best order.
#
# A sampled sequence pushes several objects, and few samples push all of them well. Each future is cut into stages: the
# actions from the first that moves an object up to the first that moves another one instead. A stage whose object
# nothing moved before has the same effect if it comes first. Sequences of up to three stages of different objects are
# ranked by how much they lower the cost of `PoseCost`, if stages do not disturb each other,
#
#     sum_i g_i (2 + (T - t_i) / T),        t_i <= T,
#
# with g_i the amount by which stage i lowers the sum of the objects' costs, and t_i its end. The best are returned as
# sequences of actions with collision-free paths between the stages, to be rolled out. This is like crossover in genetic
# algorithms, except that the exchanged parts are known to work.


_MOVED_M, _MOVED_Q = 1e-4, 1e-3  # by an action: in place, and a component of the quaternion
_STAGES = 3  # of a sequence, each of another object
_KEPT = 4  # stages of each object, which begin at different places
_ENDS_APART_M = 0.003
_OBJECTS = 6  # those whose stages take most from the cost
_GAIN_M = 0.005  # a stage takes as much from the cost at least
_ACTION_PRICE_M = 0.003  # what an action counts where stages of one object are compared
_DETOUR = 1.0  # actions by which a path is longer than the straight one, about


@dataclass(frozen=True, eq=False, slots=True)
class PushStage:
    """Actions that bring an object closer to its goal.

    Attributes:
        number: index of the object.
        actions: velocities of the pusher [m/s].
        start: position of the pusher at the start [m].
        end: position of the pusher at the end [m].
        pose: pose of the object at the end.
        gain: decrease of the sum of the objects' costs [m].
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
    """Combine stages of different sequences into new sequences.

    Args:
        rollouts: futures of the sequences, all from one state.
        costs: costs of each object in them, before the first and after each action [m].
        outlines: function that returns the outlines of an object at a pose [m].
        count: largest number of new sequences. Fewer or none come back if no stage brings an object closer.
    """
    horizon = rollouts.positions.shape[1] - 1
    pusher = rollouts.pusher[0, 0, :2]
    walks = _Walks(pusher, Pose(rollouts.positions[0, 0], rollouts.quaternions[0, 0]), outlines)
    chains = _best_chains(push_stages(rollouts, costs), pusher, horizon, count)
    sequences = [_actions(chain, walks, horizon) for chain in chains]
    return np.array(sequences).reshape(-1, horizon, 3)


def push_stages(rollouts: Rollouts, costs: Float[np.ndarray, "K T1 N"]) -> dict[int, list[PushStage]]:
    """Return the best stages of each object, the best first, if any brings it closer to its goal.

    Args:
        rollouts: futures that begin in one state.
        costs: costs of each object in them, before the first and after each action [m].
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
    """Count actions before the first that moves an object for the first time, or another object instead of n."""
    others = moves & (np.arange(moves.shape[1]) != n)
    ends = (others & (fresh | ~moves[:, n, None])).any(axis=1)
    return int(ends.argmax()) if ends.any() else len(moves)


def _moves(rollouts: Rollouts) -> Bool[np.ndarray, "K T N"]:
    """Return which objects each action moves."""
    shift = np.linalg.norm(np.diff(rollouts.positions, axis=1), axis=-1)
    turn = np.abs(np.diff(rollouts.quaternions, axis=1)).max(axis=-1)
    return (shift > _MOVED_M) | (turn > _MOVED_Q)


def _distinct(
    n: int, found: Sequence[tuple[float, int, int, int]], rollouts: Rollouts, total: Float[np.ndarray, "K T1"]
) -> list[PushStage]:
    """Return the first few stages with different starts, given (worth, sequence, first action, end)."""
    kept: list[PushStage] = []
    for _, k, begin, end in found:
        path = rollouts.pusher[k, begin : end + 1]
        if all(np.linalg.norm(path[0, :2] - other.start) > _ENDS_APART_M for other in kept):
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
    """Chain stages of different objects in the orders that lower the cost most, as predicted before a rollout."""
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
    """Return the best choices of one stage of each object in this order, with their decrease of the cost."""
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
    """Shortest paths to stages after earlier stages. Each path is computed once for all chains that begin alike."""

    def __init__(self, pusher: Float[np.ndarray, "2"], here: Pose, outlines: OutlinesAt) -> None:
        self._pusher, self._here, self._outlines = pusher, here, outlines
        self._known: dict[tuple[int, ...], ShortestPaths] = {}

    def to(self, stage: PushStage, done: Sequence[PushStage]) -> Float[np.ndarray, "n 2"]:
        """Return the corners of the path to the start of a stage [m]."""
        key = tuple(map(id, done))
        if key not in self._known:
            moved = {one.number: one.pose for one in done}
            places = [moved.get(n) or self._here[n] for n in range(len(self._here.position))]
            space = FreeSpace([part for n, pose in enumerate(places) for part in self._outlines(n, pose)])
            self._known[key] = space.paths_from(done[-1].end if done else self._pusher)
        return self._known[key].to(stage.start)


def _actions(chain: Sequence[PushStage], walks: _Walks, horizon: int) -> Float[np.ndarray, "T 3"]:
    """Return the actions of walks and stages in turn, up to the horizon; then zeros."""
    actions = np.zeros((0, 3))
    for number, stage in enumerate(chain):
        walk = actions_along(walks.to(stage, chain[:number]), horizon)
        moving = np.flatnonzero(walk.any(axis=1))
        walk = walk[: moving[-1] + 1 if len(moving) else 0]
        actions = np.concatenate([actions, walk, stage.actions])
        if len(actions) >= horizon:
            break
    return np.pad(actions[:horizon], ((0, max(horizon - len(actions), 0)), (0, 0)))


# Up to three pushes that bring an object to a pose, by search over tables of pushes (Song et al., 2020, go deeper).
#
# With e = (x, y, yaw) the goal in the object's planar frame and m_i the motion of push i, one push leaves e' =
# m_i^-1 e, and the last push is the one in the table whose motion is nearest to e'. First pushes of two are a part of
# the table; first and second pushes of three are drawn at random. A can on its side rolls under most pushes; three
# pushes can slide it along its axis, turn it and slide it back. A first push may roll the object onto the side that the
# goal shows; later pushes are then those of that side. Sequences are drawn by
#
#     s = sqrt(x^2 + y^2 + (arm * angle)^2) of what is left + price * (length of the pusher's path)
#
# with probability proportional to exp(-s / temperature).


_PATH_PRICE = 0.1  # of a metre of the pusher's path, in metres of error
_TEMPERATURE_M = 0.003
_EVERY = 3  # rows of the table are tried as the first of two pushes
_PAIRS = 6000  # of pushes are tried as the first of three
_NEARER = 0.9  # of the error may be left, or a sequence is not worth its time
_MUCH_NEARER = 0.5  # where as little is left by pushes that do not roll the object, no others are drawn
_STEADY = 0.95  # of an object's pushes leave it on its side, or it rolls
_TURN_BACK_M = 0.008  # the pusher backs off before it walks around an object


class ObjectPushes:
    """Push sequences of one object while it rests on one side.

    Args:
        outcomes: table of its pushes on that side.
        reference: orientation of the object in the table.
        centre: centre of mass, in the object's frame [m].
    """

    def __init__(
        self, outcomes: PushOutcomes, reference: Float[np.ndarray, "4"], centre: Float[np.ndarray, "3"]
    ) -> None:
        self._outcomes, self._reference, self._centre = outcomes, reference, centre
        self._turns = quaternion_multiply(outcomes.quaternions.reshape(-1, 4), quaternion_conjugate(reference))
        yaw, tilt = planar_turns(np.array([1.0, 0.0, 0.0, 0.0]), self._turns)
        self._motions = np.concatenate([outcomes.centres.reshape(-1, 2), yaw[:, None]], axis=1)
        self._planar = np.flatnonzero(tilt <= UPRIGHT_RAD)
        self._tree = KDTree(self._motions[self._planar] * [1, 1, ARM_M]) if len(self._planar) else None
        ends = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
        self._ends = ends.reshape(-1, 2)
        self._left_at = _into(self._motions, self._ends)
        self.rolls = len(self._planar) < _STEADY * len(self._turns)

    def yaw(self, pose: Pose) -> float | None:
        """Return the turn about the vertical from the table's orientation [rad]; None if it lies on another side."""
        return planar_turn(self._reference, pose.quaternion)

    def draw(
        self,
        pose: Pose,
        goal: Pose,
        later: ObjectPushes,
        space: FreeSpace,
        pusher: Float[np.ndarray, "2"],
        count: int,
        rng: np.random.Generator,
    ) -> DrawnPushes:
        """Return sequences of up to three pushes that bring the object closer to its goal.

        Args:
            pose: pose of the object, on the side that the table was made for.
            goal: goal pose of the object.
            later: pushes on the side that the goal shows, which may be this object itself.
            space: free space in which first pushes may begin.
            pusher: present position of the pusher [m].
            count: largest number of sequences. Fewer or none come back if no push with room brings the object closer.
            rng: random generator.
        """
        yaw, centre = self.yaw(pose) or 0.0, pose.apply(self._centre)[:2]
        turn = _rotation(yaw)
        is_within = np.abs(self._ends @ turn.T + centre).max(axis=1) <= PUSHER_REACH_M
        has_room = space.is_free(self._outcomes.starts @ turn.T + centre)
        possible = np.flatnonzero(is_within & np.repeat(has_room, len(self._outcomes.lengths)))
        if not len(possible):
            return DrawnPushes(0, 0, lambda _: np.zeros((0, 2)))
        first = self._first_pushes(possible, yaw, goal, later)
        shift = turn.T @ (goal.apply(self._centre)[:2] - centre)
        rows, left = _sequences(first, np.array([*shift, (later.yaw(goal) or 0.0) - yaw]), later, rng)
        path = self._path_lengths(rows, first, later, turn.T @ (pusher - centre))
        before = np.hypot(np.linalg.norm(shift), ARM_M * float(rotation_angle(pose.quaternion, goal.quaternion)))
        better = np.flatnonzero(left < _NEARER * before)
        stays = (rows[:, 1] >= 0) | first.lands[rows[:, 0]]
        if np.any(stays & (left < _MUCH_NEARER * before)):
            better = better[stays[better]]
        drawn = (left + _PATH_PRICE * path)[better] / _TEMPERATURE_M - rng.gumbel(size=len(better))
        kept = rows[better[np.argsort(drawn)]]
        return DrawnPushes(len(kept), count, lambda k: self._corners(kept[k], first, later) @ turn.T + centre)

    def _first_pushes(self, rows: Int[np.ndarray, "M"], yaw: float, goal: Pose, later: ObjectPushes) -> _FirstPushes:
        """Return the effect of the table's pushes on an object turned by `yaw`, in the frame of later pushes."""
        around = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        ends = quaternion_multiply(quaternion_multiply(around, self._turns[rows]), self._reference)
        then, _ = planar_turns(later._reference, ends)
        _, tilts = planar_turns(goal.quaternion, ends)
        motions = np.concatenate([self._motions[rows, :2], (then - yaw)[:, None]], axis=1)
        angles = rotation_angle(ends, np.broadcast_to(goal.quaternion, ends.shape))
        return _FirstPushes(rows, motions, tilts, np.asarray(angles))

    def _path_lengths(
        self, rows: Int[np.ndarray, "C 3"], first: _FirstPushes, later: ObjectPushes, pusher: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "C"]:
        """Return the length of the pusher's path, straight from push to push [m]."""
        own = first.rows[rows[:, 0]]
        path = self._walked(own, np.broadcast_to(pusher, (len(own), 2)))
        at = _into(first.motions[rows[:, 0]], self._ends[own])
        for push in rows[:, 1:].T:
            path += np.where(push < 0, 0.0, later._walked(push, at))
            at = later._left_at[push]
        return path

    def _walked(self, rows: Int[np.ndarray, "C"], begin: Float[np.ndarray, "C 2"]) -> Float[np.ndarray, "C"]:
        count = len(self._outcomes.lengths)
        return (
            np.linalg.norm(self._outcomes.starts[rows // count] - begin, axis=1) + self._outcomes.lengths[rows % count]
        )

    def _corners(self, row: Int[np.ndarray, "3"], first: _FirstPushes, later: ObjectPushes) -> Float[np.ndarray, "C 2"]:
        """Return the pusher's path through pushes, in the planar frame before the first."""
        own, motion = first.rows[row[0]], first.motions[row[0]]
        then = later._path_through([int(push) for push in row[1:] if push >= 0])
        return self._followed_by(int(own), motion, then, later._outcomes.loop)

    def _path_through(self, rows: list[int]) -> Float[np.ndarray, "C 2"]:
        if not rows:
            return np.zeros((0, 2))
        return self._followed_by(rows[0], self._motions[rows[0]], self._path_through(rows[1:]), self._outcomes.loop)

    def _followed_by(
        self, row: int, motion: Float[np.ndarray, "3"], then: Float[np.ndarray, "C 2"], loop: Float[np.ndarray, "L 2"]
    ) -> Float[np.ndarray, "D 2"]:
        """Continue the path of one push around the object, then along a path in the frame after it."""
        number = row // len(self._outcomes.lengths)
        path = np.stack([self._outcomes.starts[number], self._ends[row]])
        if not len(then):
            return path
        back = path[1] - _TURN_BACK_M * self._outcomes.directions[number]
        around = around_loop(loop, _into(motion[None], back[None])[0], then[0])
        return np.vstack([path, back, np.vstack([around, then]) @ _rotation(motion[2]).T + motion[:2]])

    def leave(self, pose: Pose, at: Float[np.ndarray, "2"], toward: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Return the corners of a path around the object to the point of its loop closest to another place."""
        turn, centre, loop = _rotation(self.yaw(pose) or 0.0), pose.apply(self._centre)[:2], self._outcomes.loop
        own, aim = turn.T @ (at - centre), turn.T @ (toward - centre)
        exit_ = loop[np.linalg.norm(loop - aim, axis=1).argmin()]
        return np.vstack([around_loop(loop, own, exit_), exit_]) @ turn.T + centre


class DrawnPushes:
    """Push sequences that were drawn, the best first. Paths are computed on demand, since few of them are used.

    Args:
        known: number of sequences.
        wanted: largest number of sequences to use. Those that leave the pusher's reach do not count.
        path: function that returns the corners of a sequence's path, from the start of the first push to the end of the
            last [m].
    """

    def __init__(self, known: int, wanted: int, path: Callable[[int], Float[np.ndarray, "C 2"]]) -> None:
        self._known, self._wanted, self._path = known, wanted, cache(path)

    def __iter__(self) -> Iterator[Float[np.ndarray, "C 2"]]:
        """Yield paths within the pusher's reach."""
        return islice(self._within(range(self._known)), self._wanted)

    def sample(self, count: int, rng: np.random.Generator) -> list[Float[np.ndarray, "C 2"]]:
        """Return at most `count` of them, in random order."""
        best = min(self._wanted, self._known)
        order = chain(rng.permutation(best).tolist(), range(best, self._known))
        return list(islice(self._within(order), count))

    def _within(self, order: Iterable[int]) -> Iterator[Float[np.ndarray, "C 2"]]:
        return (path for path in map(self._path, order) if np.abs(path).max() <= PUSHER_REACH_M)


@dataclass(frozen=True, eq=False, slots=True)
class _FirstPushes:
    """Some rows of a table of pushes, and their effects.

    Attributes:
        rows: rows of the table.
        motions: shift in the planar frame before, and turn from it to the planar frame of later pushes [m, rad].
        tilts: tilts from the side that the goal shows [rad].
        angles: angles of the whole rotation to the goal [rad].
    """

    rows: Int[np.ndarray, "M"]
    motions: Float[np.ndarray, "M 3"]
    tilts: Float[np.ndarray, "M"]
    angles: Float[np.ndarray, "M"]

    @property
    def lands(self) -> Bool[np.ndarray, "M"]:
        """Whether the object then lies on the side that the goal shows."""
        return self.tilts <= UPRIGHT_RAD


def _sequences(
    first: _FirstPushes, target: Float[np.ndarray, "3"], later: ObjectPushes, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "C 3"], Float[np.ndarray, "C"]]:
    """Return sequences of up to three pushes, and the error that each leaves [m].

    A sequence holds the index of its first push, then rows of the table of later pushes; -1 for none.

    Args:
        first: possible first pushes.
        target: the goal in the planar frame before the first, with its turn in that of later pushes.
        later: pushes on the goal's side.
        rng: random generator of first and second pushes of three.
    """
    motions, planar, tree = later._motions, later._planar, later._tree
    left = np.hypot(np.linalg.norm(target[:2] - first.motions[:, :2], axis=1), ARM_M * first.angles)
    every = np.arange(len(first.rows))
    rows = np.stack([every, *np.full((2, len(every)), -1)], axis=1)
    landing = np.flatnonzero(first.lands)
    if tree is None or not len(landing):
        return rows, left
    one = landing[::_EVERY]
    pairs = np.stack([rng.choice(landing, _PAIRS), rng.choice(planar, _PAIRS)], axis=1)
    two = _after(_after(target, first.motions[pairs[:, 0]]), motions[pairs[:, 1]])
    more, nearest = tree.query(np.concatenate([_after(target, first.motions[one]), two]) * [1, 1, ARM_M])
    more = np.hypot(more, ARM_M * first.tilts[np.concatenate([one, pairs[:, 0]])])
    last = planar[nearest]
    second = np.stack([one, last[: len(one)], np.full(len(one), -1)], axis=1)
    third = np.concatenate([pairs, last[len(one) :, None]], axis=1)
    return np.concatenate([rows, second, third]), np.concatenate([left, more])


def around_loop(
    loop: Float[np.ndarray, "L 2"], begin: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Return the corners of the shorter way along a closed convex line, between places near it [m]."""
    i, j = (int(np.linalg.norm(loop - place, axis=1).argmin()) for place in (begin, end))
    forth = np.arange(i, i + (j - i) % len(loop) + 1) % len(loop)
    back = np.arange(i, i - (i - j) % len(loop) - 1, -1) % len(loop)
    ways = [loop[forth], loop[back]]
    return min(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))


def _rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _into(motions: Float[np.ndarray, "M 3"], points: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """Return points in the frame of an object after its motions."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x, y = (points - motions[:, :2]).T
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def _after(
    goal: Float[np.ndarray, "3"] | Float[np.ndarray, "M 3"], motions: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 3"]:
    """Return goals (x, y, yaw) in the frame of an object after its motions: m^-1 e."""
    goals = np.broadcast_to(goal, motions.shape)
    yaw = (goals[:, 2] - motions[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([_into(motions, goals[:, :2]), yaw[:, None]], axis=1)


# Push proposals: samples for MPPI that push one object after another to its goal.
#
# Random velocities touch an object in one of eight sequences. So sampling alone rarely finds a path around an object,
# and hardly ever pushes of three objects one after another. A proposal is a whole sequence of actions for an order of
# stages (`push_orders`). It has a collision-free path (`osfcore.planning.paths`) to an object, then up to three pushes
# toward its pose (`ObjectPushes`) or a straight push toward its position (`straight_pushes`), then the same for the
# next stage, as if this stage had succeeded.


_REACHED_M, _REACHED_RAD = 0.004, 0.045  # an object this close to its goal is not pushed on purpose
_SPEEDS = (0.5, 1.0)  # of the highest
_ORDERS = 6  # of stages; all of three objects in nobody's way
_SPARE = 3  # times as many pushes are drawn as needed: some begin where there is no room
_POOL = 120  # sequences of pushes of an object, drawn at once
_SIDES = 6  # of an object whose tables are kept
_STRAIGHT = 0.25  # share of pushes that are aimed at the goal's place alone


class PushProposals:
    """Proposes sequences of straight pushes that bring objects to their goals.

    Args:
        shapes: shapes of the objects, by name.
        predict: rollout of a dynamics model, which computes what a push from each side does; None to propose only
            pushes straight toward the goal's position.

    Example:
        >>> proposals = PushProposals(load_shapes(None, fields, [name]))
        >>> rng = np.random.default_rng(0)
        >>> actions = proposals.draw(state, goal, count=20, horizon=30, rng=rng)
        >>> actions.shape[1:]  # 30 velocities (vx, vy, 0) [m/s]
        (30, 3)
    """

    def __init__(self, shapes: Mapping[str, ObjectShape], predict: PushPredictor | None = None) -> None:
        self._tables = {name: ShapeTable((shape,)) for name, shape in shapes.items()}
        self._predict = predict
        self._pushes: dict[str, list[ObjectPushes]] = {}  # on each side that an object has lain on

    def draw(
        self, state: SceneState, goal: PoseGoal, count: int, horizon: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "P T 3"]:
        """Propose about `count` sequences of actions [m/s].

        Args:
            state: state of the scene, with a pusher.
            goal: the goal poses.
            count: largest number of sequences. None come back if all objects are at their goals, or the pusher has no
                room.
            horizon: actions in each sequence (T).
            rng: random generator of orders, angles, offsets, lengths and speeds.
        """
        now, goals = ([of.pose(name) for name in state.names] for of in (state, goal))
        off = [n for n, (here, there) in enumerate(zip(now, goals, strict=True)) if _is_off(here, there)]
        if not off:
            return np.zeros((0, horizon, 3))
        assert state.pusher is not None
        outlines = self._outlines(state.names)
        orders = push_orders(now, goals, off, outlines, _ORDERS, rng)

        def pushes(n: int, pose: Pose) -> ObjectPushes:
            return self._pushes_at(state, n, pose, outlines(n, pose))

        chains = _PushSequences(state.pusher[:2], now, pushes, outlines, horizon, rng)
        each = -(-count // len(orders))
        proposals = [actions for order in orders for actions in chains.draw(order, each)]
        return np.array(proposals[:count]).reshape(-1, horizon, 3)

    def recombine(self, goal: PoseGoal, rollouts: Rollouts, count: int) -> Float[np.ndarray, "P T 3"]:
        """Return at most `count` sequences [m/s] that combine successful pushes of different futures.

        Args:
            goal: the goal poses.
            rollouts: futures that begin in one state.
            count: largest number of sequences.
        """
        return recombined(rollouts, object_costs(rollouts, goal), self._outlines(rollouts.names), count)

    def _outlines(self, names: Sequence[str]) -> OutlinesAt:
        """Return a function that computes the outlines of objects, once for each pose."""
        known: dict[tuple[int, bytes], Outlines] = {}

        def at(n: int, pose: Pose) -> Outlines:
            key = n, pose.position.tobytes() + pose.quaternion.tobytes()
            if key not in known:
                known[key] = list(part_outlines(self._tables[names[n]], 0, pose).astype(float))
            return known[key]

        return at

    def _pushes_at(self, state: SceneState, n: int, pose: Pose, outlines: Outlines) -> ObjectPushes:
        name = state.names[n]
        known = self._pushes.setdefault(name, [])
        for one in known:
            if one.yaw(pose) is not None:
                return one
        centre = self._tables[name].centre[0].numpy().astype(float)
        alone = replace(state, names=(name,), poses=Pose.stacked([pose]))
        outcomes = push_outcomes(self._predict, alone, centre, outlines)
        known.append(ObjectPushes(outcomes, pose.quaternion, centre))
        del known[:-_SIDES]
        return known[-1]


def _is_off(pose: Pose, goal: Pose) -> bool:
    if np.linalg.norm((goal.position - pose.position)[:2]) > _REACHED_M:
        return True
    return float(rotation_angle(pose.quaternion, goal.quaternion)) > _REACHED_RAD


class _PushSequences:
    """Samples sequences of pushes. Computations that several orders share are done once."""

    def __init__(
        self, pusher: Float[np.ndarray, "2"], now: Sequence[Pose], pushes: Callable[[int, Pose], ObjectPushes],
        outlines: OutlinesAt, horizon: int, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self._pusher, self._now, self._pushes, self._outlines = pusher, now, pushes, outlines
        self._horizon, self._rng = horizon, rng
        self._known: dict[tuple[bytes, ...], _Leg] = {}

    def draw(self, order: tuple[Stage, ...], count: int) -> list[Float[np.ndarray, "T 3"]]:
        """Draw sequences of stages in this order, as far as the horizon and the room allow."""
        corners = [[self._pusher] for _ in range(count)]
        speeds: list[list[float]] = [[] for _ in range(count)]
        limit_s = self._horizon * STEP_S
        for number in range(len(order)):
            leg = self._leg(order[: number + 1])
            ways = self._ways(leg, order[number], count)
            if not ways:
                break
            for k in range(count):
                if speeds[k] and duration_s(np.array(corners[k]), np.array(speeds[k])) >= limit_s:
                    continue
                way = ways[k % len(ways)]
                path = [*leg.walk(corners[k][-1], way[0]), *way[1:]]
                corners[k] += path
                speeds[k] += [1.0] * (len(path) - len(way) + 1)
                speeds[k] += [float(self._rng.uniform(*_SPEEDS))] * (len(way) - 1)
        if not speeds[0]:
            return []
        return [actions_along(np.array(c), self._horizon, np.array(s)) for c, s in zip(corners, speeds, strict=True)]

    def _leg(self, stages: tuple[Stage, ...]) -> _Leg:
        """Prepare the last of some stages, as if the earlier ones had succeeded."""
        key = tuple(part for one in stages for part in (bytes([one.number]), one.target.position.tobytes()))
        if key not in self._known:
            places = list(self._now)
            for one in stages[:-1]:
                places[one.number] = one.target
            *_, last, n = -1, *(one.number for one in stages)
            space = FreeSpace([part for k, pose in enumerate(places) for part in self._outlines(k, pose)])
            around = None if last < 0 else (self._pushes(last, places[last]), places[last])
            begin = self._pusher
            if around is not None:
                toward = places[n].position[:2]
                begin = around[0].leave(around[1], toward, toward)[-1].clip(-PUSHER_REACH_M, PUSHER_REACH_M)
            here, target = places[n], stages[-1].target
            own = self._pushes(n, here)
            pool = own.draw(here, target, self._pushes(n, target), space, begin, _POOL, self._rng)
            self._known[key] = _Leg(here, space, begin, space.paths_from(begin), around, pool, own.rolls)
        return self._known[key]

    def _ways(self, leg: _Leg, stage: Stage, count: int) -> list[Float[np.ndarray, "C 2"]]:
        """Draw pushes of a stage that begin where the pusher has room."""
        offset = (stage.target.position - leg.here.position)[:2]
        ways = leg.pool.sample(count - round(_STRAIGHT * count), self._rng)
        straight = 0 if ways and leg.rolls else count - len(ways)
        if straight and np.linalg.norm(offset) > _REACHED_M:
            sides = outline_points(self._outlines(stage.number, leg.here))
            starts, ends = straight_pushes(sides, offset, _SPARE * straight, self._rng)
            clear = np.flatnonzero(leg.space.is_free(starts))[:straight]
            ways += list(np.stack([starts[clear], ends[clear]], axis=1))
        return [way.clip(-PUSHER_REACH_M, PUSHER_REACH_M) for way in ways]


@dataclass(frozen=True, eq=False, slots=True)
class _Leg:
    """A stage, as if the earlier ones had succeeded.

    Attributes:
        here: pose of its object.
        space: free space of the pusher.
        begin: start of the pusher: its present position, or beside the object of the stage before.
        paths: shortest paths from there.
        around: pushes and pose of the object of the stage before, which the pusher first walks around.
        pool: pushes to choose from.
        rolls: whether the object rolls under some pushes, which straight pushes do not consider.
    """

    here: Pose
    space: FreeSpace
    begin: Float[np.ndarray, "2"]
    paths: ShortestPaths
    around: tuple[ObjectPushes, Pose] | None
    pool: DrawnPushes
    rolls: bool

    def walk(self, at: Float[np.ndarray, "2"], start: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "2"]]:
        """Return the corners of a path to the start of a push [m]."""
        path = list(self.paths.to(start)[1:])
        if self.around is None:
            return path
        pushes, pose = self.around
        return [*pushes.leave(pose, at, self.begin), *path]
