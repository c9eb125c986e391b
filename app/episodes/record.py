"""What an episode leaves in its folder: report.json, its course, steps.csv, frames, video, a recording, the goal."""

from __future__ import annotations

import contextlib
import csv
import io
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

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
from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState
from osfcore.io.files import as_mapping, read_json, write_atomically, write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.json_codec import encode
from osfcore.io.scene_file import ObjectJson, estimated_to_json, state_to_json
from osfcore.io.video_file import ffmpeg_or_none
from osfcore.metrics.image_errors import ssim
from osfcore.metrics.success import RearrangementTask, score_of
from osfcore.objects.asset import Symmetry
from osfcore.paper.method import Method
from osfcore.world.simulators import Simulator

from .file_names import CSV_FILE, FRAMES_FOLDER, GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE, VIDEO_FILE
from .frames import TILE_PX, frame, read_frames, write_video
from .trajectory import ReplayClock, Trajectory, TrajectoryRecorder, read_trajectory, write_trajectory

_UNWRITTEN_SHARE = 0.05  # of the steps, at most


class Table(Protocol):
    """What only a simulation knows of a table; for reports, never for the loop."""

    def truth(self) -> SceneState:
        """Where everything truly is."""
        ...

    def photo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """What a camera would see, the pusher included."""
        ...


@dataclass(frozen=True, slots=True)
class PartNames:
    """Parts of an episode by name, ours or those of other packages.

    Attributes:
        world: what is pushed.
        estimator: what looks.
        planner: what plans.
        cost: what compares futures; None for what the settings say.
    """

    world: str = "simulated"
    estimator: str = "ours"
    planner: str = "mppi"
    cost: str | None = None

    def to_json(self) -> dict[str, str]:
        """Those that are named."""
        return {kind: name for kind, name in asdict(self).items() if name is not None}


@dataclass(frozen=True, eq=False, slots=True)
class About:
    """What a record says besides what happens.

    Attributes:
        names: of the objects.
        seed: of the searches, and of the scene where the episode made it.
        settings: at the beginning.
        goal: how the table truly should be; None where nobody knows.
        moved: objects that truly should move, where that is known.
        symmetries: which orientations of the objects look the same.
        method: whose.
        image: the goal, where a method looks at the image alone: it finds no poses in it.
        parts: of the episode, where they were chosen by name.
        simulator: what moves the objects; None where that is no simulator of ours.
        robot: what the report says of a robot; of a simulation nothing.
    """

    names: tuple[str, ...]
    seed: int
    settings: EpisodeSettings
    goal: SceneState | None = None
    moved: tuple[str, ...] = ()
    symmetries: Mapping[str, Symmetry] = field(default_factory=dict)
    method: Method = "ours"
    image: GoalImage | None = None
    parts: PartNames | None = None
    simulator: Simulator | None = None
    robot: Callable[[], Mapping[str, Any]] = dict


class EpisodeRecord:
    """Takes an episode's events and writes its results.

    Report, course and table are written whole, each time a twentieth of the steps has come since the last time: after
    every step of the first twenty, and later so seldom that writing takes time in proportion to the number of steps.
    Whoever breaks an episode off calls `close` or `break_off`, which write the rest; one that is killed loses that
    twentieth. Without a simulation, which knows the truth, there is no course, and frames show a camera's image.

    Args:
        folder: for them.
        table: the simulated table; None where nobody knows the truth.
        about: what it was asked to be.
        clock: returns the time [s].

    Attributes:
        seconds: that it took so far, as the report has them [s].
        steps_written: how many steps the report holds.
    """

    def __init__(
        self, folder: Path, table: Table | None, about: About, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._folder, self._table, self._about = folder, table, about
        self._seen: Observation | None = None
        self._goal: GoalFound | None = None
        self._image, self._photo = about.image, None
        self._steps: list[dict[str, Any]] = []
        self._notices: list[dict[str, Any]] = []
        self.seconds = self._seconds = 0.0
        self.steps_written = 0
        self._clock, self._since = clock, clock()
        self._actions: list[list[float]] = []
        self._end: tuple[str, str] | None = None
        self._course = None if table is None else TrajectoryRecorder(table.truth())
        for left in (folder / FRAMES_FOLDER).glob("[0-9]*.png"):  # of an earlier, perhaps longer episode
            left.unlink()
        if about.image is not None:
            self._keep_image(about.image)

    @property
    def states(self) -> list[SceneState]:
        """True ones, at the beginning and after each action."""
        return [] if self._course is None else self._course.states

    def take(self, event: Event) -> None:
        """Note an event, and draw a frame where a step is over.

        Raises:
            CannotWrite: if the disk refuses.
        """
        now = self._clock()
        self._seconds, self._since = self._seconds + now - self._since, now
        if self._course is not None and self._table is not None:
            self._course.take(event, self._table)
        match event:
            case Observed():
                self._seen = event.observation
            case GoalFound():
                self._goal = event
                self._photo = event.photo
                self._keep_image(GoalImage(event.camera, event.image))
            case ActionExecuted():
                self._actions.append(event.action.tolist())
            case Noticed():
                self._notices.append({"step": event.number, "matter": event.matter, "text": event.text})
            case Stepped():
                entry = self._step_entry(event)
                self._draw(event)
                self._steps.append(entry)  # last: however it is broken off, no step is told of that has no frame
            case Finished():
                self._end = event.outcome, event.text
            case _:
                pass
        unwritten = len(self._steps) - self.steps_written
        is_due = unwritten > 0 and unwritten >= _UNWRITTEN_SHARE * len(self._steps)
        if is_due or isinstance(event, GoalFound | Noticed | Finished):
            self._write()

    def go_on(self) -> None:
        """Leave out the time since the last event: the episode rested."""
        self._since = self._clock()

    def break_off(self, outcome: str, reason: str) -> None:
        """Note that the episode ended before its end, unless that has come.

        Raises:
            CannotWrite: if the disk refuses.
        """
        self._end = self._end or (outcome, reason)
        self._write()

    def finish(self) -> dict[str, Any]:
        """Write the video, where there is an ffmpeg, and return the report.

        Raises:
            CannotWrite: if the disk refuses.
        """
        if ffmpeg_or_none() is not None:
            write_video(self._folder / VIDEO_FILE, read_frames(self._folder / FRAMES_FOLDER))
        return self._write()

    def close(self) -> None:
        """Write the steps that are not in the files yet, as far as the disk takes them."""
        if self.steps_written < len(self._steps):
            with contextlib.suppress(OsfError):  # what ended the episode is what is reported
                self._write()

    def _write(self) -> dict[str, Any]:
        """Write report, course and table so far, and return the report."""
        self.seconds, self.steps_written = round(self._seconds, 2), len(self._steps)
        report = self._report()
        write_json(self._folder / REPORT_FILE, report)
        if self._course is not None:
            write_trajectory(self._folder / TRAJECTORY_FILE, self._course.trajectory)
        self._write_csv()
        return report

    def _keep_image(self, goal: GoalImage) -> None:
        self._image = goal
        write_png(self._folder / GOAL_FILE, to_uint8(goal.image if self._photo is None else self._photo))

    def _step_entry(self, event: Stepped) -> dict[str, Any]:
        """A step as the report has it; lengths in mm, angles in degrees; None for what is not known."""
        assert self._image is not None
        estimate, names = event.estimate, event.estimate.state.names
        entry = {
            "step": event.number,
            "seconds": {stage: round(value, 4) for stage, value in event.seconds.items()},
            "image_cost": event.image_cost,
            "ssim": round(ssim(self._image.image, event.rendered), 4),
            "to_goal_mm": by_name(names, 1000 * event.offsets_m) if event.offsets_m.size else None,
            "to_goal_deg": by_name(names, np.rad2deg(event.offsets_rad)) if event.offsets_rad.size else None,
            "estimate": estimated_to_json(estimate),
        }
        if self._table is None:
            return entry
        truth = self._table.truth()
        off = np.linalg.norm(estimate.state.poses.position - truth.poses.position, axis=1)
        entry |= {
            "estimate_off_mm": by_name(names, 1000 * off),
            "light_off_deg": round(float(np.rad2deg(estimate.state.light.angle_to(truth.light))), 3),
            "truth": state_to_json(truth),
        }
        if self._about.goal is not None:
            there = self._about.goal.reordered(truth.names).poses.position
            entry["truly_to_goal_mm"] = by_name(names, 1000 * np.linalg.norm(truth.poses.position - there, axis=1))
        return entry

    def _draw(self, event: Stepped) -> None:
        assert self._image is not None
        assert self._seen is not None
        title = f"step {event.number} of {event.steps}"
        now = self._now(self._image.camera)
        picture = frame(self._image.image, now, event.rendered, self._seen.images, title, self._photo)
        write_png(self._folder / FRAMES_FOLDER / f"{len(self._steps):03d}.png", picture)

    def _now(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """Return what the goal's camera sees now: in a simulation, or as one of the robot's; else the first one's."""
        if self._table is not None:
            scale = TILE_PX / max(camera.width, camera.height)
            return self._table.photo(camera.resized(round(scale * camera.width), round(scale * camera.height)))
        assert self._seen is not None
        names = [seen.name for seen in self._seen.cameras]
        return self._seen.images[names.index(camera.name) if camera.name in names else 0]

    def _write_csv(self) -> None:
        names = self._about.names
        keys = ("to_goal_mm", "to_goal_deg", "estimate_off_mm", "truly_to_goal_mm")
        present = [key for key in keys if self._steps and self._steps[0].get(key) is not None]
        stages = ("first", "goal", "estimate", "plan", "act")
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["step", "image_cost", "ssim", *(f"{stage}_s" for stage in stages),
                        *(f"{name} {key}" for key in present for name in names)])  # fmt: skip
        for step in self._steps:
            seconds = [step["seconds"].get(stage, "") for stage in stages]
            values = [step[key][name] for key in present for name in names]
            table.writerow([step["step"], step["image_cost"], step["ssim"], *seconds, *values])
        write_atomically(self._folder / CSV_FILE, text.getvalue().encode())

    def _report(self) -> dict[str, Any]:
        about, (outcome, text) = self._about, self._end or (None, None)
        report: dict[str, Any] = {
            "outcome": outcome,
            "text": text,
            "steps_done": len(self._actions),
            "seconds": self.seconds,
            **about.robot(),
            "seed": about.seed,
            "objects": list(about.names),
            "method": about.method,
            "settings": asdict(about.settings),
            "goal": None if self._goal is None else _goal_entry(self._goal),
            "noticed": self._notices,
            "actions": self._actions,
            "steps": self._steps,
        }
        if self._course is not None:
            times = ReplayClock(self._course.trajectory).step_s[: len(self._steps)]
            report["step_s"] = [round(at_s, 3) for at_s in times]
        if about.parts is not None:
            report["parts"] = about.parts.to_json()
        if about.simulator is not None:
            report["simulator"] = about.simulator
        if about.goal is not None:
            report["moved"] = list(about.moved)
            if about.moved and self._table is not None and self._course is not None:
                task = RearrangementTask(0, self._course.states[0], about.goal, about.moved)
                score = score_of(task, self._table.truth(), about.symmetries)
                report["score"], report["success_2cm"] = score.to_json(), score.is_success()
        return report


def recorded(events: Iterable[Event], record: EpisodeRecord) -> Iterator[Event]:
    """Yield the events of an episode, each of them recorded first; what the caller does meanwhile takes no time."""
    for event in events:
        record.take(event)
        yield event
        record.go_on()


def by_name(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    """Values of objects as reports have them."""
    return {name: round(float(value), 3) for name, value in zip(names, values, strict=True)}


def _goal_entry(goal: GoalFound) -> dict[str, Any]:
    """A goal as the report has it."""
    objects = [encode(ObjectJson.of(name, goal.goal.poses[n])) for n, name in enumerate(goal.goal.names)]
    estimate = None if goal.estimate is None else estimated_to_json(goal.estimate)
    return {"objects": objects, "estimate": estimate}


# What a finished episode has left


class NoEpisode(OsfError):
    """A folder that holds no episode."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} holds no episode: give a folder that 'osf episode' has left.")


@dataclass(frozen=True, eq=False, slots=True)
class FinishedEpisode:
    """An episode that is over, or was ended early.

    Attributes:
        folder: where frames and goal image are.
        trajectory: its course.
        report: of it.
    """

    folder: Path
    trajectory: Trajectory
    report: Mapping[str, Any]


def read_episode(folder: Path) -> FinishedEpisode:
    """What an episode has left.

    Raises:
        NoEpisode: if there is none.
        CorruptFile: if a file is damaged.
    """
    if not (folder / TRAJECTORY_FILE).is_file() or not (folder / REPORT_FILE).is_file():
        raise NoEpisode(folder)
    trajectory = read_trajectory(folder / TRAJECTORY_FILE)
    return FinishedEpisode(folder, trajectory, read_json(folder / REPORT_FILE, as_mapping))
