"""What an episode with a robot leaves in its folder: report.json, the goal, frames and a video; nothing about truth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from app.episodes.file_names import FRAMES_FOLDER, GOAL_FILE, REPORT_FILE, VIDEO_FILE
from app.episodes.frames import frame, read_frames, write_video
from app.episodes.record import by_name, goal_to_json
from app.episodes.robots.stopped_report import STOPPED
from osfcore.contrib.robots.guarded_world import GuardedWorld
from osfcore.control.events import ActionExecuted, Event, Finished, GoalFound, Noticed, Observed, Stepped
from osfcore.geometry.states import Observation
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.scene_file import estimated_to_json
from osfcore.metrics.image_errors import ssim


class RobotRecord:
    """Takes an episode's events and writes its results as they come: who breaks off has what was done.

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

    def broken_off(self, reason: str) -> None:
        """Note that the episode ended before its end, unless that has come.

        Raises:
            CannotWrite: if the disk refuses.
        """
        self._outcome = self._outcome or (STOPPED, reason)
        self._write()

    def finish(self) -> dict[str, Any]:
        """Write the video, where ffmpeg is there, and tell the report.

        Raises:
            CannotWrite: if the disk refuses.
        """
        if find_spec("imageio_ffmpeg") is not None:
            write_video(self._folder / VIDEO_FILE, read_frames(self._folder / FRAMES_FOLDER))
        return self._write()

    def _step_entry(self, event: Stepped) -> dict[str, Any]:
        """A step; lengths in mm, angles in degrees, all of them as estimated; None for what is not known."""
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
        assert self._seen is not None
        assert self._goal is not None
        title = f"step {event.number} of {event.steps}"
        picture = frame(self._goal.image, self._from_goal_camera(), event.rendered, self._seen.images, title)
        write_png(self._folder / FRAMES_FOLDER / f"{len(self._steps):03d}.png", picture)

    def _from_goal_camera(self) -> Float[np.ndarray, "h w 3"]:
        """What the camera of the goal sees now, if it is one of the robot's; else the first one."""
        assert self._seen is not None
        assert self._goal is not None
        names = [camera.name for camera in self._seen.cameras]
        name = self._goal.camera.name
        return self._seen.images[names.index(name) if name in names else 0]

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
