"""What planning is measured on: scenes at rest, some objects of which shall lie elsewhere (paper, section 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects
from osfcore.evaluate.composites import draw_scene
from osfcore.evaluate.estimate_tasks import SHIFT_M, opened
from osfcore.objects.library import AssetLibrary
from osfcore.poses import Pose, rotation_angle
from osfcore.scene import WORKSPACE_HALF_M, SceneState
from osfcore.world.placing import GAP_M
from osfcore.world.tabletop import Tabletop

_LAYOUTS = 30  # of a task, until one has room for where its objects shall go
_PLACES = 60  # that each object tries
_RESTS_M, _RESTS_RAD = 0.002, 0.03  # by how much an object may move when it is let go where it shall be


@dataclass(frozen=True, eq=False, slots=True)
class MpcTask:
    """A scene, and how it shall become.

    Attributes:
        number: of the task.
        start: the truth at the beginning, at rest, with the pusher in a free place.
        goal: the truth as it shall be, without pusher, under the same light.
        moved: the objects that shall lie elsewhere: shifted by 7.5 to 20 cm, not turned.
    """

    number: int
    start: SceneState
    goal: SceneState
    moved: tuple[str, ...]


def mpc_task(library: AssetLibrary, available: Sequence[str], objects: int, seed: int, number: int) -> MpcTask:
    """The number-th task; it does not depend on the others. A third each move one, two and three objects.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit.
    """
    draw = draw_scene(available, objects, seed, number)
    count = 1 + number % min(objects, 3)
    for layout in range(_LAYOUTS):
        rng = np.random.default_rng([seed, number, layout])
        with opened(replace(draw, seed=int(rng.integers(1 << 31))), library) as world:
            start = world.truth()
            found = draw_goal(world, count, rng)
        if found is not None:
            return MpcTask(number, start, *found)
    raise NoRoom(draw.names, _LAYOUTS)


def draw_goal(world: Tabletop, count: int, rng: np.random.Generator) -> tuple[SceneState, tuple[str, ...]] | None:
    """How the table could become, with `count` objects elsewhere, and which; None if there is no room.

    The world is left as the goal is, at rest.
    """
    start = world.truth()
    moved = tuple(start.names[int(n)] for n in rng.permutation(len(start.names))[:count])
    if not all(_shifted(world, name, start.pose(name), rng) for name in moved):
        return None
    asked = world.truth()
    for _ in world.settle():
        pass
    goal = world.truth()
    shift = np.linalg.norm(goal.poses.position - asked.poses.position, axis=1)
    turn = rotation_angle(goal.poses.quaternion, asked.poses.quaternion)
    if shift.max() > _RESTS_M or turn.max() > _RESTS_RAD:
        return None
    return replace(goal, pusher=None), moved


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
