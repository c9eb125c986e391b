"""An episode with a robot, of which nobody knows the truth: connected, guarded, driven and recorded."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from app.episodes.file_names import FRAMES_FOLDER, GOAL_FILE, REPORT_FILE, STOPPED, VIDEO_FILE
from app.episodes.frames import frame, read_frames, write_video
from app.episodes.record import by_name, goal_to_json
from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.guarded_world import CameraBoxes, GuardedWorld, OutlinedWorld
from osfcore.contrib.robots.robot import RobotDescription, SafetyLimits
from osfcore.control.closed_loop import Episode
from osfcore.control.estimators import load_scene_models
from osfcore.control.events import (
    ActionExecuted,
    EpisodeSettings,
    Event,
    Finished,
    GoalFound,
    Noticed,
    Observed,
    Stepped,
)
from osfcore.control.goal import GoalImage
from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.scene_file import estimated_to_json
from osfcore.metrics.image_errors import ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.photo.read_photograph import read_photograph
from osfcore.random_streams import Stream, stream_rng

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

    `limits` are those that hold, `doubts` sentences that a person should read before the robot moves.

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
        self.doubts = doubts_about(robot.description)
        self._guard = GuardedWorld(robot, self.limits, permit)
        world, rng = OutlinedWorld(self._guard, order.boxes), stream_rng(order.seed, Stream.EPISODE)
        self._episode = Episode(world, models, goal, order.settings, rng)
        about = {
            "robot": order.url, "objects": list(order.names), "seed": order.seed,
            "limits": asdict(self.limits), "settings": asdict(order.settings),
        }  # fmt: skip
        self._record = RobotRecord(order.out, about, self._guard)

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
            for event in self._episode.run():
                self._record.take(event)
                yield event
                self._guard.check()
        except BaseException as error:
            self._guard.stop(str(error) or "it was interrupted")  # before anything is written
            self._record.break_off(str(error) or "It was interrupted.")
            raise

    def finish(self) -> dict[str, Any]:
        """Write the video, where ffmpeg is there, and return the report.

        Raises:
            CannotWrite: if the disk refuses.
        """
        return self._record.finish()

    def close(self) -> None:
        """Stop the robot and let it go."""
        self._guard.close()


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


class RobotRecord:
    """What an episode leaves in its folder: report.json, the goal, frames and a video, written as events come.

    Whoever breaks off has what was done until then.

    Args:
        folder: for them.
        about: what the report says besides what happens.
        guard: of the robot, which knows what was held back.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], guard: GuardedWorld) -> None:
        self._folder, self._about, self._guard = folder, about, guard
        self._began = time.perf_counter()
        self._seen: Observation | None = None
        self._goal: GoalFound | None = None
        self._steps: list[dict[str, Any]] = []
        self._notices: list[dict[str, Any]] = []
        self._actions: list[list[float]] = []
        self._outcome: tuple[str, str] | None = None
        for left in (folder / FRAMES_FOLDER).glob("[0-9]*.png"):  # of an earlier, perhaps longer episode
            left.unlink()

    def take(self, event: Event) -> None:
        """Note an event, and draw a frame where a step is over.

        Raises:
            CannotWrite: if the disk refuses.
        """
        match event:
            case Observed():
                self._seen = event.observation
            case GoalFound():
                self._goal = event
                write_png(self._folder / GOAL_FILE, to_uint8(event.image))
            case ActionExecuted():
                self._actions.append(event.action.tolist())
            case Noticed():
                self._notices.append({"step": event.number, "matter": event.matter, "text": event.text})
            case Stepped():
                self._draw(event)
                self._steps.append(self._step_entry(event))
            case Finished():
                self._outcome = event.outcome, event.text
            case _:
                return
        if not isinstance(event, Observed):
            self._write()

    def break_off(self, reason: str) -> None:
        """Note that the episode ended before its end, unless that has come.

        Raises:
            CannotWrite: if the disk refuses.
        """
        self._outcome = self._outcome or (STOPPED, reason)
        self._write()

    def finish(self) -> dict[str, Any]:
        """Write the video, where ffmpeg is there, and return the report.

        Raises:
            CannotWrite: if the disk refuses.
        """
        if find_spec("imageio_ffmpeg") is not None:
            write_video(self._folder / VIDEO_FILE, read_frames(self._folder / FRAMES_FOLDER))
        return self._write()

    def _step_entry(self, event: Stepped) -> dict[str, Any]:
        """Return the report of a step: estimated lengths in mm and angles in degrees, None where unknown."""
        names = event.estimate.state.names
        assert self._goal is not None
        return {
            "step": event.number,
            "seconds": {stage: round(value, 4) for stage, value in event.seconds.items()},
            "image_cost": event.image_cost,
            "ssim": round(ssim(self._goal.image, event.rendered), 4),
            "to_goal_mm": by_name(names, 1000 * event.offsets_m) if event.offsets_m.size else None,
            "to_goal_deg": by_name(names, np.rad2deg(event.offsets_rad)) if event.offsets_rad.size else None,
            "estimate": estimated_to_json(event.estimate),
        }

    def _draw(self, event: Stepped) -> None:
        """Draw a frame, with what the goal's camera sees now if it is one of the robot's, else the first one."""
        assert self._seen is not None
        assert self._goal is not None
        names, name = [camera.name for camera in self._seen.cameras], self._goal.camera.name
        now = self._seen.images[names.index(name) if name in names else 0]
        title = f"step {event.number} of {event.steps}"
        picture = frame(self._goal.image, now, event.rendered, self._seen.images, title)
        write_png(self._folder / FRAMES_FOLDER / f"{len(self._steps):03d}.png", picture)

    def _write(self) -> dict[str, Any]:
        outcome, text = self._outcome or (None, None)
        report = {
            "outcome": outcome,
            "text": text,
            "steps_done": len(self._actions),
            "seconds": round(time.perf_counter() - self._began, 2),
            **self._about,
            "goal": None if self._goal is None else goal_to_json(self._goal),
            "noticed": self._notices,
            "actions": self._actions,
            "held_back": [{"action": h.action.tolist(), "done": h.done.tolist()} for h in self._guard.held_back],
            "steps": self._steps,
        }
        write_json(self._folder / REPORT_FILE, report)
        return report
