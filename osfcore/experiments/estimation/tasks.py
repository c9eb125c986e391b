"""What estimators are measured on: first frames, episodes of pushes, and goals, with the truth kept apart from them.

A task begins with a random scene under a hidden light (`Draw`), which every function here puts together anew: the same
draw is the same scene to the last bit. Observations hold what cameras and robot report; the truth is for scores alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, OverlappingObjects
from osfcore.experiments.rearrangement.factors import Factor
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.collection.policies import DirectedPolicy
from osfcore.world.goal_layouts import SHIFT_M
from osfcore.world.random_scenes import HARSH_ELEVATION_DEG, Draw, opened
from osfcore.world.tabletop import Tabletop

STEPS = 20  # of an episode
PUSHED_M = 0.05  # an episode in which no object comes so far is drawn again
Absence = Literal["", "off the table", "out of view"]
_EPISODES = 100  # in which chance may fail to push anything
_PLACES = 100  # that a goal tries for an object


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One instant.

    Attributes:
        observation: what an estimator may see.
        truth: what it must not see.
        absent: for each object why no image tells where it is; "" where some does.
    """

    observation: Observation
    truth: SceneState
    absent: tuple[Absence, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Episode:
    """What follows a first frame.

    Attributes:
        frames: after each of the steps, without masks.
        actions: one before each of them [m/s].
        moved_m: the farthest that each object came from its first place on the table's plane [m].
        redrawn: how often the pushes were drawn again because they moved nothing far enough.
    """

    frames: tuple[Frame, ...]
    actions: Float[np.ndarray, "T 3"]
    moved_m: tuple[float, ...]
    redrawn: int


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """A scene as it shall become, seen by the goal camera alone, without pusher and masks.

    Attributes:
        frame: image and truth.
        moved: the objects that lie elsewhere than in the first frame.
    """

    frame: Frame
    moved: tuple[str, ...]


def first_frame(draw: Draw, library: AssetLibrary, cameras: tuple[Camera, ...], factor: Factor | None = None) -> Frame:
    """The scene at rest, with masks and with the pusher in a free place.

    Args:
        draw: the scene.
        library: meshes of its objects.
        cameras: of one image size, as they are calibrated.
        factor: how the scene and its pictures differ from the usual; the truth stays the truth.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    factor, rng = factor or Factor(), stream_rng(draw.seed, Stream.FACTOR_FRAME)
    lit = replace(draw, light=factor.light(draw.light, rng))
    errors = factor.camera_errors(rng, len(cameras))
    standing = tuple(error.applied(camera) for error, camera in zip(errors, cameras, strict=True))
    with opened(lit, library, factor.drawn_conditions(rng)) as world:
        frame = take_frame(world, standing, masks=True)
    return replace(frame, observation=factor.received(frame.observation, cameras, rng))


def episode(draw: Draw, library: AssetLibrary, cameras: tuple[Camera, ...], *, steps: int = STEPS) -> Episode:
    """Pushes that follow the first frame; in the course of them some object moves by 5 cm or more.

    Pushes that move nothing so far are drawn again, a hundred times at most; `moved_m` tells.

    Args:
        draw: the scene.
        library: meshes of its objects.
        cameras: of one image size.
        steps: actions of 0.2 s, one frame after each.

    Raises:
        UnknownName, MissingAssets, NoRoom: as for the first frame.
    """
    with opened(draw, library) as world:
        start = world.truth()
        for attempt in range(_EPISODES):
            states, actions = _pushes(world, start, stream_rng(draw.seed, Stream.MEASURED_PUSHES, attempt), steps)
            places = np.stack([state.poses.position[:, :2] for state in states])
            moved = np.linalg.norm(places - start.poses.position[:, :2], axis=2).max(axis=0)
            if moved.max() >= PUSHED_M or attempt == _EPISODES - 1:
                frames = []
                for state in states:
                    world.restore(state)
                    frames.append(take_frame(world, cameras, masks=False))
                return Episode(tuple(frames), actions, tuple(moved.tolist()), attempt)
    raise AssertionError("the last attempt returns")


def goals(draw: Draw, library: AssetLibrary, camera: Camera) -> tuple[Goal, ...]:
    """For each m from 1 to all objects: m of them shifted by 7.5 to 20 cm and turned about the vertical, another light.

    Where there is no room for an object it stays; the goal tells which ones moved.

    Args:
        draw: the scene.
        library: meshes of its objects.
        camera: sees the goals.

    Raises:
        UnknownName, MissingAssets, NoRoom: as for the first frame.
    """
    goals = []
    with opened(draw, library) as world:
        start = world.truth()
        for count in range(1, len(draw.names) + 1):
            rng = stream_rng(draw.seed, Stream.MEASURED_GOAL, count)
            world.restore(start)
            world.set_light(Light.random(rng, HARSH_ELEVATION_DEG))
            chosen = [draw.names[int(n)] for n in rng.permutation(len(draw.names))[:count]]
            moved = tuple(name for name in chosen if _moved(world, name, start.pose(name), rng))
            for _ in world.settle():
                pass
            goals.append(Goal(take_frame(world, (camera,), masks=False, with_pusher=False), moved))
    return tuple(goals)


def take_frame(world: Tabletop, cameras: tuple[Camera, ...], *, masks: bool, with_pusher: bool = True) -> Frame:
    """The world as it is.

    Args:
        world: stays as it is.
        cameras: of one image size.
        masks: whether the observation tells each object's visible pixels.
        with_pusher: whether the pusher is seen; where not, the truth has none either.
    """
    observation = world.render(cameras, masks=True, with_pusher=with_pusher)
    truth = world.truth() if with_pusher else replace(world.truth(), pusher=None)
    assert observation.masks is not None
    pixels = observation.masks.sum(axis=(0, 2, 3)).tolist()
    places = zip(truth.poses.position, pixels, strict=True)
    absent: tuple[Absence, ...] = tuple(_absence(place, is_seen=count > 0) for place, count in places)
    return Frame(observation if masks else replace(observation, masks=None), truth, absent)


def _absence(place: np.ndarray, *, is_seen: bool) -> Absence:
    if place[2] < 0 or np.abs(place[:2]).max() > TABLE_SIDE_M / 2:
        return "off the table"
    return "" if is_seen else "out of view"


def _pushes(
    world: Tabletop, start: SceneState, rng: np.random.Generator, steps: int
) -> tuple[list[SceneState], Float[np.ndarray, "T 3"]]:
    """States after each action, and the actions."""
    world.restore(start)
    policy, states, actions = DirectedPolicy(world.assets, rng), [], []
    for _ in range(steps):
        actions.append(policy.action(world.truth()))
        world.act(actions[-1])
        states.append(world.truth())
    return states, np.array(actions)


def _moved(world: Tabletop, name: str, pose: Pose, rng: np.random.Generator) -> bool:
    """Put an object elsewhere in the workspace, lying as it lies; whether a place was found."""
    for _ in range(_PLACES):
        angle, distance, turn = rng.uniform(-np.pi, np.pi), rng.uniform(*SHIFT_M), rng.uniform(-np.pi, np.pi)
        place = pose.position + np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0])
        if np.abs(place[:2]).max() > WORKSPACE_HALF_M:
            continue
        about_z = quaternion_exp(np.array([0.0, 0.0, turn]))
        try:
            world.move_object(name, Pose(place, quaternion_multiply(about_z, pose.quaternion)))
        except (OverlappingObjects, InvalidInput):
            continue
        return True
    return False
