"""Inputs that an estimator should refuse or doubt: what goes wrong between a camera and a program.

Each case is a random scene of its own, spoiled in one way. What counts in the end is how many answers are wrong and
come without a warning. An answer that is right in spite of everything needs none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from osfcore.experiments.estimation.tasks import Frame, first_frame, goals, take_frame
from osfcore.geometry.cameras import SCENE_CENTRE, Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.states import Observation, SceneState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.random_scenes import Draw, draw_scene, opened

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
