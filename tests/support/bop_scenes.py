"""A scene of ours in the format of BOP, written by its rules."""

import json
from itertools import product
from pathlib import Path

import numpy as np

from osfcore.contrib.bop import NAMES, read_objects
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


def box_masks(cameras, names, poses: Pose) -> np.ndarray:
    """Upright rectangles around the boxes of YCB-V's objects, as masks."""
    sizes, masks = [1e3 * read_objects(None)[NAMES.index(name) + 1].size for name in names], []
    corners = np.array(list(product((-0.5e-3, 0.5e-3), repeat=3)))
    for camera in cameras:
        for number, size in enumerate(sizes):
            pose = Pose(poses.position[number], poses.quaternion[number])
            pixels = camera.project(pose.apply(corners * size)).round().astype(int)
            (left, top), (right, bottom) = pixels.min(axis=0).clip(0), pixels.max(axis=0)
            mask = np.zeros((camera.height, camera.width), bool)
            mask[top:bottom, left:right] = True
            masks.append(mask)
    return np.reshape(masks, (len(cameras), len(names), *masks[0].shape))


def write_models_info(folder: Path, centres, sizes_mm=None, names=None) -> Path:
    """models_info.json of models whose boxes' centres are given [m], by YCB-V's name; with other sizes, and names."""
    folder.mkdir(parents=True)
    info = {}
    for name, centre in centres.items():
        number = NAMES.index(name) + 1
        size = (sizes_mm or {}).get(name, 1e3 * read_objects(None)[number].size)
        low = 1e3 * np.asarray(centre) - np.array(size) / 2
        entry = {f"min_{a}": float(v) for a, v in zip("xyz", low, strict=True)}
        entry |= {f"size_{a}": float(v) for a, v in zip("xyz", size, strict=True)}
        named = {"name": names[name]} if names else {}
        info[str(number)] = {"diameter": 140.0, **entry, **named}
    (folder / "models_info.json").write_text(json.dumps(info))
    return folder
