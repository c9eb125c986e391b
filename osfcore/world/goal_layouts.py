"""Random goal layouts: some objects shifted to free places, at rest (paper, section 5.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects, UnknownName
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.placing import GAP_M
from osfcore.world.tabletop import Tabletop

SHIFT_M = (0.075, 0.2)  # by how much a goal moves an object
_GOALS = 30  # random ones that are tried until one has room
_SUNK_M = 0.02  # whatever lies this deep lies beside the table
_PLACES = 60  # that each object tries
_RESTS_M, _RESTS_RAD = 0.002, 0.03  # by how much an object may move when it is let go where it shall be


def draw_goal(world: Tabletop, count: int, rng: np.random.Generator) -> tuple[SceneState, tuple[str, ...]] | None:
    """How the table could become with some objects elsewhere, and which; None if there is no room.

    The world is left as the goal is, at rest, or anyhow if there is none.

    Args:
        world: with the objects where they start from.
        count: of objects that move.
        rng: chooses them and their places.
    """
    start = world.truth()
    moved = tuple(start.names[int(n)] for n in rng.permutation(len(start.names))[:count])
    if not all(_shifted(world, name, start.pose(name), rng) for name in moved):
        return None
    return (replace(world.truth(), pusher=None), moved) if came_to_rest(world) else None


def came_to_rest(world: Tabletop) -> bool:
    """Let everything go; whether all objects stayed where they had been put, within 2 mm and 0.03 rad."""
    asked = world.truth()
    for _ in world.settle():
        pass
    rests = world.truth()
    shift = np.linalg.norm(rests.poses.position - asked.poses.position, axis=1)
    turn = rotation_angle(rests.poses.quaternion, asked.poses.quaternion)
    return bool(shift.max() <= _RESTS_M and turn.max() <= _RESTS_RAD)


def _shifted(world: Tabletop, name: str, pose: Pose, rng: np.random.Generator) -> bool:
    """Put an object elsewhere in the workspace, beside all others; whether a place was found."""
    for _ in range(_PLACES):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*SHIFT_M)
        place = pose.position + np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0])
        if np.abs(place[:2]).max() > WORKSPACE_HALF_M:
            continue
        try:
            world.move_object(name, Pose(place, pose.quaternion))
        except (OverlappingObjects, InvalidInput):
            continue
        if world.gap_m(name) >= GAP_M:
            return True
    return False


def random_goal(world: Tabletop, seed: int, moved: int | None) -> tuple[SceneState, tuple[str, ...]]:
    """A random layout with some objects elsewhere, and which; the world is left like that.

    Args:
        world: with the objects where they start from.
        seed: of everything random.
        moved: how many objects move; None for a random number.

    Raises:
        InvalidInput: if more shall move than there are, or none.
        NoRoom: if none has room.
    """
    start = world.truth()
    if moved is not None and not 1 <= moved <= len(start.names):
        raise InvalidInput("number of objects that move", moved, f"between 1 and {len(start.names)}")
    for attempt in range(_GOALS):
        rng = stream_rng(seed, Stream.GOAL_LAYOUT, attempt)
        count = int(rng.integers(1, len(start.names) + 1)) if moved is None else moved
        world.restore(start)
        goal = draw_goal(world, count, rng)
        if goal is not None:
            return goal
    raise NoRoom(start.names, _GOALS)


def arranged_goal(world: Tabletop, poses: Mapping[str, Pose], *, is_measured: bool = False) -> SceneState:
    """The table at rest with some objects at given poses; the world is left like that, or anyhow if it cannot be.

    Args:
        world: with the objects.
        poses: of some of them.
        is_measured: the poses may err: objects that penetrate are moved apart first.

    Raises:
        UnknownName: if an object is not on the table.
        InvalidInput: if an object would not be over the table.
        OverlappingObjects: if objects would overlap, unless poses are measured.
    """
    state = world.truth()
    for name in poses:
        if name not in state.names:
            raise UnknownName("object on the table", name, state.names)
    every = [poses.get(name, state.pose(name)) for name in state.names]
    stacked = Pose.stacked(every)
    (world.load_measured if is_measured else world.load)(SceneState(state.names, stacked, state.light, None))
    for _ in world.settle():
        pass
    rests = world.truth()
    for name in rests.names:
        if (position := rests.pose(name).position)[2] < -_SUNK_M:
            allowed = "where it does not fall off the table"
            raise InvalidInput(f"position of {name} [m]", np.round(position, 4).tolist(), allowed)
    return rests
