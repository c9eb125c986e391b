"""Random scenes: the choice of objects, their poses at rest, the light, and the conditions of the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, NoRoom, OsfError, OverlappingObjects, check_ranges, check_unique
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M, TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import Lamp, TableSurface
from osfcore.world.physics import Physics, lowest_point
from osfcore.world.simulators import Simulator, default_simulator

MAX_HEIGHT_M = 1.0  # of an object's centre when it is put somewhere by hand


@dataclass(frozen=True, eq=False, slots=True)
class SceneRequest:
    """Request for a random scene.

    Attributes:
        names: names of the objects; None to choose them at random.
        count: number of objects to choose if `names` is None.
        light: the light; None for a random one at least 10 deg above the table.
        among: names to choose from if `names` is None; None for all objects of the library.
        is_upright: whether objects stand upright, as in their meshes, instead of in any resting orientation.

    Example:
        >>> request = SceneRequest(names=("006_mustard_bottle",), is_upright=True)
        >>> world = Tabletop(assets, request=request)
        >>> world.close()
    """

    names: tuple[str, ...] | None = None
    count: int = 3
    light: Light | None = None
    among: tuple[str, ...] | None = None
    is_upright: bool = False


def check_request(library: AssetLibrary, request: SceneRequest) -> None:
    """Check that the library can fulfil a request.

    Raises:
        UnknownName: if there is no such object.
        MissingAssets: if the mesh of an object has not been fetched.
        InvalidInput: if there are too many objects, too few to choose from, or a name occurs twice.
        OsfError: if the library is empty.
    """
    if request.names is not None:
        check_ranges(("number of objects", len(request.names), 1, MAX_OBJECTS))
        check_unique("list of objects", request.names)
        for name in request.names:
            library.check(name)
        return
    check_ranges(("number of objects", request.count, 1, MAX_OBJECTS))
    choice = library.names() if request.among is None else request.among
    for name in request.among or ():
        library.check(name)
    check_unique("list of objects", choice)
    if request.among is None and not choice:
        raise OsfError("There are no objects on this machine yet; get them with 'osf assets fetch'.")
    if request.count > len(choice):
        allowed = f"at most {len(choice)}, as many as there are to choose from"
        raise InvalidInput("number of objects", request.count, allowed)


def check_place(name: str, position: Float[np.ndarray, "3"]) -> None:
    """Check that an object may be put somewhere by hand [m].

    Raises:
        InvalidInput: if the place is not over the table.
    """
    half = TABLE_SIDE_M / 2
    if np.abs(position[:2]).max() > half or not 0 <= position[2] <= MAX_HEIGHT_M:
        allowed = f"over the table: |x|, |y| at most {half:g} and z between 0 and {MAX_HEIGHT_M:g}"
        raise InvalidInput(f"position of {name} [m]", np.round(position, 4).tolist(), allowed)


# Random scenes: objects at rest on the table, side by side inside the workspace, and a free pusher.


GAP_M = 0.01  # between objects when placed
PUSHER_GAP_M = 0.02
OVERLAP_TOLERANCE_M = 0.002
DROP_M = 0.001  # objects start this far above the table
_TRIES_PER_OBJECT = 60
_LAYOUTS = 60
_SETTLE_LIMIT_STEPS = 480
_CALM_STEPS = 12
_MOVES = 60  # rounds of moving apart
_TOUCH_M = 5e-4  # less is no penetration: shapes have a margin
_STANDS_M = 0.01  # an object with a smaller gap to the table stands on it
_SIDEWAYS = 0.3  # a part of a contact's normal that is at least so large gives the direction
_CALM_SPEED_M_S = 2e-3
_CALM_TURN_RAD_S = 2e-2


def place_randomly(
    physics: Physics, assets: Mapping[str, ObjectAsset], rng: np.random.Generator, *, is_upright: bool = False
) -> None:
    """Drop all objects in random stable poses without overlap, let them rest, put the pusher in a free place.

    Args:
        physics: a simulation of these objects; it starts over.
        assets: assets of the objects, by name.
        rng: draws poses and places.
        is_upright: objects stand upright, as their meshes do; one that falls over rests as it fell.

    Raises:
        NoRoom: if no layout was found.
    """
    for _ in range(_LAYOUTS):
        physics.reset()
        if not _lay_out(physics, assets, rng, is_upright):
            continue
        settle(physics, tuple(assets))
        is_inside = all(np.abs(physics.pose(name).position[:2]).max() <= WORKSPACE_HALF_M for name in assets)
        if is_inside and is_calm(physics, tuple(assets)) and _place_pusher(physics, tuple(assets), rng):
            return
    raise NoRoom(assets, _LAYOUTS)


def settle(physics: Physics, names: tuple[str, ...]) -> int:
    """Step without pushing until nothing has moved for a twentieth of a second; return the steps taken.

    It gives up after 2 s.
    """
    calm = 0
    for step in range(_SETTLE_LIMIT_STEPS):
        if calm >= _CALM_STEPS:
            return step
        physics.step(np.zeros(3))
        calm = calm + 1 if is_calm(physics, names) else 0
    return _SETTLE_LIMIT_STEPS


def refuse_overlaps(physics: Physics, names: tuple[str, ...], moved: str | None = None) -> None:
    """Raise if bodies penetrate by more than 2 mm.

    Args:
        physics: physics of the bodies.
        names: names of the objects.
        moved: check only pairs with this object; None for all.

    Raises:
        OverlappingObjects: if bodies penetrate.
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

    Of two objects that both stand on the table each gives way by half. Otherwise the upper one is lifted.
    Without this, physics would throw them apart.
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
    """Move two objects apart along the contact's normal (from second to first); sideways if both stand on the table."""
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


def _shift(physics: Physics, name: str, by: Float[np.ndarray, "3"]) -> None:
    pose = physics.pose(name)
    physics.place(name, Pose(pose.position + by, pose.quaternion))


def is_calm(physics: Physics, names: tuple[str, ...]) -> bool:
    """Return whether every object is slower than 2 mm/s and 0.02 rad/s."""
    speeds = [physics.speed(name) for name in names]
    return all(linear < _CALM_SPEED_M_S and angular < _CALM_TURN_RAD_S for linear, angular in speeds)


def random_rest(asset: ObjectAsset, rng: np.random.Generator, *, is_upright: bool = False) -> Float[np.ndarray, "4"]:
    """Draw a resting orientation by its probability, or the upright one, turned about the vertical at random."""
    choice = rng.choice(len(asset.resting.quaternions), p=asset.resting.probabilities)
    turn = quaternion_exp(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
    return turn if is_upright else quaternion_multiply(turn, asset.resting.quaternions[choice])


def _lay_out(physics: Physics, assets: Mapping[str, ObjectAsset], rng: np.random.Generator, is_upright: bool) -> bool:
    """Place all objects apart from each other; return whether there was room."""
    placed: list[str] = []
    for name in sorted(assets, key=lambda name: -assets[name].radius_m):  # large ones find no place later
        quaternion = random_rest(assets[name], rng, is_upright=is_upright)
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
    """Put the pusher in or just around the workspace, clear of everything; return whether there was room."""
    half = WORKSPACE_HALF_M + 2 * PUSHER_RADIUS_M
    for _ in range(_TRIES_PER_OBJECT):
        physics.place_pusher(np.array([*rng.uniform(-half, half, 2), PUSHER_CENTRE_Z_M]))
        if all(physics.distance(name, None) >= PUSHER_GAP_M for name in names):
            return True
    return False


_MAX_FACTOR = 100.0


Renderer = Literal["embree", "tiny"]


@dataclass(frozen=True, eq=False, slots=True)
class Conditions:
    """Light, table, contacts and pictures of a world; the defaults are those that the methods assume.

    Attributes:
        lamp: how strongly, and in which colour, the scene is lit.
        table: what the table looks like.
        friction_factor: on the friction of every object, hence between object and table, and object and pusher; between
            two objects it counts twice in PyBullet, and once in MuJoCo.
        mass_factor: on the mass and the moments of inertia of every object.
        spot: a near lamp in the place of the distant light; None for the distant light.
        renderer: "embree" (exact shadows, anti-aliased) or "tiny" (PyBullet's TinyRenderer, as the paper used), which
            has no other lamp and no other table.
        simulator: what moves the objects, "pybullet" or "mujoco"; PyBullet where it is installed.
    """

    lamp: Lamp = field(default_factory=Lamp)
    table: TableSurface = field(default_factory=TableSurface)
    friction_factor: float = 1.0
    mass_factor: float = 1.0
    spot: SpotLamp | None = None
    renderer: Renderer = "embree"
    simulator: Simulator = field(default_factory=default_simulator)

    def __post_init__(self) -> None:
        """Check the factors and the renderer.

        Raises:
            InvalidInput: if a factor is not positive, or beyond reason, or there is no such renderer.
        """
        if self.renderer not in ("embree", "tiny"):
            raise InvalidInput("renderer", repr(self.renderer), '"embree" or "tiny"')
        for what, factor in (("factor on friction", self.friction_factor), ("factor on mass", self.mass_factor)):
            if not 0 < factor <= _MAX_FACTOR:
                raise InvalidInput(what, factor, f"above 0 and at most {_MAX_FACTOR:g}")
