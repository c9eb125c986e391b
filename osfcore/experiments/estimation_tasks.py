"""Tasks for estimators: first frames, episodes and goals with their truth, and inputs that should be refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, OverlappingObjects
from osfcore.experiments.factors import Factor
from osfcore.geometry.cameras import SCENE_CENTRE, Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.collect_pushes import DirectedPolicy
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import HARSH_ELEVATION_DEG, SHIFT_M, Draw, draw_scene, opened

# What estimators are measured on: first frames, episodes of pushes, and goals, with the truth kept apart from them.
#
# A task begins with a random scene under a hidden light (`Draw`), which every function here puts together anew: the
# same draw is the same scene to the last bit. Observations hold what cameras and robot report; the truth is for
# scores alone.


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


# Inputs that an estimator should refuse or doubt: what goes wrong between a camera and a program.
#
# Each case is a random scene of its own, spoiled in one way. What counts in the end is how many answers are wrong
# and come without a warning. An answer that is right in spite of everything needs none.


FIRST_SCENE = 500_000  # bad cases begin with scenes from this number on, which no other part uses
_FEW_PX = 6  # that remain of an object's mask
_GAIN = 8.0
_MOVED_M = (0.1, 0.2)
_LOW_DEG = (10.0, 13.0)


@dataclass(frozen=True, eq=False, slots=True)
class BadCase:
    """A spoiled input.

    Attributes:
        kind: what is wrong with it.
        observation: what the estimator is shown.
        truth: what is there; it may hold other objects than the observation names.
        start: for a goal, the sound first frame that tells how the objects lie; None for a first frame.
    """

    kind: str
    observation: Observation
    truth: SceneState
    start: Observation | None = None


@dataclass(frozen=True, slots=True)
class BadScore:
    """What became of a bad case.

    Attributes:
        kind: what was wrong with it.
        refused: the estimator's sentence, if it would not look at it; else "".
        reason: why the estimate is not to be trusted; "" if it claims to be good.
        is_right: every object was found, under 1 cm and 5 deg.
        position_mm: errors of objects that are there [mm].
        rotation_deg: likewise [deg].
        seconds: that it took.
    """

    kind: str
    refused: str
    reason: str
    is_right: bool
    position_mm: tuple[float, ...] = ()
    rotation_deg: tuple[float, ...] = ()
    seconds: float = 0.0

    @property
    def is_confidently_wrong(self) -> bool:
        """Wrong without a warning."""
        return not (self.refused or self.reason or self.is_right)


@dataclass(frozen=True, eq=False, slots=True)
class _Scene:
    """What a case is made of."""

    draw: Draw
    available: tuple[str, ...]
    library: AssetLibrary
    cameras: tuple[Camera, ...]
    rng: np.random.Generator

    def frame(self) -> Frame:
        return first_frame(self.draw, self.library, self.cameras)

    def others(self) -> tuple[str, ...]:
        """Names of objects that are not in the scene, in random order, as many as are in it if there are."""
        rest = [name for name in self.available if name not in self.draw.names]
        return tuple(rest[int(i)] for i in self.rng.permutation(len(rest))[: len(self.draw.names)])


def bad_case(available: Sequence[str], count: int, seed: int, number: int, library: AssetLibrary, size: int) -> BadCase:
    """The number-th bad case; kinds take turns.

    Args:
        available: names of objects to draw from; more than `count`.
        count: objects in a scene; two or more.
        seed: of all cases.
        number: of this one.
        library: where the objects' meshes are.
        size: side of the images [px].

    Raises:
        UnknownName, MissingAssets, NoRoom: as scenes are made.
    """
    kind = KINDS[number % len(KINDS)]
    draw = draw_scene(available, count, seed, FIRST_SCENE + number)
    rng = stream_rng(draw.seed, Stream.SPOILED_INPUT)
    scene = _Scene(draw, tuple(available), library, default_cameras(size), rng)
    return _MAKERS[kind](scene)


def summary(scores: Sequence[BadScore]) -> dict[str, Any]:
    """Counts over all cases and by kind.

    A case is refused, or flagged (its estimate as a whole is not trusted), or neither; right ones are counted among
    all of them.
    """

    def counts(chosen: Sequence[BadScore]) -> dict[str, int]:
        return {
            "cases": len(chosen),
            "refused": sum(bool(s.refused) for s in chosen),
            "flagged": sum(not s.refused and bool(s.reason) for s in chosen),
            "right": sum(s.is_right for s in chosen),
            "confident_wrong": sum(s.is_confidently_wrong for s in chosen),
        }

    by_kind = {kind: counts([s for s in scores if s.kind == kind]) for kind in KINDS}
    total = {f"bad_{key}": value for key, value in counts(scores).items()}
    return {**total, "bad_by_kind": {kind: row for kind, row in by_kind.items() if row["cases"]}}


def _swapped_masks(scene: _Scene) -> BadCase:
    frame = scene.frame()
    masks = _masks(frame).copy()
    first, second = scene.rng.permutation(len(scene.draw.names))[:2]
    masks[:, [first, second]] = masks[:, [second, first]]
    return BadCase("swapped masks", replace(frame.observation, masks=masks), frame.truth)


def _hardly_masked(scene: _Scene) -> BadCase:
    """A mask in one view only, where something hides all but a few pixels of the object."""
    frame = scene.frame()
    observation, masks = frame.observation, _masks(frame).copy()
    n = int(scene.rng.integers(len(scene.draw.names)))
    view = int(np.argmax(masks[:, n].sum(axis=(1, 2))))
    own = np.argwhere(masks[view, n])
    images = observation.images.copy()
    images[view][masks[view, n]] = scene.rng.uniform(0.1, 0.6, 3)  # a hand, say
    masks[:, n] = False
    rows, columns = own[:_FEW_PX].T
    masks[view, n, rows, columns] = True
    images[view, rows, columns] = observation.images[view, rows, columns]
    return BadCase("mask in one view", replace(observation, images=images, masks=masks), frame.truth)


def _wrong_name(scene: _Scene) -> BadCase:
    frame = scene.frame()
    names = list(scene.draw.names)
    names[int(scene.rng.integers(len(names)))] = scene.others()[0]
    return BadCase("wrong name", replace(frame.observation, names=tuple(names)), frame.truth)


def _black(scene: _Scene) -> BadCase:
    frame = scene.frame()
    images = np.zeros_like(frame.observation.images)
    return BadCase("black images", replace(frame.observation, images=images), frame.truth)


def _saturated(scene: _Scene) -> BadCase:
    frame = scene.frame()
    images = np.clip(_GAIN * frame.observation.images, 0, 1)
    return BadCase("saturated images", replace(frame.observation, images=images), frame.truth)


def _moved_camera(scene: _Scene) -> BadCase:
    """One camera was pushed aside by 10 to 20 cm and looks elsewhere, and nobody knows."""
    which = int(scene.rng.integers(len(scene.cameras)))
    camera = scene.cameras[which]
    aside, target = (_shift(scene.rng) for _ in range(2))
    place = camera.T_world_camera.position + aside
    moved = Camera.look_at(camera.name, place, np.array(SCENE_CENTRE) + target, size=camera.width)
    cameras = (*scene.cameras[:which], moved, *scene.cameras[which + 1 :])
    frame = first_frame(scene.draw, scene.library, cameras)
    return BadCase("moved camera", replace(frame.observation, cameras=scene.cameras), frame.truth)


def _one_low_view(scene: _Scene) -> BadCase:
    """A single view under a grazing light: not wrong, but little to go by."""
    light = Light.from_angles(scene.rng.uniform(-np.pi, np.pi), np.deg2rad(scene.rng.uniform(*_LOW_DEG)))
    which = int(scene.rng.integers(len(scene.cameras)))
    frame = first_frame(replace(scene.draw, light=light), scene.library, scene.cameras[which : which + 1])
    return BadCase("one view, low light", frame.observation, frame.truth)


def _foreign_image(scene: _Scene) -> BadCase:
    """One camera's image and masks are of the same objects at another time."""
    frame = scene.frame()
    later = first_frame(replace(scene.draw, seed=scene.draw.seed + 1_000), scene.library, scene.cameras)
    which = int(scene.rng.integers(len(scene.cameras)))
    images, masks = frame.observation.images.copy(), _masks(frame).copy()
    images[which], masks[which] = later.observation.images[which], _masks(later)[which]
    return BadCase("image of another scene", replace(frame.observation, images=images, masks=masks), frame.truth)


def _other_objects(scene: _Scene) -> BadCase:
    """A goal image that shows other objects."""
    start, camera = scene.frame(), goal_camera(scene.cameras[0].width)
    other = replace(scene.draw, names=scene.others(), light=Light.random(scene.rng))
    with opened(other, scene.library) as world:
        goal = take_frame(world, (camera,), masks=False, with_pusher=False)
    shown = replace(goal.observation, names=scene.draw.names)
    return BadCase("goal of other objects", shown, goal.truth, start.observation)


def _other_camera(scene: _Scene) -> BadCase:
    """A goal image from one of the other cameras."""
    start, camera = scene.frame(), goal_camera(scene.cameras[0].width)
    taken_by = scene.cameras[int(scene.rng.integers(len(scene.cameras)))]
    goal = goals(scene.draw, scene.library, taken_by)[-1].frame
    shown = replace(goal.observation, cameras=(camera,))
    return BadCase("goal from another camera", shown, goal.truth, start.observation)


def _masks(frame: Frame) -> np.ndarray:
    assert frame.observation.masks is not None
    return frame.observation.masks


def _shift(rng: np.random.Generator) -> np.ndarray:
    """A horizontal shift by 10 to 20 cm."""
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*_MOVED_M)
    return np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0])


_MAKERS: dict[str, Callable[[_Scene], BadCase]] = {
    "swapped masks": _swapped_masks,
    "mask in one view": _hardly_masked,
    "wrong name": _wrong_name,
    "black images": _black,
    "saturated images": _saturated,
    "moved camera": _moved_camera,
    "one view, low light": _one_low_view,
    "image of another scene": _foreign_image,
    "goal of other objects": _other_objects,
    "goal from another camera": _other_camera,
}
KINDS = tuple(_MAKERS)
