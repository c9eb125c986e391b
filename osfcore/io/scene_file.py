"""scene.json: a scene with its cameras as a file, checked when read.

    {"objects": [{"name", "position": [3], "quaternion": [w, x, y, z]}], "light": {"position": [3]},
     "pusher": {"position": [3]}, "cameras": [{"name", "T_world_camera": 4x4, "K": 3x3, "width", "height"}]}

`pusher` and `cameras` may be missing. Metres, z up, unit quaternions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from osfcore.errors import InvalidInput, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, Vector3, Vector4, decode, encode


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """A state and the cameras that look at it."""

    state: SceneState
    cameras: tuple[Camera, ...]


class PointJson(Entry):
    """A place in the world."""

    position: Vector3 = Field(description="[m], world frame.")

    @staticmethod
    def of(position: Float[np.ndarray, "3"]) -> PointJson:
        """From an array."""
        return PointJson(position=position.tolist())


class ObjectJson(Entry):
    """Where an object is."""

    name: Text
    position: Vector3 = Field(description="[m], world frame.")
    quaternion: Vector4 = Field(description="Unit quaternion (w, x, y, z).")

    @staticmethod
    def of(name: str, pose: Pose) -> ObjectJson:
        """From a name and a single pose."""
        return ObjectJson(name=name, position=pose.position.tolist(), quaternion=pose.quaternion.tolist())

    def pose(self) -> Pose:
        """The pose, its quaternion as it is given."""
        return Pose(np.array(self.position), np.array(self.quaternion))


class CameraJson(Entry):
    """A pinhole camera with OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

    name: Text
    T_world_camera: Matrix4 = Field(description="Maps camera coordinates to world coordinates [m].")
    K: Matrix3 = Field(description="Intrinsics [px].")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")

    @staticmethod
    def of(camera: Camera) -> CameraJson:
        """From a camera."""
        matrix, K = camera.T_world_camera.matrix().tolist(), camera.intrinsics.tolist()
        return CameraJson(name=camera.name, T_world_camera=matrix, K=K, width=camera.width, height=camera.height)

    def camera(self) -> Camera:
        """The camera.

        Raises:
            InvalidInput: if a value is out of range.
        """
        pose = rigid_pose(self.T_world_camera, self.name)
        return Camera(self.name, pose, np.array(self.K), self.width, self.height)


def rigid_pose(matrix: list[list[float]], camera: str) -> Pose:
    """`T_world_camera` of a camera, as a matrix in a file.

    Raises:
        InvalidInput: if it is no rotation and translation.
    """
    T_world_camera = np.array(matrix)
    R = T_world_camera[:3, :3]
    is_rigid = np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0
    if not is_rigid or not np.allclose(T_world_camera[3], (0, 0, 0, 1)):
        what = f"T_world_camera of camera {shown(camera)}"
        raise InvalidInput(what, matrix, "a rotation and a translation, 4 x 4")
    return Pose.from_matrix(T_world_camera)


class StateJson(Entry):
    """Where everything is."""

    objects: list[ObjectJson]
    light: PointJson
    pusher: PointJson | None = None

    @staticmethod
    def of(state: SceneState) -> StateJson:
        """From a state."""
        light = PointJson.of(state.light.position)
        return StateJson(objects=posed_objects(state), light=light, **pusher_of(state))

    def state(self) -> SceneState:
        """The state.

        Raises:
            InvalidInput: if a value is out of range.
        """
        positions = np.array([entry.position for entry in self.objects]).reshape(-1, 3)
        quaternions = np.array([entry.quaternion for entry in self.objects]).reshape(-1, 4)
        pusher = None if self.pusher is None else np.array(self.pusher.position)
        names = tuple(entry.name for entry in self.objects)
        return SceneState(names, Pose(positions, quaternions), Light(np.array(self.light.position)), pusher)


class SceneJson(StateJson):
    """A scene with its cameras."""

    cameras: list[CameraJson] = Field(default_factory=list)


def pusher_of(state: SceneState) -> dict[str, PointJson]:
    """The pusher of a state, if there is one, by its key."""
    return {} if state.pusher is None else {"pusher": PointJson.of(state.pusher)}


def posed_objects(state: SceneState) -> list[ObjectJson]:
    """The objects of a state."""
    return [ObjectJson.of(name, state.pose(name)) for name in state.names]


def state_to_json(state: SceneState) -> dict[str, Any]:
    """A state as plain lists and numbers: a scene.json without cameras."""
    return encode(StateJson.of(state))


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """The scene as plain lists and numbers."""
    return {**state_to_json(scene.state), "cameras": [camera_to_json(camera) for camera in scene.cameras]}


def scene_from_json(data: object) -> Scene:
    """The scene of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    entry = decode(SceneJson, data, "scene")
    return Scene(entry.state(), cameras_of(entry.cameras))


def cameras_of(entries: Iterable[CameraJson]) -> tuple[Camera, ...]:
    """The cameras.

    Raises:
        InvalidInput: if a value is out of range, or two have the same name.
    """
    cameras = tuple(entry.camera() for entry in entries)
    if len({camera.name for camera in cameras}) != len(cameras):
        raise InvalidInput("names of the cameras", ", ".join(camera.name for camera in cameras), "all different")
    return cameras


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """One camera as plain lists and numbers."""
    return encode(CameraJson.of(camera))


def camera_from_json(data: object) -> Camera:
    """One camera of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range.
    """
    return decode(CameraJson, data, "camera").camera()


def read_scene(path: Path) -> Scene:
    """The scene in a file.

    Raises:
        CorruptFile: if it cannot be read or is not a scene; the message says why.
    """
    return read_json(path, scene_from_json)
