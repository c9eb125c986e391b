"""Episodes: asking for one, and telling what came of it. The work is a job (`app.jobs.kinds.episodes`)."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.episodes.file_names import (
    CSV_FILE,
    FRAMES_FOLDER,
    GOAL_FILE,
    PREPARED_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VIDEO_FILE,
)
from app.episodes.frames import Part, part_of, read_frame, read_frames, write_video
from app.jobs.job import Job, JobPage
from app.jobs.kinds.episodes import settings_of
from app.services.examples.stories import Stories
from app.services.fields import FieldCatalogue, MissingFields
from app.services.goals import Goals, NoTable
from app.services.runner import Runner
from app.storage.database import CannotStore
from app.storage.goal_store import Poses, poses_to_json
from osfcore.control.episode_settings import EpisodeSettings
from osfcore.errors import InvalidInput, OsfError, UnknownName, check_seed, shown
from osfcore.geometry.poses import unit_quaternion
from osfcore.geometry.states import SceneState
from osfcore.io.files import read_json
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import Entry, decode
from osfcore.io.scene_file import StateJson, camera_to_json

KIND = "episode"
FILES = (REPORT_FILE, CSV_FILE, GOAL_FILE, VIDEO_FILE, RECORDING_FILE)
_PLAN = ("samples", "horizon", "temperature")


class NoGoal(OsfError):
    """An episode needs exactly one goal."""

    def __init__(self) -> None:
        super().__init__("An episode needs a goal: name a goal image (goal), or give poses of all objects (poses).")


class NoTrajectory(OsfError):
    """An episode that cannot be replayed."""

    def __init__(self) -> None:
        super().__init__(
            "This episode cannot be replayed in 3D: it has not looked at anything yet, or an earlier version ran it."
        )


@dataclass(frozen=True, eq=False, slots=True)
class AskedEpisode:
    """What to do.

    Attributes:
        scene: identifier; None for the current one.
        goal: identifier of a goal image; None where poses are given.
        poses: where all objects shall be; None where a goal image is named.
        seed: of the searches.
        settings: changes of the defaults, see `EpisodeSettings` and `PlanSettings`.
    """

    scene: str | None = None
    goal: str | None = None
    poses: Poses | None = None
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)


class Episodes:
    """The episodes of one service. Methods that change something block; any thread may call.

    Args:
        runner: holds scenes and jobs.
        fields: what can be recognised.
        goals: goal images.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue, goals: Goals) -> None:
        self._runner = runner
        self._fields = fields
        self._goals = goals
        self._making = threading.Lock()  # of files on demand

    # Asking for one

    def start(self, asked: AskedEpisode) -> Job:
        """Queue an episode.

        Raises:
            NoTable, UnknownName: if there is no such scene or goal.
            NoGoal: if there is neither goal nor poses, or both.
            MissingFields: if an object cannot be recognised.
            InvalidInput: if a setting is out of range, or the poses are not those of the scene's objects.
            QueueFull: if too many jobs wait.
            StorageFull: if nothing more may be written.
        """
        check_seed(asked.seed)
        scene = asked.scene or self._runner.current
        if scene is None:
            raise NoTable
        names = self._runner.scene(scene).state.names
        if missing := sorted(set(names) - set(self._fields.names())):
            raise MissingFields(missing)
        settings = nested(asked.settings)
        settings_of(settings)
        with self._runner.jobs.new_inputs() as folder:
            params = {
                "scene": scene,
                "names": list(names),
                "seed": asked.seed,
                "settings": settings,
                "goal": self._goal(asked, scene, names, folder),
            }
            job = self._runner.submit_with_inputs(KIND, params, folder)
        self._goals.drop_draft()  # what is composed cannot be moved while the episode has the scene
        return job

    def change(self, job: Job, settings: Mapping[str, Any]) -> Job:
        """Let an episode go on with other settings.

        Raises:
            InvalidInput: if one is out of range.
            WrongJobState: if the episode neither runs nor pauses.
        """
        merged = nested({**flat(self.settings(job)), **settings})
        settings_of(merged)
        return self._runner.jobs.change(job.id, {"settings": merged})

    def _goal(self, asked: AskedEpisode, scene: str, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
        """What the job is told of the goal; a goal image is copied for it."""
        if (asked.goal is None) == (asked.poses is None):
            raise NoGoal
        try:
            folder.mkdir(parents=True)
            if asked.goal is None:
                poses = poses_to_json(_of_all(asked.poses or (), names))
                return {"id": None, "camera": None, "poses": poses, "truth": poses}
            goal = self._goals.get(asked.goal)
            shutil.copyfile(self._goals.image(goal.id), folder / GOAL_FILE)
            prepared = None if goal.example is None or goal.scene != scene else Stories().prepared(goal.example)
            if prepared is not None:
                shutil.copyfile(prepared, folder / PREPARED_FILE)
        except OSError as error:
            raise CannotStore(folder, error.strerror or str(error)) from error
        is_known = goal.poses is not None and goal.scene == scene and {name for name, _ in goal.poses} == set(names)
        truth = poses_to_json(goal.poses) if is_known and goal.poses is not None else None
        return {"id": goal.id, "camera": camera_to_json(goal.camera), "poses": None, "truth": truth}

    # Telling of one

    def page(self, limit: int, before: int | None = None) -> JobPage:
        """Some of the episodes, newest first, see `JobTable.page`."""
        return self._runner.jobs.page(limit, before, KIND)

    def get(self, episode: str) -> Job:
        """One episode.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._runner.jobs.get(episode, KIND)

    @staticmethod
    def settings(job: Job) -> EpisodeSettings:
        """How an episode goes now."""
        return settings_of(job.params["settings"])

    def report(self, job: Job) -> dict[str, Any] | None:
        """What report.json holds so far; None before there is one.

        Raises:
            CorruptFile: if it is damaged.
        """
        path = self._folder(job) / REPORT_FILE
        return read_json(path, _as_report) if path.is_file() else None

    def trajectory(self, job: Job) -> Path:
        """The file with an episode's course so far, see `app.episodes.trajectory`.

        Raises:
            NoTrajectory: if there is none yet, or the episode was run by an earlier version.
        """
        path = self._folder(job) / TRAJECTORY_FILE
        if not path.is_file():
            raise NoTrajectory
        return path

    def frame(self, job: Job, step: int, part: Part) -> bytes:
        """PNG of one frame, or of one of its pictures.

        Args:
            job: the episode.
            step: actions executed before the frame.
            part: "all" for the whole frame, or which of the pictures in its upper row.

        Raises:
            UnknownName: if there is no such frame.
            CorruptFile: if it is damaged.
        """
        path = self._folder(job) / FRAMES_FOLDER / f"{step:03d}.png"
        try:
            whole = path.read_bytes()
        except FileNotFoundError:
            count = len(list(path.parent.glob("[0-9]*.png")))
            known = [f"0 to {count - 1}"] if count else ["none yet"]
            raise UnknownName("frame", str(step), known) from None
        return whole if part == "all" else encode_png(part_of(read_frame(path), part))

    def files(self, job: Job) -> tuple[str, ...]:
        """Names that can be downloaded now; those of an episode that was broken off are made when they are."""
        folder = self._folder(job)
        has_frames = job.is_finished and (folder / FRAMES_FOLDER / "000.png").is_file()
        made = (VIDEO_FILE, RECORDING_FILE) if has_frames else ()
        return tuple(name for name in FILES if (folder / name).is_file() or name in made)

    def file(self, job: Job, name: str) -> Path:
        """One of them.

        Raises:
            UnknownName: if there is none of this name.
            CorruptFile: if what it would be made of is damaged.
            CannotWrite: if it cannot be made.
        """
        names = self.files(job)
        if name not in names:
            raise UnknownName(f"file of episode {job.id}", name[:80], names)
        path = self._folder(job) / name
        with self._making:
            if not path.is_file():
                self._make(job, path)
        return path

    def _make(self, job: Job, path: Path) -> None:
        """Video and recording of an episode that was broken off, from the steps that it has left."""
        if path.name == VIDEO_FILE:
            write_video(path, read_frames(path.parent / FRAMES_FOLDER))
            return
        from app.episodes.recording import write_recording

        states = read_json(path.with_name(REPORT_FILE), _as_states)
        write_recording(path, self._runner.library, states)

    def _folder(self, job: Job) -> Path:
        return self._runner.jobs.folder(job.id)


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as a job has them, those of the plan by themselves; what is left out is as by default."""
    given = {**flat(EpisodeSettings()), **settings}
    own = {key: value for key, value in given.items() if key not in _PLAN}
    return {**own, "plan": {key: given[key] for key in _PLAN}}


def flat(settings: EpisodeSettings) -> dict[str, Any]:
    """Settings as pages and programs have them: all in one place, without what nobody needs to change."""
    own = ("steps", "replan_every", "cost", "planning", "acting", "despite_doubts")
    return {name: getattr(settings, name) for name in own} | {name: getattr(settings.plan, name) for name in _PLAN}


def _of_all(poses: Poses, names: tuple[str, ...]) -> Poses:
    given = [name for name, _ in poses]
    if len(set(given)) != len(given) or set(given) != set(names):
        raise InvalidInput("objects of the goal", ", ".join(given) or "none", f"{', '.join(names)}, each once")
    for name, pose in poses:
        unit_quaternion(pose.quaternion, f"quaternion of {name}")
    return poses


class _Step(Entry):
    truth: StateJson


class _Report(Entry):
    steps: list[_Step]


def _as_report(data: object) -> dict[str, Any]:
    if not isinstance(data, dict) or not isinstance(data.get("steps"), list):
        raise InvalidInput("report", shown(repr(data)), "a JSON object with a list of steps")
    return data


def _as_states(data: object) -> list[SceneState]:
    """The true states of a report."""
    steps = decode(_Report, data, "report").steps
    if not steps:
        raise InvalidInput("number of steps", 0, "1 at least")
    return [step.truth.state() for step in steps]
