"""Rearrangement tasks: random scenes, and goals to which some of their objects shall move."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects, check_known, check_ranges
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.scenes import GAP_M, Conditions, SceneRequest
from osfcore.world.simulators import Simulator, default_simulator
from osfcore.world.tabletop import Tabletop

# Random scenes by number: none depends on the others.


HARSH_ELEVATION_DEG = 10.0
_LAYOUTS = 10  # arrangements that are tried where objects do not fit


@dataclass(frozen=True, slots=True)
class Draw:
    """A random choice of a scene's objects and light.

    Attributes:
        names: its objects.
        light: above the table.
        seed: seed of the arrangement.
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
    """Draw one of many random scenes.

    Args:
        available: objects to choose from, `count` or more.
        count: objects in the scene.
        seed: seed of all the scenes.
        number: which of them.
        stream: stream of random numbers that they are drawn from.
        min_elevation_deg: least elevation of their lights [deg].
    """
    rng = stream_rng(seed, stream, number)
    light = Light.random(rng, min_elevation_deg)
    arrangement = int(rng.integers(1 << 31))
    chosen = rng.permutation(len(available))[:count]
    return Draw(tuple(available[int(i)] for i in chosen), light, arrangement)


@contextmanager
def opened(
    draw: Draw, library: AssetLibrary, conditions: Conditions | None = None, *, is_upright: bool = False
) -> Iterator[Tabletop]:
    """Open the draw's scene as a world, under the usual conditions or others; close it at the end."""
    request = SceneRequest(names=draw.names, light=draw.light, is_upright=is_upright)
    world = Tabletop(library, request=request, conditions=conditions)
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
    """Move some objects to free places; return the goal and which moved, or None if there is no room.

    The world is left as the goal is, at rest, or in any state if there is none.

    Args:
        world: with the objects where they start from.
        count: number of objects that move.
        rng: chooses them and their places.
    """
    start = world.truth()
    moved = tuple(start.names[int(n)] for n in rng.permutation(len(start.names))[:count])
    if not all(_shift(world, name, start.pose(name), rng) for name in moved):
        return None
    return (replace(world.truth(), pusher=None), moved) if came_to_rest(world) else None


def came_to_rest(world: Tabletop) -> bool:
    """Let everything settle; return whether all objects stayed where they were, within 2 mm and 0.03 rad."""
    asked = world.truth()
    for _ in world.settle():
        pass
    rests = world.truth()
    shift = np.linalg.norm(rests.poses.position - asked.poses.position, axis=1)
    turn = rotation_angle(rests.poses.quaternion, asked.poses.quaternion)
    return bool(shift.max() <= _RESTS_M and turn.max() <= _RESTS_RAD)


def _shift(world: Tabletop, name: str, pose: Pose, rng: np.random.Generator) -> bool:
    """Shift an object within the workspace; return whether a free place was found."""
    for _ in range(_PLACES):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*SHIFT_M)
        place = pose.position + np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0])
        if np.abs(place[:2]).max() <= WORKSPACE_HALF_M and _put(world, name, Pose(place, pose.quaternion)):
            return True
    return False


def _put(world: Tabletop, name: str, pose: Pose) -> bool:
    """Try to put an object somewhere; return whether it is there, clear of all others."""
    try:
        world.move_object(name, pose)
    except (OverlappingObjects, InvalidInput):
        return False
    return world.gap_m(name) >= GAP_M


def random_goal(world: Tabletop, seed: int, moved: int | None) -> tuple[SceneState, tuple[str, ...]]:
    """Move some objects of a simulated table to random places, to make a goal. The world stays in the goal state.

    Args:
        world: world with the objects at their start.
        seed: seed of everything random.
        moved: number of objects that move; None for a random number.

    Returns:
        The goal state, and the names of the objects that moved.

    Raises:
        InvalidInput: if `moved` is not between 1 and the number of objects.
        NoRoom: if no layout without overlaps was found.

    Example:
        >>> world = Tabletop(assets, request=SceneRequest(names=(name,)))
        >>> world.arrange(seed=0)
        >>> goal_state, moved = random_goal(world, seed=1, moved=1)
        >>> moved
        ('006_mustard_bottle',)
        >>> world.close()
    """
    start = world.truth()
    if moved is not None:
        check_ranges(("number of objects that move", moved, 1, len(start.names)))
    for attempt in range(_GOALS):
        rng = stream_rng(seed, Stream.GOAL_LAYOUT, attempt)
        count = int(rng.integers(1, len(start.names) + 1)) if moved is None else moved
        world.restore(start)
        goal = draw_goal(world, count, rng)
        if goal is not None:
            return goal
    raise NoRoom(start.names, _GOALS)


def arranged_goal(world: Tabletop, poses: Mapping[str, Pose], *, is_measured: bool = False) -> SceneState:
    """Put some objects at given poses and let the table settle; return how it rests.

    The world is left like that, or in any state if an error is raised.

    Args:
        world: with the objects.
        poses: poses of some of them.
        is_measured: the poses may err: objects that penetrate are moved apart first.

    Raises:
        UnknownName: if an object is not on the table.
        InvalidInput: if an object would not be over the table.
        OverlappingObjects: if objects would overlap, unless poses are measured.
    """
    state = world.truth()
    check_known("object on the table", poses, state.names)
    stacked = Pose.stacked(poses.get(name, state.pose(name)) for name in state.names)
    (world.load_measured if is_measured else world.load)(replace(state, poses=stacked, pusher=None))
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
# Five families:
#
#     shifted   objects lie elsewhere, as they lay.
#     turned    objects lie elsewhere and turned about the vertical by 30 to 180 deg.
#     crowded   the place of an object is taken by another one, which has to move first: it goes to a free place (2
#               move), to that of the first one (a swap), or to that of a third one, which takes the first one's place.
#     relit     the tasks of `shifted`; the goal is photographed under another light.
#     upright   as `shifted`, but all objects stand upright, where the published estimation begins.
#
# Each task draws the objects; their resting orientations and places, as `place_randomly` does; a light, uniform
# over the sky 5 deg and more above the table; which objects move, in turn 1, 2 and 3 of them (crowded: 2, 2 and 3);
# for each a place, uniform in the workspace and at least 7.5 cm from where it lies (the paper's least displacement).
# A layout is drawn anew if an object finds no place 1 cm clear of all others, or if it does not rest: an object
# moves by more than 2 mm or 0.03 rad when it is let go.


Family = Literal["shifted", "turned", "crowded", "relit", "upright"]
FAMILIES: tuple[Family, ...] = get_args(Family)
MAX_OBJECTS = 6  # in a scene
MIN_SHIFT_M = 0.075
TURN_DEG = (30.0, 180.0)
MIN_ELEVATION_DEG = 5.0
_TASK_LAYOUTS = 60  # of a task, until one has room for where its objects shall go
_TASK_PLACES = 100  # that each object tries


@dataclass(frozen=True, slots=True)
class TaskSet:
    """A set of tasks, none of which depends on the others.

    Attributes:
        available: objects to choose from.
        family: what their goals ask for.
        objects: in each scene.
        seed: seed of all of them.
        simulator: in which their objects come to rest.
    """

    available: tuple[str, ...]
    family: Family = "shifted"
    objects: int = 3
    seed: int = 0
    simulator: Simulator = field(default_factory=default_simulator)


@dataclass(frozen=True, eq=False, slots=True)
class DrawnTask:
    """A task, and the layouts that were rejected before it.

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
    check_ranges(("objects in a scene", tasks.objects, least, MAX_OBJECTS))
    available = len(tasks.available)
    if available < tasks.objects:
        raise InvalidInput("number of objects with a field and a mesh", available, f"at least {tasks.objects}")


def draw_task(library: AssetLibrary, tasks: TaskSet, number: int) -> DrawnTask:
    """Draw one task of a set.

    Args:
        library: meshes of the objects.
        tasks: the set.
        number: number of the task, from 0.

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
        arranged, is_upright = replace(draw, seed=int(rng.integers(1 << 31))), family == "upright"
        with opened(arranged, library, Conditions(simulator=tasks.simulator), is_upright=is_upright) as world:
            start = world.truth()
            names = tuple(start.names[int(n)] for n in rng.permutation(len(start.names)))
            moved = _lay_out(world, family, names, number, rng)
            if moved is not None and came_to_rest(world):
                light = start.light
                if tasks.family == "relit":
                    lights = stream_rng(tasks.seed, Stream.TASK_GOAL_LIGHT, number)
                    light = Light.random(lights, MIN_ELEVATION_DEG)
                goal = replace(world.truth(), pusher=None, light=light)
                return DrawnTask(RearrangementTask(number, start, goal, moved), dict(rejected))
        rejected["no room" if moved is None else "not at rest"] += 1
    raise NoRoom(draw.names, _TASK_LAYOUTS)


def _lay_out(
    world: Tabletop, family: Family, names: tuple[str, ...], number: int, rng: np.random.Generator
) -> tuple[str, ...] | None:
    """Put some objects at their goals; return which, or None if one finds no place.

    Args:
        world: with all objects where they start from.
        family: family of the task.
        names: names of the objects, those that move first.
        number: number of the task: kinds of goals take turns.
        rng: draws places and turns.
    """
    kind = number % min(len(names), 3)
    if family == "crowded":
        moved = names[: max(2, kind + 1)]
        return moved if _crowd(world, moved, rng, is_cyclic=kind > 0) else None
    moved = names[: kind + 1]
    turns = np.zeros(len(moved))
    if family == "turned":
        turns = np.deg2rad(rng.uniform(*TURN_DEG, len(moved))) * rng.choice([-1.0, 1.0], len(moved))
    return moved if all(_move(world, name, turn, rng) for name, turn in zip(moved, turns, strict=True)) else None


def _crowd(world: Tabletop, moved: tuple[str, ...], rng: np.random.Generator, *, is_cyclic: bool) -> bool:
    """Put each object at the place of the next, the last one at that of the first or a free one.

    Returns:
        Whether there is room.
    """
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
    """Put an object elsewhere in the workspace, turned; return whether a free place was found."""
    pose = world.truth().pose(name)
    quaternion = quaternion_multiply(quaternion_exp(np.array([0.0, 0.0, turn_rad])), pose.quaternion)
    for _ in range(_TASK_PLACES):
        place = np.array([*rng.uniform(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 2), pose.position[2]])
        if np.linalg.norm(place - pose.position) >= MIN_SHIFT_M and _put(world, name, Pose(place, quaternion)):
            return True
    return False
