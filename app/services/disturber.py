"""Trying to fool an episode while it runs: the lamp turned, the light dimmed, an object nudged, a camera covered."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Literal

import numpy as np

from osfcore.errors import InvalidInput, OsfError, OverlappingObjects
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import WORKSPACE_HALF_M

from ..processes.messages.scene_messages import Disturb, EditScene, SceneRecord
from .scenes import Scenes

Kind = Literal["turn lamp", "dim light", "nudge object", "cover camera"]
_TURN_RAD = np.deg2rad((60.0, 150.0))
_ELEVATION_RAD = np.deg2rad((25.0, 60.0))
_NUDGE_M = (0.04, 0.07)
_AT_PUSHER_M = 0.22
_PLACES = 16  # that a nudged object tries


class NoRoomToNudge(OsfError):
    """Nothing can be nudged."""

    def __init__(self) -> None:
        super().__init__("No object has room to be nudged; try something else.")


class Disturber:
    """Does to a scene what the program does not know of. Blocks until it is done; any thread may call.

    Args:
        scenes: of the service.
        rng: chooses angles, objects and cameras.
    """

    def __init__(self, scenes: Scenes, rng: np.random.Generator) -> None:
        self._scenes, self._rng = scenes, rng
        self._lock = threading.Lock()

    def disturb(self, scene: str, kind: Kind) -> tuple[SceneRecord, str]:
        """Do it; dimming and covering are undone by the second time.

        Args:
            scene: identifier.
            kind: of mischief.

        Returns:
            The scene after it, and what was done, in a sentence.

        Raises:
            UnknownName: if there is no such scene.
            NoRoomToNudge: if no object can be moved.
        """
        record = self._scenes.get(scene)
        does: dict[Kind, Callable[[SceneRecord], tuple[SceneRecord, str]]] = {
            "turn lamp": self._turn,
            "dim light": self._dim,
            "nudge object": self._nudge,
            "cover camera": self._cover,
        }
        with self._lock:
            return does[kind](record)

    def _turn(self, record: SceneRecord) -> tuple[SceneRecord, str]:
        x, y, _ = record.state.light.position
        azimuth = np.arctan2(y, x) + self._rng.choice([-1, 1]) * self._rng.uniform(*_TURN_RAD)
        light = Light.from_angles(float(azimuth), float(self._rng.uniform(*_ELEVATION_RAD)))
        angle_deg = np.rad2deg(light.angle_to(record.state.light))
        return self._scenes.disturb(EditScene(record.id, light)), f"The lamp was moved by {angle_deg:.0f}°."

    def _nudge(self, record: SceneRecord) -> tuple[SceneRecord, str]:
        state = record.state
        # Those at the pusher last: what happens to them could be its doing, so that nothing of it is noticed.
        shuffled = [str(name) for name in self._rng.permutation(state.names)]
        for name in sorted(shuffled, key=lambda name: self._is_at_pusher(state, name)):
            pose = state.pose(name)
            for _ in range(_PLACES):
                angle, length = self._rng.uniform(-np.pi, np.pi), self._rng.uniform(*_NUDGE_M)
                place = pose.position + length * np.array([np.cos(angle), np.sin(angle), 0.0])
                if np.abs(place[:2]).max() > WORKSPACE_HALF_M:
                    continue
                try:
                    poses = ((name, Pose(place, pose.quaternion)),)
                    moved = self._scenes.disturb(EditScene(record.id, poses=poses, settle=True))
                except (OverlappingObjects, InvalidInput):
                    continue
                return moved, f"{name} was moved by {100 * length:.0f} cm."
        raise NoRoomToNudge

    @staticmethod
    def _is_at_pusher(state: SceneState, name: str) -> bool:
        here = state.pusher
        return here is not None and bool(np.linalg.norm(state.pose(name).position[:2] - here[:2]) < _AT_PUSHER_M)

    def _dim(self, record: SceneRecord) -> tuple[SceneRecord, str]:
        brightness = self._scenes.disturb(Disturb(record.id, None)).brightness
        text = f"The light was dimmed to {100 * brightness:.0f} %." if brightness != 1.0 else "The light is as it was."
        return self._scenes.get(record.id), text

    def _cover(self, record: SceneRecord) -> tuple[SceneRecord, str]:
        camera = str(self._rng.choice([camera.name for camera in default_cameras()]))
        covered = self._scenes.disturb(Disturb(record.id, camera)).covered
        text = "".join(f"Camera {name} is covered." for name in covered) or "No camera is covered now."
        return self._scenes.get(record.id), text
