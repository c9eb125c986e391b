"""scene.json: a scene with its cameras as a file, checked when read.

    {"objects": [{"name", "position": [3], "quaternion": [w, x, y, z]}], "light": {"position": [3]},
     "pusher": {"position": [3]}, "cameras": [{"name", "T_world_camera": 4x4, "K": 3x3, "width", "height"}]}

`pusher` and `cameras` may be missing. Metres, z up, unit quaternions.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from osfcore.errors import InvalidInput, finite_vector
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.files import as_mapping, entry_of, list_of, read_json


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """A state and the cameras that look at it."""

    state: SceneState
    cameras: tuple[Camera, ...]


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """The scene as plain lists and numbers."""
    state = scene.state
    result: dict[str, Any] = {
        "objects": [
            {"name": name, "position": p.tolist(), "quaternion": q.tolist()}
            for name, p, q in zip(state.names, state.poses.position, state.poses.quaternion, strict=True)
        ],
        "light": {"position": state.light.position.tolist()},
    }
    if state.pusher is not None:
        result["pusher"] = {"position": state.pusher.tolist()}
    result["cameras"] = [camera_to_json(camera) for camera in scene.cameras]
    return result


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """One camera as plain lists and numbers."""
    return {
        "name": camera.name,
        "T_world_camera": camera.T_world_camera.matrix().tolist(),
        "K": camera.intrinsics.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def scene_from_json(data: object) -> Scene:
    """The scene of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    root = as_mapping(data, "scene")
    objects = [as_mapping(entry, "entry of objects") for entry in list_of(root, "objects", "scene")]
    names = tuple(str(entry_of(entry, "name", "object")) for entry in objects)
    positions = [
        finite_vector(entry_of(o, "position", n), 3, f"position of {n} [m]")
        for n, o in zip(names, objects, strict=True)
    ]
    turns = [
        finite_vector(entry_of(o, "quaternion", n), 4, f"quaternion of {n}")
        for n, o in zip(names, objects, strict=True)
    ]
    poses = Pose(np.array(positions).reshape(-1, 3), np.array(turns).reshape(-1, 4))
    light = Light(
        finite_vector(entry_of(as_mapping(entry_of(root, "light", "scene"), "light"), "position", "light"), 3, "light")
    )
    pusher = None
    if root.get("pusher") is not None:
        pusher = finite_vector(
            entry_of(as_mapping(root["pusher"], "pusher"), "position", "pusher"), 3, "pusher position [m]"
        )
    cameras = tuple(camera_from_json(c) for c in list_of(root, "cameras", "scene")) if "cameras" in root else ()
    if len({camera.name for camera in cameras}) != len(cameras):
        raise InvalidInput("names of the cameras", [camera.name for camera in cameras], "all different")
    return Scene(SceneState(names, poses, light, pusher), cameras)


def camera_from_json(data: object) -> Camera:
    """One camera of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range.
    """
    entry = as_mapping(data, "camera")
    name = str(entry_of(entry, "name", "camera"))
    pose = finite_vector(
        _flat(entry_of(entry, "T_world_camera", f"camera {name}")), 16, f"T_world_camera of camera {name}"
    )
    K = finite_vector(_flat(entry_of(entry, "K", f"camera {name}")), 9, f"K of camera {name}")
    rotation = pose.reshape(4, 4)[:3, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
    if not is_rigid or not np.allclose(pose[12:], (0, 0, 0, 1)):
        raise InvalidInput(f"T_world_camera of camera {name}", pose.tolist(), "a rotation and a translation, 4 x 4")
    sizes = [entry_of(entry, key, f"camera {name}") for key in ("width", "height")]
    if not all(isinstance(size, int) for size in sizes):
        raise InvalidInput(f"size of camera {name} [px]", sizes, "two whole numbers")
    return Camera(name, Pose.from_matrix(pose.reshape(4, 4)), K.reshape(3, 3), *sizes)


def _flat(rows: object) -> list[Any]:
    """Numbers of nested lists in one list; what is not nested lists comes back as it is, for the check to refuse."""
    return [entry for row in rows for entry in row] if _is_rows(rows) else [rows]


def _is_rows(rows: object) -> TypeGuard[list[list[Any]]]:
    return isinstance(rows, list) and all(isinstance(row, list) for row in rows)


def read_scene(path: Path) -> Scene:
    """The scene in a file.

    Raises:
        CorruptFile: if it cannot be read or is not a scene; the message says why.
    """
    return read_json(path, scene_from_json)
