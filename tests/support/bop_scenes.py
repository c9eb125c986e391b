"""A scene of ours in the format of BOP, written by its rules."""

import json
from pathlib import Path

import numpy as np

from osfcore.contrib.bop import NAMES
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.states import Observation, SceneState
from osfcore.io.image_file import to_uint8, write_png


def write_bop_scene(folder: Path, observation: Observation, state: SceneState, centres=None) -> Path:
    """Images 3, 6, 9, ...; models have their boxes' centres at `centres` [m], by name."""
    cameras, annotations = {}, {}
    for view, camera in enumerate(observation.cameras):
        image, T_camera_world = 3 * (view + 1), camera.T_world_camera.inverse()
        K = camera.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        cameras[str(image)] = {
            "cam_K": K.ravel().tolist(),
            "cam_R_w2c": quaternion_to_matrix(T_camera_world.quaternion).ravel().tolist(),
            "cam_t_w2c": (1e3 * T_camera_world.position).tolist(),
            "depth_scale": 0.1,
        }
        annotations[str(image)] = []
        for number, name in enumerate(observation.names):
            pose = T_camera_world @ state.pose(name)
            shift = pose.apply(-np.asarray((centres or {}).get(name, np.zeros(3))))
            annotations[str(image)].append(annotation(Pose(shift, pose.quaternion), NAMES.index(name) + 1))
            mask = observation.masks[view, number].astype(np.uint8) * 255
            write_png(folder / "mask_visib" / f"{image:06d}_{number:06d}.png", mask)
        write_png(folder / "rgb" / f"{image:06d}.png", to_uint8(observation.images[view]))
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(annotations))
    return folder


def annotation(T_camera_model: Pose, number: int) -> dict:
    """One entry of scene_gt.json."""
    R = quaternion_to_matrix(T_camera_model.quaternion).ravel().tolist()
    return {"cam_R_m2c": R, "cam_t_m2c": (1e3 * T_camera_model.position).tolist(), "obj_id": number}


def write_models_info(folder: Path, centres, size_mm=(60.0, 80.0, 100.0)) -> Path:
    """models_info.json of models whose boxes' centres are given [m]."""
    folder.mkdir()
    info = {}
    for name, centre in centres.items():
        low = 1e3 * np.asarray(centre) - np.array(size_mm) / 2
        entry = {f"min_{a}": float(v) for a, v in zip("xyz", low, strict=True)}
        entry |= {f"size_{a}": v for a, v in zip("xyz", size_mm, strict=True)}
        info[str(NAMES.index(name) + 1)] = {"diameter": 140.0, **entry}
    (folder / "models_info.json").write_text(json.dumps(info))
    return folder
