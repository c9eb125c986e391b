"""Poses as the results of BOP: what its toolkit evaluates.

    scene_id,im_id,obj_id,score,R,t,time

R are 9 numbers, row by row, t 3 in mm, separated by spaces: x_camera = R x_model + t in the frame of BOP's model.
Objects here have their origin at the centre of their bounding box; BOP's models of YCB-V have theirs there, too, and
where the folder of other models is given, models_info.json tells where the centre lies. `time` is that of the whole
image [s], -1 where it is not known.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from osfcore.errors import InvalidInput, UnknownName, check_ranges
from osfcore.geometry.cameras import Camera
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.photo.other_programs.bop_models import read_centres
from osfcore.photo.other_programs.ycb_video import NAMES

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
UNKNOWN_TIME = -1.0
_MOST_SCENE = 999_999


def bop_results(
    estimate: EstimatedState,
    cameras: tuple[Camera, ...],
    scene: int,
    models: Path | None = None,
    seconds: float = UNKNOWN_TIME,
) -> str:
    """Every object of a state in every image, as a CSV.

    The score is 1 / (1 + standard deviation of the position [mm]): 1 for a state that says nothing of it, 0 for one
    without bounds. BOP ranks by it.

    Args:
        estimate: of the scene.
        cameras: of the images; their names are the images' numbers, as `osf import bop` gives them.
        scene: number of the scene.
        models: folder with models_info.json; None for BOP's YCB-V.
        seconds: that the estimation took; the same for all images [s].

    Raises:
        InvalidInput: if a camera's name is no number.
        UnknownName: if an object is not one of YCB-V, or models_info.json lacks it.
        CorruptFile: if models_info.json is missing or broken.
    """
    check_ranges(("number of the scene", scene, 0, _MOST_SCENE), ("time [s]", seconds, UNKNOWN_TIME, np.inf))
    centres = read_centres(models)
    lines = [HEADER]
    for camera in cameras:
        if not camera.name.isdecimal():
            raise InvalidInput("name of a camera", camera.name, "the number of its image in BOP's scene")
        T_camera_world = camera.T_world_camera.inverse()
        for name, std in zip(estimate.state.names, estimate.position_std, strict=True):
            if name not in centres:
                raise UnknownName("object of BOP's YCB-V", name, centres)
            pose = T_camera_world @ estimate.state.pose(name)
            lines.append(
                f"{scene},{int(camera.name)},{NAMES.index(name) + 1},{1 / (1 + 1e3 * std):.6g},"
                f"{_in_model_frame(pose, centres[name])},{seconds:g}"
            )
    return "\n".join(lines) + "\n"


def _in_model_frame(pose: Pose, centre: np.ndarray) -> str:
    """R and t [mm] from the model's frame to the camera's, of `T_camera_object`."""
    numbers = quaternion_to_matrix(pose.quaternion).ravel(), 1e3 * pose.apply(-centre)
    return ",".join(" ".join(f"{value:.8f}" for value in part) for part in numbers)
