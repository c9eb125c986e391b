"""A small turn of everything that an episode begins with, for a process that waits for its job.

Kernels are read from their caches, threads start, weights get into the disk's cache: half a second or more that nobody
then waits for.
"""

from __future__ import annotations

import numpy as np

from osfcore.dynamics.rollout import load_push_model
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.uncertainty import expected_residuals
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation, SceneState

_ABOVE_M = 0.1


def rehearse() -> None:
    """Render, compare with black images, and predict a push, with one shipped object.

    Raises:
        OsfError: if the package lacks its weights.
    """
    fields = FieldLibrary(None)
    names = fields.names()[:1]
    models = ObjectModels({name: fields.load(name) for name in names}, fields.load_table())
    pose = Pose(np.array([[0.0, 0.0, _ABOVE_M]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    state = SceneState(names, pose, Light.from_angles(0.0, 1.0), np.array([0.2, 0.2, 0.02]))
    cameras = default_cameras()
    black = np.zeros((len(cameras), cameras[0].height, cameras[0].width, 3), np.float32)
    expected_residuals(models, Observation(cameras, black, names, None, state.pusher, 0.0), state)
    load_push_model(None, fields, names).rollout(state, np.zeros((1, 1, 3)))
