"""Rearrangement tasks: random scenes, and where some of their objects are to go."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects, UnknownName
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.scenes import GAP_M, Conditions, SceneRequest
from osfcore.world.tabletop import Tabletop

# Random scenes by number: each is the same again without the others, to the last bit.


HARSH_ELEVATION_DEG = 10.0
_LAYOUTS = 10  # arrangements that are tried where objects do not fit


@dataclass(frozen=True, slots=True)
class Draw:
    """What chance decided about a scene.

    Attributes:
        names: its objects.
        light: above the table.
        seed: of the arrangement.
    """

    names: tuple[str, ...]
    light: Light
    seed: int


def draw_scene(
    available: Sequence[str],
    count: int,
    seed: int,
    number: int,
    stream: Stream = Stream.SCENE,
    min_elevation_deg: float = HARSH_ELEVATION_DEG,
) -> Draw:
    """One of many random scenes; it does not depend on the others.

    Args:
        available: objects to choose from, `count` or more.
        count: objects in the scene.
        seed: of all the scenes.
        number: which of them.
        stream: that they are drawn from.
        min_elevation_deg: of their lights.
    """
    rng = stream_rng(seed, stream, number)
    light = Light.random(rng, min_elevation_deg)
    arrangement = int(rng.integers(1 << 31))
    chosen = rng.permutation(len(available))[:count]
    return Draw(tuple(available[int(i)] for i in chosen), light, arrangement)


@contextmanager
def opened(draw: Draw, library: AssetLibrary, conditions: Conditions | None = None) -> Iterator[Tabletop]:
    """The draw's scene as a world, for as long as it is needed, under the usual conditions or others."""
    world = Tabletop(library, request=SceneRequest(names=draw.names, light=draw.light), conditions=conditions)
    try:
        for attempt in range(_LAYOUTS):
            try:
                world.arrange(draw.seed + attempt)
                break
            except NoRoom:
                if attempt == _LAYOUTS - 1:
                    raise
        yield world
    finally:
        world.close()


# Random goal layouts: some objects shifted to free places, at rest (paper, section 5.4).


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


# Rearrangement tasks: scenes at rest, some objects of which shall lie elsewhere (paper, section 5.4).
#
# Four families:
#
#     shifted   objects lie elsewhere, as they lay.
#     turned    objects lie elsewhere and turned about the vertical by 30 to 180 deg.
#     crowded   the place of an object is taken by another one, which has to move first: it goes to a free place (2
#               move), to that of the first one (a swap), or to that of a third one, which takes the first one's place.
#     relit     the tasks of `shifted`; the goal is photographed under another light.
#
# Drawn are: the objects; their resting orientations and places, as `placing` does; a light, uniform over the sky 5
# deg and more above the table; which objects move, in turn 1, 2 and 3 of them (crowded: 2, 2 and 3); for each a
# place, uniform in the workspace and at least 7.5 cm from where it lies (the paper's least displacement). Rejected
# and drawn anew are layouts in which an object finds no place 1 cm clear of all others, and those that do not rest:
# where an object moves by more than 2 mm or 0.03 rad when it is let go.


Family = Literal["shifted", "turned", "crowded", "relit"]
FAMILIES: tuple[Family, ...] = get_args(Family)
MAX_OBJECTS = 6  # in a scene
MIN_SHIFT_M = 0.075
TURN_DEG = (30.0, 180.0)
MIN_ELEVATION_DEG = 5.0
_TASK_LAYOUTS = 60  # of a task, until one has room for where its objects shall go
_TASK_PLACES = 100  # that each object tries


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
    for layout in range(_TASK_LAYOUTS):
        rng = stream_rng(tasks.seed, Stream.TASK_GOAL, FAMILIES.index(family), number, layout)
        with opened(replace(draw, seed=int(rng.integers(1 << 31))), library) as world:
            start = world.truth()
            names = tuple(start.names[int(n)] for n in rng.permutation(len(start.names)))
            moved = _lay_out(world, family, names, number, rng)
            if moved is not None and came_to_rest(world):
                goal = replace(world.truth(), pusher=None, light=_goal_light(tasks, number, start.light))
                return DrawnTask(RearrangementTask(number, start, goal, moved), dict(rejected))
        rejected["no room" if moved is None else "not at rest"] += 1
    raise NoRoom(draw.names, _TASK_LAYOUTS)


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
    for _ in range(_TASK_PLACES):
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
