"""Tasks for estimators: first frames, episodes and goals with their truth, and inputs that should be refused.

A task begins with a random scene under a hidden light (`Draw`), which every function here puts together anew: the
same draw is the same scene to the last bit. Observations hold what cameras and robot report; the truth is for
scores alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, OverlappingObjects
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first_calibrated
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.factors import Factor
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import SCENE_CENTRE, Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.collect_pushes import DirectedPolicy
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import HARSH_ELEVATION_DEG, SHIFT_M, Draw, draw_scene, opened

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
        absent: for each object why no image shows it; "" where one does.
    """

    observation: Observation
    truth: SceneState
    absent: tuple[Absence, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Episode:
    """Pushes that follow a first frame.

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
    """Return the scene at rest, with masks and with the pusher in a free place.

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
    """Return pushes that follow the first frame; in the course of them some object moves by 5 cm or more.

    Pushes that move nothing so far are drawn again, a hundred times at most; the last ones are taken in any case.

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
        attempt, (states, actions, moved) = 0, _pushes(world, start, draw.seed, 0, steps)
        while moved.max() < PUSHED_M and attempt < _EPISODES - 1:
            attempt += 1
            states, actions, moved = _pushes(world, start, draw.seed, attempt, steps)
        frames = []
        for state in states:
            world.restore(state)
            frames.append(take_frame(world, cameras, masks=False))
    return Episode(tuple(frames), actions, tuple(moved.tolist()), attempt)


def goals(draw: Draw, library: AssetLibrary, camera: Camera) -> tuple[Goal, ...]:
    """Return goals with one, two and up to all objects elsewhere, each goal under another light.

    These are shifted by 7.5 to 20 cm and turned about the vertical. Where there is no room for an object it stays.

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
    """Return images of the world and its truth.

    Args:
        world: stays as it is.
        cameras: of one image size.
        masks: whether the observation holds masks of each object's visible pixels.
        with_pusher: whether the pusher is seen; where not, the truth has none either.
    """
    observation = world.render(cameras, masks=True, with_pusher=with_pusher)
    truth = world.truth() if with_pusher else replace(world.truth(), pusher=None)
    assert observation.masks is not None
    pixels = observation.masks.sum(axis=(0, 2, 3)).tolist()
    absent: list[Absence] = []
    for place, count in zip(truth.poses.position, pixels, strict=True):
        is_off = place[2] < 0 or np.abs(place[:2]).max() > TABLE_SIDE_M / 2
        absent.append("off the table" if is_off else "" if count > 0 else "out of view")
    return Frame(observation if masks else replace(observation, masks=None), truth, tuple(absent))


def _pushes(
    world: Tabletop, start: SceneState, seed: int, attempt: int, steps: int
) -> tuple[list[SceneState], Float[np.ndarray, "T 3"], Float[np.ndarray, "N"]]:
    """Return the states after each action, the actions, and how far each object came from its first place [m]."""
    world.restore(start)
    policy, states, actions = DirectedPolicy(world.assets, stream_rng(seed, Stream.MEASURED_PUSHES, attempt)), [], []
    for _ in range(steps):
        actions.append(policy.action(world.truth()))
        world.act(actions[-1])
        states.append(world.truth())
    places = np.stack([state.poses.position[:, :2] for state in states])
    return states, np.array(actions), np.linalg.norm(places - start.poses.position[:, :2], axis=2).max(axis=0)


def _moved(world: Tabletop, name: str, pose: Pose, rng: np.random.Generator) -> bool:
    """Put an object elsewhere in the workspace, lying as it lies, and return whether a place was found."""
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


# Inputs that an estimator should refuse or doubt, as faults between a camera and a program make them.
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
        start: for a goal, the sound first frame that shows how the objects lie; None for a first frame.
    """

    kind: str
    observation: Observation
    truth: SceneState
    start: Observation | None = None


@dataclass(frozen=True, slots=True)
class BadScore:
    """An estimator's answer to a bad case.

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
        """Whether the answer is wrong and comes without a warning."""
        return not (self.refused or self.reason or self.is_right)


@dataclass(frozen=True, eq=False, slots=True)
class _Scene:
    """A scene that is not spoiled yet, and random numbers to spoil it with."""

    draw: Draw
    available: tuple[str, ...]
    library: AssetLibrary
    cameras: tuple[Camera, ...]
    rng: np.random.Generator

    def frame(self) -> Frame:
        return first_frame(self.draw, self.library, self.cameras)

    def others(self) -> tuple[str, ...]:
        """Return names of objects that are not in the scene, in random order, at most as many as are in it."""
        rest = [name for name in self.available if name not in self.draw.names]
        return tuple(rest[int(i)] for i in self.rng.permutation(len(rest))[: len(self.draw.names)])


def bad_case(available: Sequence[str], count: int, seed: int, number: int, library: AssetLibrary, size: int) -> BadCase:
    """Return one bad case; kinds take turns.

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
    draw = draw_scene(available, count, seed, FIRST_SCENE + number)
    rng = stream_rng(draw.seed, Stream.SPOILED_INPUT)
    scene = _Scene(draw, tuple(available), library, default_cameras(size), rng)
    return _MAKERS[KINDS[number % len(KINDS)]](scene)


def summary(scores: Sequence[BadScore]) -> dict[str, Any]:
    """Count answers over all cases and by kind.

    A case is refused, or flagged (its estimate as a whole is not trusted), or neither; right ones are counted among
    all of them.
    """

    def counts(kinds: Collection[str]) -> dict[str, int]:
        chosen = [s for s in scores if s.kind in kinds]
        return {
            "cases": len(chosen),
            "refused": sum(bool(s.refused) for s in chosen),
            "flagged": sum(not s.refused and bool(s.reason) for s in chosen),
            "right": sum(s.is_right for s in chosen),
            "confident_wrong": sum(s.is_confidently_wrong for s in chosen),
        }

    present = {s.kind for s in scores}
    total = {f"bad_{key}": value for key, value in counts(present).items()}
    return {**total, "bad_by_kind": {kind: counts({kind}) for kind in KINDS if kind in present}}


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
    return BadCase("black images", replace(frame.observation, images=0 * frame.observation.images), frame.truth)


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


# Warm-up: whatever is done once in a program's life, which no estimate should pay for.


WARM_SCENE = 900_000  # number of a scene that no figure is measured on
_FIRST = FirstFrameConfig(
    starts=1,
    population=4,
    generations=1,
    joint_population=4,
    joint_generations=1,
    coarse_iterations=1,
    fine_iterations=1,
)
# Thresholds of 0 make both search as they do where an object does not fit.
_NEXT = TrackingConfig(fits_below=0.0, lamp_above=0.0, sweeps=1, generations=1)
_GOAL = GoalImageConfig(planar_iterations=1, free_iterations=1, widen_all=True)


def warm_models(
    names: Sequence[str], fields: FieldLibrary, library: AssetLibrary, draw: Draw, size: int, *, goal: bool = True
) -> ObjectModels:
    """Load the fields of objects and table, and do everything that only the first estimate would pay for.

    Args:
        names: of the objects.
        fields: where the fields are.
        library: where the objects' meshes are, for pictures to warm up with.
        draw: a scene of some of the objects, on which nothing is measured.
        size: side of the images [px].
        goal: goals will be estimated too.
    """
    models = ObjectModels({name: fields.load(name) for name in names}, fields.load_table())
    for name in names:
        models.resting(name)
    rng = stream_rng(0, Stream.BENCHMARK)
    observation = first_frame(draw, library, default_cameras(size)).observation
    state = last_estimate(estimate_first_calibrated(models, observation, rng, _FIRST)).state
    last_estimate(estimate_next(models, replace(observation, masks=None), state, rng, _NEXT))
    if goal:
        view = goals(draw, library, goal_camera(size))[0].frame.observation
        last_estimate(estimate_goal(models, view, state, _GOAL))
    return models


def last_estimate(steps: Iterator[EstimateStep]) -> EstimatedState:
    """Run through the steps of an estimate, and return what the last one holds."""
    *_, last = steps
    assert last.estimate is not None, "the last step brings the estimate"
    return last.estimate
