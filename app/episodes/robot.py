"""An episode with a robot, of which nobody knows the truth: connected, guarded, driven and recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.guarded_world import CameraBoxes, GuardedWorld, OutlinedWorld
from osfcore.contrib.robots.robot import RobotDescription, SafetyLimits
from osfcore.control.closed_loop import Episode
from osfcore.control.estimators import load_scene_models
from osfcore.control.events import EpisodeSettings, Event
from osfcore.control.goal import GoalImage
from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.photo.read_photograph import read_photograph
from osfcore.random_streams import Stream, stream_rng

from .file_names import STOPPED
from .record import About, EpisodeRecord, recorded

_RADIUS_DIFFERS_M = 0.001  # a person is warned of more


@dataclass(frozen=True, eq=False, slots=True)
class DriveOrder:
    """An episode with a robot.

    Attributes:
        url: of the robot.
        names: of the objects on its table.
        goal: photo of how the table should look, without the pusher.
        out: folder for the results.
        data_dir: where fields and networks trained on this machine are.
        goal_camera: name of the robot's camera that took it; as the file is called if None.
        goal_encoding: of the photo.
        boxes: around the objects at the beginning, for robots that deliver no masks.
        limits: for the pusher, besides the robot's own.
        seed: of the searches.
        settings: how it goes.
        device: that computes.
    """

    url: str
    names: tuple[str, ...]
    goal: Path
    out: Path
    data_dir: Path
    goal_camera: str | None = None
    goal_encoding: Encoding = "srgb"
    boxes: CameraBoxes = field(default_factory=dict)
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    seed: int = 0
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)
    device: str = "cpu"


class RobotDrive:
    """An episode with a robot. Whoever runs it closes it, which stops the robot.

    `limits` are those that hold.

    Args:
        order: what is wanted.
        permit: asked once, before the first motion.

    Raises:
        OsfError: if the robot does not answer or the order cannot be met; nothing has moved.
    """

    def __init__(self, order: DriveOrder, permit: Callable[[], bool]) -> None:
        fields, assets = FieldLibrary(order.data_dir), AssetLibrary(order.data_dir / "objects")
        if not order.names:
            raise InvalidInput("names of the objects", "missing", "those of the objects on the robot's table")
        for name in order.names:
            fields.info(name)
        robot = connect(order.url, order.names, order.limits)
        with contextlib.ExitStack() as opened:
            opened.callback(robot.close)
            self.limits = order.limits.within(robot.description.limits)
            goal = read_goal_photo(order, robot.description.cameras)
            models = load_scene_models(order.names, fields, assets, order.data_dir, order.device)
            opened.pop_all()
        self._doubts = doubts_about(robot.description)
        self._guard = GuardedWorld(robot, self.limits, permit)
        self._world, rng = OutlinedWorld(self._guard, order.boxes), stream_rng(order.seed, Stream.EPISODE)
        self._episode = Episode(self._world, models, goal, order.settings, rng)
        about = About(order.names, order.seed, order.settings, robot=lambda: self._told(order.url))
        self._record = EpisodeRecord(order.out, None, about)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences that a person should read before the robot moves; more once the first pictures were seen."""
        return self._doubts + self._world.doubts

    def stop(self, reason: str) -> None:
        """Stop the robot for good; from any thread."""
        self._guard.stop(reason)

    def run(self) -> Iterator[Event]:
        """Run the episode; each event is recorded before it is yielded.

        Raises:
            RobotStopped: soon after a stop, at the latest before the next motion.
            OsfError: if the robot no longer answers, or what it sends cannot be used.
        """
        try:
            for event in recorded(self._episode.run(), self._record):
                yield event
                self._guard.check()
        except BaseException as error:
            self._guard.stop(str(error) or "it was interrupted")  # before anything is written
            self._record.break_off(STOPPED, str(error) or "It was interrupted.")
            raise

    def finish(self) -> dict[str, Any]:
        """Write the video, where there is an ffmpeg, and return the report.

        Raises:
            CannotWrite: if the disk refuses.
        """
        return self._record.finish()

    def close(self) -> None:
        """Stop the robot and let it go."""
        self._guard.close()

    def _told(self, url: str) -> dict[str, Any]:
        """Return what the report says of the robot."""
        held_back = [{"action": h.action.tolist(), "done": h.done.tolist()} for h in self._guard.held_back]
        return {"robot": url, "limits": asdict(self.limits), "held_back": held_back}


def read_goal_photo(order: DriveOrder, cameras: tuple[Camera, ...]) -> GoalImage:
    """Read the goal as the robot's camera saw it.

    Raises:
        CorruptFile: if it is no picture.
        UnknownName: if no camera of the robot has the name.
        InvalidInput: if its sides are not in the proportion of the camera's.
    """
    name = order.goal.stem if order.goal_camera is None else order.goal_camera
    camera = {camera.name: camera for camera in cameras}.get(name)
    if camera is None:
        raise UnknownName("camera of the robot for --goal-camera", name, [camera.name for camera in cameras])
    encoded = read_photograph(order.goal).encoded
    height, width = encoded.shape[:2]
    if width * camera.height != height * camera.width:
        allowed = f"in proportion {camera.width}:{camera.height}, as camera {name} sees"
        raise InvalidInput(f"size of {order.goal.name} [px]", f"{width} x {height}", allowed)
    image = linear_from_encoded(encoded / np.iinfo(encoded.dtype).max, order.goal_encoding).astype(np.float32)
    return GoalImage(camera.resized(width, height), image)


def doubts_about(robot: RobotDescription) -> tuple[str, ...]:
    """Return sentences that a person should read before a robot moves."""
    radius_m = robot.pusher_radius_m
    if abs(radius_m - PUSHER_RADIUS_M) <= _RADIUS_DIFFERS_M:
        return ()
    differs = f"The robot's pusher has a radius of {1000 * radius_m:.0f} mm"
    return (f"{differs}; pushes are predicted for one of {1000 * PUSHER_RADIUS_M:.0f} mm.",)
