"""In which order objects are pushed, and where to on the way: blocked goals, swaps and detours.

An object whose goal is taken by another one waits until that one has left; of objects that wait for each other one is
first brought to a buffer, a free place near its way; and one whose straight way is barred is brought to the corners of
the shortest path around what bars it. (Buffers and dependency graphs are those of tabletop rearrangement: Han et al.,
2018; detours are paths of a disc as wide as the object.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.planning.path_planning import CELL_M, CLEARANCE_M, FreeSpace

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
    """An object and where it is brought to.

    Attributes:
        number: of the object.
        target: its pose then.
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
    """Orders that bring all objects to their goals.

    Args:
        now: where the objects are.
        goals: where they should be.
        off: numbers of those that are not there.
        outlines: tells those of an object at a pose [m].
        count: of orders at most.
        rng: draws among possible ones.
    """  # fmt: skip
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
    """For each object those that take its goal and will leave it."""
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
    """Orders that begin with one object's way to a buffer; without any such, plain ones."""
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
    """A free place for an object, clear of all others where they are and where they will be, near its way."""
    others = [part for k in range(len(now)) for pose in (now[k], goals[k]) if k != n for part in outlines(k, pose)]
    space = FreeSpace([*others, *outlines(n, goals[n])], 0.0)
    radius = _radius(outlines(n, now[n]), now[n])
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
        stages += [
            Stage(n, Pose(np.array([*corner, places[n].position[2]]), places[n].quaternion)) for corner in corners
        ]
        stages.append(stage)
        places[n] = stage.target
    return tuple(stages)


def _corners(n: int, places: Sequence[Pose], target: Pose, outlines: OutlinesAt) -> Float[np.ndarray, "C 2"]:
    """Where an object must turn on its way around others; none where the straight way is clear."""
    others = [part for k in range(len(places)) if k != n for part in outlines(k, places[k])]
    begin, end = places[n].position[:2], target.position[:2]
    none = np.zeros((0, 2))
    if not others or np.linalg.norm(end - begin) < 2 * _MIN_DETOUR_M:
        return none
    space = FreeSpace(others, _breadth(outlines(n, places[n]), begin, end) / 2)
    if np.all(space.is_free(np.linspace(begin, end, _CHECKED))):
        return none
    path = space.paths_from(begin).to(end)
    corners = cv2.approxPolyDP(path.astype(np.float32), _MIN_DETOUR_M, closed=False)[1:-1, 0].astype(float)
    return none if len(corners) > _CORNERS or np.abs(corners).max(initial=0.0) > _ROOM_M else corners


def _breadth(outlines: Outlines, begin: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
    """Of an object across the way that it goes [m]."""
    way = (end - begin) / max(float(np.linalg.norm(end - begin)), 1e-9)
    return float(np.ptp(np.concatenate(outlines) @ np.array([-way[1], way[0]])))


def _radius(outlines: Outlines, pose: Pose) -> float:
    return float(np.linalg.norm(np.concatenate(outlines) - pose.position[:2], axis=1).max())


def _moved(pose: Pose, place: Float[np.ndarray, "2"]) -> Pose:
    return Pose(np.array([*place, pose.position[2]]), pose.quaternion)
