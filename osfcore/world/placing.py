"""Random scenes: objects at rest on the table, side by side inside the workspace, and a free pusher."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import NoRoom, OverlappingObjects
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M, WORKSPACE_HALF_M
from osfcore.objects.asset import ObjectAsset
from osfcore.world.physics import Physics, lowest_point

GAP_M = 0.01  # between objects when placed
PUSHER_GAP_M = 0.02
OVERLAP_TOLERANCE_M = 0.002
DROP_M = 0.001  # objects start this far above the table
_TRIES_PER_OBJECT = 60
_LAYOUTS = 60
_SETTLE_LIMIT_STEPS = 480
_CALM_STEPS = 12
_MOVES = 60  # until nothing penetrates any more
_TOUCH_M = 5e-4  # so little is no penetration: shapes have a margin
_STANDS_M = 0.01  # above the table at most, for what stands on it
_SIDEWAYS = 0.3  # of a contact's normal from which it tells a direction
CALM_SPEED_M_S = 2e-3
CALM_TURN_RAD_S = 2e-2


def place_randomly(physics: Physics, assets: Mapping[str, ObjectAsset], rng: np.random.Generator) -> None:
    """Drop all objects in random stable poses without overlap, let them rest, put the pusher in a free place.

    Args:
        physics: a simulation of these objects; it starts over.
        assets: of the objects, by name.
        rng: draws poses and places.

    Raises:
        NoRoom: if no layout was found.
    """
    for _ in range(_LAYOUTS):
        physics.reset()
        if not _lay_out(physics, assets, rng):
            continue
        settle(physics, tuple(assets))
        inside = all(np.abs(physics.pose(name).position[:2]).max() <= WORKSPACE_HALF_M for name in assets)
        if inside and is_calm(physics, tuple(assets)) and _place_pusher(physics, tuple(assets), rng):
            return
    raise NoRoom(assets, _LAYOUTS)


def settle(physics: Physics, names: tuple[str, ...], limit_steps: int = _SETTLE_LIMIT_STEPS) -> int:
    """Step without pushing until nothing has moved for a twentieth of a second; return the steps taken.

    Args:
        physics: steps in place.
        names: objects that shall come to rest.
        limit_steps: when to give up.
    """
    calm = 0
    for step in range(limit_steps):
        if calm >= _CALM_STEPS:
            return step
        physics.step(np.zeros(3))
        calm = calm + 1 if is_calm(physics, names) else 0
    return limit_steps


def refuse_overlaps(physics: Physics, names: tuple[str, ...], moved: str | None = None) -> None:
    """Raise if bodies penetrate by more than 2 mm.

    Args:
        physics: of the bodies.
        names: of the objects.
        moved: only pairs of which it is one are looked at; None for all.

    Raises:
        OverlappingObjects: if so.
    """
    for i, first in enumerate(names):
        gaps = {second: physics.distance(first, second) for second in names[i + 1 :]}
        gaps["the pusher"] = physics.distance(first, None)
        gaps["the table"] = physics.table_distance(first)
        for second, gap in gaps.items():
            if gap < -OVERLAP_TOLERANCE_M and moved in (None, first, second):
                raise OverlappingObjects(first, second, -gap)


def move_apart(physics: Physics, names: tuple[str, ...]) -> None:
    """Lift objects that sink into the table, and move apart those that penetrate each other, as little as needed.

    Of two that both stand on the table each gives way by half; of others the one that lies on the other is lifted.
    Let go while they penetrate, they would be thrown apart.
    """
    for _ in range(_MOVES):
        is_moved = False
        for i, first in enumerate(names):
            if (gap := physics.table_distance(first)) < -_TOUCH_M:
                _shift(physics, first, np.array([0.0, 0.0, -gap]))
                is_moved = True
            for second in names[i + 1 :]:
                gap, normal = physics.separation(first, second)
                if gap < -_TOUCH_M:
                    _separate(physics, first, second, -gap, normal)
                    is_moved = True
        if not is_moved:
            return


def _separate(physics: Physics, first: str, second: str, depth_m: float, normal: Float[np.ndarray, "3"]) -> None:
    """Move two objects along the normal that the first one leaves by; horizontally if both stand on the table."""
    if all(physics.table_distance(name) < _STANDS_M for name in (first, second)):
        apart = physics.pose(first).position - physics.pose(second).position
        aside = normal[:2] if np.linalg.norm(normal[:2]) > _SIDEWAYS else apart[:2]
        by = depth_m / 2 * np.array([*aside, 0.0]) / max(float(np.linalg.norm(aside)), 1e-9)
        _shift(physics, first, by)
        _shift(physics, second, -by)
    elif abs(normal[2]) > _SIDEWAYS:
        _shift(physics, first if normal[2] > 0 else second, np.array([0.0, 0.0, depth_m]))
    else:
        _shift(physics, first, depth_m * normal)


def above_table(state: SceneState) -> SceneState:
    """The state with no object's centre below the table."""
    positions = np.maximum(state.poses.position, [-np.inf, -np.inf, 0.0])
    return replace(state, poses=Pose(positions, state.poses.quaternion))


def _shift(physics: Physics, name: str, by: Float[np.ndarray, "3"]) -> None:
    pose = physics.pose(name)
    physics.place(name, Pose(pose.position + by, pose.quaternion))


def is_calm(physics: Physics, names: tuple[str, ...]) -> bool:
    """Whether every object is slower than 2 mm/s and 0.02 rad/s."""
    speeds = [physics.speed(name) for name in names]
    return all(linear < CALM_SPEED_M_S and angular < CALM_TURN_RAD_S for linear, angular in speeds)


def random_rest(asset: ObjectAsset, rng: np.random.Generator) -> Float[np.ndarray, "4"]:
    """A resting orientation by its probability, turned about the vertical at random."""
    choice = rng.choice(len(asset.resting.quaternions), p=asset.resting.probabilities)
    turn = quaternion_exp(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
    return quaternion_multiply(turn, asset.resting.quaternions[choice])


def _lay_out(physics: Physics, assets: Mapping[str, ObjectAsset], rng: np.random.Generator) -> bool:
    # Large objects first: they are the ones that find no place later.
    order = sorted(assets, key=lambda name: -assets[name].radius_m)
    placed: list[str] = []
    for name in order:
        quaternion = random_rest(assets[name], rng)
        height = DROP_M - lowest_point(assets[name], quaternion)
        for _ in range(_TRIES_PER_OBJECT):
            x, y = rng.uniform(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 2)
            physics.place(name, Pose(np.array([x, y, height]), quaternion))
            if all(physics.distance(name, other) >= GAP_M for other in placed):
                placed.append(name)
                break
        else:
            return False
    return True


def _place_pusher(physics: Physics, names: tuple[str, ...], rng: np.random.Generator) -> bool:
    """Somewhere in or just around the workspace, clear of everything."""
    half = WORKSPACE_HALF_M + 2 * PUSHER_RADIUS_M
    for _ in range(_TRIES_PER_OBJECT):
        physics.place_pusher(np.array([*rng.uniform(-half, half, 2), PUSHER_CENTRE_Z_M]))
        if all(physics.distance(name, None) >= PUSHER_GAP_M for name in names):
            return True
    return False
