"""Files of scenes, estimates and rollouts (scene.json, state.json, actions.json, rollouts.json), checked when read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat, model_validator

from osfcore.errors import InvalidInput, check_unique, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import read_json, write_json
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, Vector3, Vector4, decode, encode

# scene.json: a scene with its cameras as a file, checked when read.
#
#     {"objects": [{"name", "position": [3], "quaternion": [w, x, y, z]}], "light": {"position": [3]},
#      "pusher": {"position": [3]}, "cameras": [{"name", "T_world_camera": 4x4, "K": 3x3, "width", "height"}]}
#
# `pusher` and `cameras` may be missing. Metres, z up, unit quaternions.


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """A state and the cameras that look at it."""

    state: SceneState
    cameras: tuple[Camera, ...]


class PointJson(Entry):
    """A position in the world."""

    position: Vector3 = Field(description="[m], world frame.")

    @staticmethod
    def of(position: Float[np.ndarray, "3"]) -> PointJson:
        """Make one of an array."""
        return PointJson(position=position.tolist())


class ObjectJson(Entry):
    """An object and its pose."""

    name: Text
    position: Vector3 = Field(description="[m], world frame.")
    quaternion: Vector4 = Field(description="Unit quaternion (w, x, y, z).")

    @staticmethod
    def of(name: str, pose: Pose) -> ObjectJson:
        """Make one of a name and a single pose."""
        return ObjectJson(name=name, position=pose.position.tolist(), quaternion=pose.quaternion.tolist())

    def pose(self) -> Pose:
        """Return the pose, its quaternion as it is given."""
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
        """Make one of a camera."""
        matrix, K = camera.T_world_camera.matrix().tolist(), camera.intrinsics.tolist()
        return CameraJson(name=camera.name, T_world_camera=matrix, K=K, width=camera.width, height=camera.height)

    def camera(self) -> Camera:
        """Return the camera.

        Raises:
            InvalidInput: if a value is out of range.
        """
        pose = rigid_pose(self.T_world_camera, self.name)
        return Camera(self.name, pose, np.array(self.K), self.width, self.height)


def rigid_pose(matrix: list[list[float]], camera: str) -> Pose:
    """Return `T_world_camera` of a camera, given as a matrix in a file.

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
    """A scene state."""

    objects: list[ObjectJson]
    light: PointJson
    pusher: PointJson | None = None

    @staticmethod
    def of(state: SceneState) -> StateJson:
        """Make one of a state."""
        return StateJson(objects=posed_objects(state), light=PointJson.of(state.light.position), **pusher_of(state))

    def state(self) -> SceneState:
        """Return the state.

        Raises:
            InvalidInput: if a value is out of range.
        """
        poses = Pose.stacked(entry.pose() for entry in self.objects)
        pusher = None if self.pusher is None else np.array(self.pusher.position)
        names = tuple(entry.name for entry in self.objects)
        return SceneState(names, poses, Light(np.array(self.light.position)), pusher)


class SceneJson(StateJson):
    """A scene with its cameras."""

    cameras: list[CameraJson] = Field(default_factory=list)


def pusher_of(state: SceneState) -> dict[str, PointJson]:
    """Return the pusher of a state under its key, if there is one."""
    return {} if state.pusher is None else {"pusher": PointJson.of(state.pusher)}


def posed_objects(state: SceneState) -> list[ObjectJson]:
    """Return the objects of a state."""
    return [ObjectJson.of(name, state.pose(name)) for name in state.names]


def state_to_json(state: SceneState) -> dict[str, Any]:
    """Return a state as plain lists and numbers: a scene.json without cameras."""
    return encode(StateJson.of(state))


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """Return the scene as plain lists and numbers."""
    return {**state_to_json(scene.state), "cameras": [camera_to_json(camera) for camera in scene.cameras]}


def scene_from_json(data: object) -> Scene:
    """Return the scene of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    entry = decode(SceneJson, data, "scene")
    return Scene(entry.state(), cameras_of(entry.cameras))


def cameras_of(entries: Iterable[CameraJson]) -> tuple[Camera, ...]:
    """Return the cameras.

    Raises:
        InvalidInput: if a value is out of range, or two have the same name.
    """
    cameras = tuple(entry.camera() for entry in entries)
    check_unique("names of the cameras", [camera.name for camera in cameras], "all different")
    return cameras


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera in the JSON form of scene.json.

    Returns:
        "name", "T_world_camera" (4 x 4), "K" (3 x 3) [px], "width" and "height" [px].

    Example:
        >>> camera_to_json(goal_camera(64))["width"]
        64
    """
    return encode(CameraJson.of(camera))


def camera_from_json(data: object) -> Camera:
    """Return one camera of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range.
    """
    return decode(CameraJson, data, "camera").camera()


def read_scene(path: Path) -> Scene:
    """Return the scene in a file.

    Raises:
        CorruptFile: if it cannot be read or is not a scene; the message says why.
    """
    return read_json(path, scene_from_json)


# actions.json and rollouts.json: sequences of actions, and their predicted futures.
#
# actions.json {"actions": K x T x 3 [m/s], "step_s": 0.2} rollouts.json {"names": [N], "positions": K x (T+1) x N x
# 3 [m], "quaternions": K x (T+1) x N x 4, "pusher": K x (T+1) x 3 [m], "step_s": 0.2}


_DIGITS = 9  # nanometres


class _Actions(Entry):
    actions: Any  # `check_actions` says it better
    step_s: float = STEP_S


def actions_from_json(data: object) -> Float[np.ndarray, "K T 3"]:
    """Return the sequences of actions of parsed JSON [m/s].

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    entry = decode(_Actions, data, "the actions file")
    if entry.step_s != STEP_S:
        raise InvalidInput("step_s", entry.step_s, f"{STEP_S}: every action is held that long")
    return check_actions(entry.actions)


def read_actions(path: Path) -> Float[np.ndarray, "K T 3"]:
    """Return the sequences of actions in a file [m/s].

    Raises:
        CorruptFile: if it cannot be read or holds no actions within the limits; the message says why.
    """
    return read_json(path, actions_from_json)


def rollouts_to_json(rollouts: Rollouts) -> dict[str, Any]:
    """Return rollouts as plain lists and numbers."""
    arrays = {key: np.round(getattr(rollouts, key), _DIGITS).tolist() for key in ("positions", "quaternions", "pusher")}
    return {"names": list(rollouts.names), **arrays, "step_s": STEP_S}


class _Rollouts(Entry):
    names: list[str]
    positions: list[list[list[Vector3]]]
    quaternions: list[list[list[Vector4]]]
    pusher: list[list[Vector3]]


def rollouts_from_json(data: object) -> Rollouts:
    """Return the rollouts of parsed JSON.

    Raises:
        InvalidInput: if something is missing or not a number; the message names it.
    """
    entry = decode(_Rollouts, data, "the rollouts")
    arrays = (np.array(part, float) for part in (entry.positions, entry.quaternions, entry.pusher))
    return Rollouts(tuple(entry.names), *arrays)


def write_rollouts(path: Path, rollouts: Rollouts) -> None:
    """Write rollouts; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_json(path, rollouts_to_json(rollouts))


# state.json: the file of an estimate, checked when read.
#
#     {"objects": [{"name", "position": [3], "quaternion": [w, x, y, z], "doubt": "",
#                   "uncertainty": {"position_std_m", "rotation_std_rad"}}],
#      "light": {"position": [3], "uncertainty": {"direction_std_rad"}}, "pusher": {"position": [3]},
#      "trusted": true, "reason": ""}
#
# It is a scene.json without cameras and with additional members, so that programs that read scenes can read it. A plain
# scene.json is a trusted state without uncertainty. An uncertainty of null is unbounded, since JSON has no infinity.


_Deviation = Annotated[FiniteFloat, Field(ge=0)]


class PoseUncertaintyJson(Entry):
    """Standard deviations; null if unbounded."""

    position_std_m: _Deviation | None = Field(default=0.0, description="Per axis [m].")
    rotation_std_rad: _Deviation | None = Field(default=0.0, description="Per axis of a small rotation [rad].")


class EstimatedObjectJson(ObjectJson):
    """The estimated pose of an object."""

    uncertainty: PoseUncertaintyJson = PoseUncertaintyJson()
    doubt: Text = Field(default="", description="Why not to trust it; empty where it may be.")


class LightUncertaintyJson(Entry):
    """Standard deviation; null if unbounded."""

    direction_std_rad: _Deviation | None = Field(default=0.0, description="Per axis [rad].")


class EstimatedLightJson(PointJson):
    """The estimated light, as a position 1 m from the table's centre."""

    uncertainty: LightUncertaintyJson = LightUncertaintyJson()


class EstimateJson(StateJson):
    """A state, its uncertainty, and whether it can be trusted."""

    objects: list[EstimatedObjectJson]  # pyright: ignore[reportIncompatibleVariableOverride]
    light: EstimatedLightJson  # pyright: ignore[reportIncompatibleVariableOverride]
    trusted: bool
    reason: Text = Field(default="", description="Why not to trust it; empty where it may be.")

    @model_validator(mode="before")
    @classmethod
    def _trusted_without_a_reason_not_to(cls, data: object) -> object:
        return {"trusted": not data.get("reason"), **data} if isinstance(data, dict) else data

    @staticmethod
    def of_estimate(estimated: EstimatedState) -> EstimateJson:
        """Make one of an estimate."""
        state, light_std = estimated.state, LightUncertaintyJson(direction_std_rad=_bounded(estimated.light_std))
        deviations = zip(estimated.position_std, estimated.rotation_std, estimated.doubts, strict=True)
        return EstimateJson(
            objects=[
                EstimatedObjectJson(
                    **dict(entry),
                    uncertainty=PoseUncertaintyJson(position_std_m=_bounded(m), rotation_std_rad=_bounded(rad)),
                    doubt=doubt,
                )
                for entry, (m, rad, doubt) in zip(posed_objects(state), deviations, strict=True)
            ],
            light=EstimatedLightJson(position=state.light.position.tolist(), uncertainty=light_std),
            **pusher_of(state),
            trusted=estimated.trusted,
            reason=estimated.reason,
        )

    def estimate(self) -> EstimatedState:
        """Return the estimate.

        Raises:
            InvalidInput: if a value is out of range, or `trusted` and `reason` contradict each other.
        """
        if self.trusted == bool(self.reason):
            allowed = "empty where trusted is true and a sentence where it is false"
            raise InvalidInput("reason", shown(repr(self.reason)), allowed)
        position = [_unbounded(entry.uncertainty.position_std_m) for entry in self.objects]
        rotation = [_unbounded(entry.uncertainty.rotation_std_rad) for entry in self.objects]
        light = _unbounded(self.light.uncertainty.direction_std_rad)
        doubts = tuple(entry.doubt for entry in self.objects)
        return EstimatedState(self.state(), np.array(position), np.array(rotation), light, doubts, self.reason)


def _bounded(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _unbounded(value: float | None) -> float:
    return np.inf if value is None else value


def estimated_to_json(estimated: EstimatedState) -> dict[str, Any]:
    """Return the state as plain lists and numbers."""
    return encode(EstimateJson.of_estimate(estimated))


def estimated_from_json(data: object) -> EstimatedState:
    """Return the state of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    return decode(EstimateJson, data, "state").estimate()


def is_estimated(data: object) -> bool:
    """Return whether parsed JSON has the members of an estimate, which a scene.json has not."""
    return isinstance(data, dict) and ("trusted" in data or "reason" in data)


def read_estimated(path: Path) -> EstimatedState:
    """Return the estimate in a state.json, or the state in a scene.json.

    Raises:
        CorruptFile: if it cannot be read or is neither; the message says why.
    """
    return read_json(path, estimated_from_json)


def write_estimated(path: Path, estimated: EstimatedState) -> None:
    """Write a state; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_json(path, estimated_to_json(estimated))
