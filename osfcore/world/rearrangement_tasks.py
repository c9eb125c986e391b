"""Rearrangement tasks: scenes at rest, some objects of which shall lie elsewhere (paper, section 5.4).

Four families:

    shifted   objects lie elsewhere, as they lay.
    turned    objects lie elsewhere and turned about the vertical by 30 to 180 deg.
    crowded   the place of an object is taken by another one, which has to move first: it goes to a free place (2
              move), to that of the first one (a swap), or to that of a third one, which takes the first one's place.
    relit     the tasks of `shifted`; the goal is photographed under another light.

Drawn are: the objects; their resting orientations and places, as `placing` does; a light, uniform over the sky 5 deg
and more above the table; which objects move, in turn 1, 2 and 3 of them (crowded: 2, 2 and 3); for each a place,
uniform in the workspace and at least 7.5 cm from where it lies (the paper's least displacement). Rejected and drawn
anew are layouts in which an object finds no place 1 cm clear of all others, and those that do not rest: where an object
moves by more than 2 mm or 0.03 rad when it is let go.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.goal_layouts import came_to_rest
from osfcore.world.placing import GAP_M
from osfcore.world.random_scenes import draw_scene, opened
from osfcore.world.tabletop import Tabletop

Family = Literal["shifted", "turned", "crowded", "relit"]
FAMILIES: tuple[Family, ...] = get_args(Family)
MAX_OBJECTS = 6  # in a scene
MIN_SHIFT_M = 0.075
TURN_DEG = (30.0, 180.0)
MIN_ELEVATION_DEG = 5.0
_LAYOUTS = 60  # of a task, until one has room for where its objects shall go
_PLACES = 100  # that each object tries


@dataclass(frozen=True, slots=True)
class TaskSet:
    """Many tasks, none of which depends on the others.

    Attributes:
        available: objects to choose from.
        family: what their goals ask for.
        objects: in each scene.
        seed: of all of them.
    """

    available: tuple[str, ...]
    family: Family = "shifted"
    objects: int = 3
    seed: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class DrawnTask:
    """A task, and what was drawn before it.

    Attributes:
        task: start and goal.
        rejected: how many layouts were drawn and rejected, by reason.
    """

    task: RearrangementTask
    rejected: Mapping[str, int]


def check_tasks(tasks: TaskSet) -> None:
    """Check that tasks can be drawn.

    Raises:
        InvalidInput: if the family is unknown, or there are too few objects, or too many.
    """
    if tasks.family not in FAMILIES:
        raise InvalidInput("family of tasks", repr(tasks.family), f"one of {', '.join(FAMILIES)}")
    least = 2 if tasks.family == "crowded" else 1
    if not least <= tasks.objects <= MAX_OBJECTS:
        raise InvalidInput("objects in a scene", tasks.objects, f"between {least} and {MAX_OBJECTS}")
    if len(tasks.available) < tasks.objects:
        available = len(tasks.available)
        raise InvalidInput("number of objects with a field and a mesh", available, f"at least {tasks.objects}")


def draw_task(library: AssetLibrary, tasks: TaskSet, number: int) -> DrawnTask:
    """One of the tasks.

    Args:
        library: meshes of the objects.
        tasks: which they are.
        number: which of them, from 0.

    Raises:
        InvalidInput: as `check_tasks`.
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit.
    """
    check_tasks(tasks)
    draw = draw_scene(tasks.available, tasks.objects, tasks.seed, number, Stream.TASK_SCENE, MIN_ELEVATION_DEG)
    family: Family = "shifted" if tasks.family == "relit" else tasks.family
    rejected: Counter[str] = Counter()
    for layout in range(_LAYOUTS):
        rng = stream_rng(tasks.seed, Stream.TASK_GOAL, FAMILIES.index(family), number, layout)
        with opened(replace(draw, seed=int(rng.integers(1 << 31))), library) as world:
            start = world.truth()
            names = tuple(start.names[int(n)] for n in rng.permutation(len(start.names)))
            moved = _lay_out(world, family, names, number, rng)
            if moved is not None and came_to_rest(world):
                goal = replace(world.truth(), pusher=None, light=_goal_light(tasks, number, start.light))
                return DrawnTask(RearrangementTask(number, start, goal, moved), dict(rejected))
        rejected["no room" if moved is None else "not at rest"] += 1
    raise NoRoom(draw.names, _LAYOUTS)


def _goal_light(tasks: TaskSet, number: int, light: Light) -> Light:
    if tasks.family != "relit":
        return light
    return Light.random(stream_rng(tasks.seed, Stream.TASK_GOAL_LIGHT, number), MIN_ELEVATION_DEG)


def _lay_out(
    world: Tabletop, family: Family, names: tuple[str, ...], number: int, rng: np.random.Generator
) -> tuple[str, ...] | None:
    """Put some objects where the goal has them; which, or None if one finds no place.

    Args:
        world: with all objects where they start from.
        family: of the task.
        names: of the objects, those that move first.
        number: of the task: kinds of goals take turns.
        rng: draws places and turns.
    """
    kind = number % min(len(names), 3)
    if family == "crowded":
        moved = names[: max(2, kind + 1)]
        return moved if _crowd(world, moved, rng, is_cyclic=kind > 0) else None
    moved = names[: kind + 1]
    turns = _turns(len(moved), rng) if family == "turned" else np.zeros(len(moved))
    return moved if all(_move(world, name, turn, rng) for name, turn in zip(moved, turns, strict=True)) else None


def _turns(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.deg2rad(rng.uniform(*TURN_DEG, count)) * rng.choice([-1.0, 1.0], count)


def _crowd(world: Tabletop, moved: tuple[str, ...], rng: np.random.Generator, *, is_cyclic: bool) -> bool:
    """Each object takes the place of the next; the last one that of the first, or a free one. Whether there is room."""
    start = world.truth()
    if not is_cyclic and not _move(world, moved[-1], 0.0, rng):
        return False
    followers = moved if is_cyclic else moved[:-1]
    now = world.truth()
    positions = now.poses.position.copy()
    for name, other in zip(followers, (*moved[1:], moved[0]), strict=False):
        positions[now.names.index(name), :2] = start.pose(other).position[:2]
    try:
        world.load(replace(now, poses=Pose(positions, now.poses.quaternion), pusher=None))
    except (OverlappingObjects, InvalidInput):
        return False
    return all(world.gap_m(name) >= GAP_M for name in moved)


def _move(world: Tabletop, name: str, turn_rad: float, rng: np.random.Generator) -> bool:
    """Put an object elsewhere in the workspace, clear of all others; whether a place was found."""
    pose = world.truth().pose(name)
    quaternion = quaternion_multiply(quaternion_exp(np.array([0.0, 0.0, turn_rad])), pose.quaternion)
    for _ in range(_PLACES):
        place = np.array([*rng.uniform(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 2), pose.position[2]])
        if np.linalg.norm(place - pose.position) < MIN_SHIFT_M:
            continue
        try:
            world.move_object(name, Pose(place, quaternion))
        except (OverlappingObjects, InvalidInput):
            continue
        if world.gap_m(name) >= GAP_M:
            return True
    return False
