"""Scenes whose answers are known: rendered by the very renderer that the estimator compares with."""

import numpy as np

from osfcore.estimation.objective import QUALITY, ObjectModels, ObservedViews, SceneParameters
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.states import Observation, SceneState
from osfcore.render.types import Quality, SceneBatch

BOX, BOTTLE = NAMES = ("003_cracker_box", "006_mustard_bottle")
LIGHT = (0.5, 0.3, 0.8)


def shipped_models(names=NAMES) -> ObjectModels:
    library = FieldLibrary(None)
    return ObjectModels({name: library.load(name) for name in names}, library.load_table())


def lying(models, name, number, x, y) -> Pose:
    """An object resting in one of its ways, its centre of mass over (x, y)."""
    resting = models.resting(name)
    quaternion = resting.quaternions[number]
    return Pose(np.array([x, y, resting.heights[number]]) - rotate(quaternion, resting.centre), quaternion)


def scene(poses, light=LIGHT, pusher=None) -> SceneState:
    """A state of objects given as name: Pose."""
    positions = np.array([p.position for p in poses.values()]).reshape(-1, 3)
    quaternions = np.array([p.quaternion for p in poses.values()]).reshape(-1, 4)
    return SceneState(tuple(poses), Pose(positions, quaternions), Light(np.asarray(light, float)), pusher)


def observe(models, state, cameras, *, masks=True) -> Observation:
    """What cameras see, rendered as finely as the estimator's finest comparison."""
    rendered = models.together.render(
        SceneBatch.of(state), cameras, quality=Quality(samples_per_side=2), outputs={"rgb", "masks"}
    )
    return Observation(
        tuple(cameras), rendered.rgb[0].astype(float), state.names, rendered.masks[0] if masks else None,
        state.pusher, 0.0,
    )  # fmt: skip


def own_views(models, params, cameras, quality=QUALITY) -> ObservedViews:
    """Views that the guess explains to the last bit."""
    batch = params.perturbed(np.zeros((1, params.size)))
    rendered = models.together.render(batch, cameras, quality=quality, outputs={"rgb", "opacity"})
    return ObservedViews(tuple(cameras), rendered.rgb[0], rendered.opacity[0], params.pusher, quality)


def params_of(state) -> SceneParameters:
    return SceneParameters.of(state, state.pusher)


def apart(a, b) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much two states or guesses differ: each object [m] and [rad], and the light [rad]."""
    a, b = (s.state() if isinstance(s, SceneParameters) else s for s in (a, b))
    shift = np.linalg.norm(a.poses.position - b.poses.position, axis=1)
    turn = rotation_angle(a.poses.quaternion, b.poses.quaternion)
    return shift, turn, angle(a.light.direction, b.light.direction)


def angle(a, b) -> float:
    """Between two unit vectors [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
