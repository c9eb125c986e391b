"""Episodes: asking for one, and telling what came of it. The work is a job (`app.jobs.kinds.episodes`)."""

from __future__ import annotations

import itertools
import threading
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import cv2

from osfcore.errors import InvalidInput, OsfError, UnknownName, check_seed, shown
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import unit_quaternion
from osfcore.geometry.states import SceneState
from osfcore.io.files import file_at_once, read_json, write_atomically
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import Entry, decode
from osfcore.io.scene_file import CameraJson, ObjectJson, StateJson
from osfcore.io.video_file import ffmpeg_or_none, need_ffmpeg
from osfcore.paper.method import Method

from ..episodes.file_names import (
    ARCHIVE_FILE,
    CLIP_FILE,
    CSV_FILE,
    FRAMES_FOLDER,
    GOAL_FILE,
    PREPARED_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VIDEO_FILE,
)
from ..episodes.frames import Part, part_of, read_frame, read_frames, write_video
from ..episodes.settings import ChosenSettings
from ..jobs.job import Job, JobPage
from ..jobs.kinds.clips import ClipParams
from ..jobs.kinds.episodes import EpisodeGoal, EpisodeParams
from ..processes.messages.scene_messages import ComposeGoal, SceneRecord
from ..storage.records import GoalRecord, Poses
from .examples import Stories
from .fields import FieldCatalogue
from .goals import GOAL_SIDE, GoalChecks, Goals, NoTable
from .runner import Runner, fill_inputs
from .scenes import scene_or_current

KIND, CLIP_KIND = "episode", "clip"
_MOST_NAMES = 1000  # that a new one is compared with
FILES = (REPORT_FILE, CSV_FILE, GOAL_FILE, VIDEO_FILE, CLIP_FILE, RECORDING_FILE, ARCHIVE_FILE)
THUMBNAIL_PX = 96


class NoTrajectory(OsfError):
    """An episode that cannot be replayed."""

    def __init__(self) -> None:
        super().__init__(
            "This episode cannot be replayed in 3D: it has not looked at anything yet, or an earlier version ran it."
        )


class NoGoal(OsfError):
    """An episode needs exactly one goal."""

    def __init__(self) -> None:
        super().__init__("An episode needs a goal: name a goal image (goal), or give poses of all objects (poses).")


class EpisodeGoesOn(OsfError):
    """A clip of something that is not over."""

    def __init__(self) -> None:
        super().__init__("The episode goes on; a clip can be made when it is over.")


class GoalUnknown(OsfError):
    """A clip of an episode that looked at images alone."""

    def __init__(self) -> None:
        super().__init__(
            "A clip shows distances to the goal, which the method as published never knows; watch the video."
        )


class Episodes:
    """The episodes of one service. Methods that change something block; any thread may call.

    Args:
        runner: holds scenes and jobs.
        fields: what can be recognised.
        goals: goal images.
        checks: of goal images.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue, goals: Goals, checks: GoalChecks) -> None:
        self._runner, self._fields, self._goals, self._checks = runner, fields, goals, checks
        self._making = threading.Lock()  # of files on demand

    # Asking for one

    def start(
        self,
        settings: ChosenSettings,
        scene: str | None = None,
        goal: str | None = None,
        poses: Poses | None = None,
        seed: int = 0,
    ) -> Job:
        """Queue an episode toward a goal image, or toward poses of all objects.

        Args:
            settings: how it goes.
            scene: identifier; None for the current one.
            goal: identifier of a goal image.
            poses: where all objects shall be, T_world_object [m] by name.
            seed: of the searches.

        Raises:
            NoTable, UnknownName: if there is no such scene or goal.
            NoGoal: if there is neither goal nor poses, or both.
            MissingFields, NoPublishedField: if an object cannot be recognised.
            GoalRefused: if the goal image does not show the scene's objects, unless doubts are not to matter.
            InvalidInput: if the poses are not those of the scene's objects.
            QueueFull: if too many jobs wait.
            StorageFull: if nothing more may be written.
        """
        check_seed(seed)
        table = scene_or_current(self._runner.scenes, scene, NoTable)
        names = table.state.names
        self._fields.require(names, settings.method)
        if goal is not None and poses is None and not settings.despite_doubts:
            self._checks.require(goal, table.id)
        kept = None if goal is None else self._goals.get(goal)
        with self._runner.jobs.new_inputs() as folder:
            title, wanted = self._new_name(kept, names), self._goal(kept, poses, settings.method, table, folder)
            params = EpisodeParams(
                scene=table.id, title=title, names=names, seed=seed, settings=settings, goal=wanted,
                simulator=self._runner.scenes.simulator,
            )  # fmt: skip
            job = self._runner.submit_with_inputs(KIND, params, folder)
        self._goals.drop_draft()  # what is composed cannot be moved while the episode has the scene
        return job

    def change(self, job: Job, settings: Mapping[str, Any]) -> Job:
        """Let an episode go on with other settings.

        Raises:
            InvalidInput: if one is out of range, or another method, or the method as published, which goes as it began.
            WrongJobState: if the episode neither runs nor pauses.
        """
        now = self.settings(job)
        if (method := settings.get("method", now.method)) != now.method:
            raise InvalidInput("method", method, f"{now.method}, as when the episode began")
        if now.method == "paper":
            raise InvalidInput("change of settings", "asked for", "left out: the method as published goes as it began")
        return self._runner.jobs.change(job.id, {"settings": asdict(now.changed(settings))})

    def _goal(
        self, goal: GoalRecord | None, poses: Poses | None, method: Method, table: SceneRecord, folder: Path
    ) -> EpisodeGoal:
        """Return what the job is given of the goal; a goal image is copied for it."""
        if (goal is None) == (poses is None):
            raise NoGoal
        names = table.state.names
        files: dict[str, Path] = {}
        if goal is not None:
            poses = goal.poses
            files[GOAL_FILE] = self._goals.image(goal.id)
            prepared = None if goal.example is None or goal.scene != table.id else Stories().prepared(goal.example)
            if prepared is not None:
                files[PREPARED_FILE] = prepared
        fill_inputs(folder, files)
        identifier, camera = (None, None) if goal is None else (goal.id, CameraJson.of(goal.camera))
        if goal is not None and (goal.source != "photo" or poses is None):  # the job reads them from the image
            is_known = goal.scene == table.id and {name for name, _ in poses or ()} == set(names)
            return EpisodeGoal(id=identifier, camera=camera, truth=_entries(poses or ()) if is_known else None)
        given = _of_all(poses or (), names)
        if method == "paper":  # which knows of nothing else than an image
            made = self._runner.scenes.compose(ComposeGoal(table.id, given, size=GOAL_SIDE))
            write_atomically(folder / GOAL_FILE, made.png)
            camera, truth = CameraJson.of(goal_camera(GOAL_SIDE)), _entries(made.poses)
            return EpisodeGoal(id=identifier, camera=camera, truth=truth)
        return EpisodeGoal(id=identifier, camera=camera, poses=_entries(given), truth=_entries(given))

    def make_clip(self, job: Job) -> Job:
        """Queue the job that makes a clip of an episode; the one that is at it already, if there is one.

        Raises:
            NoTrajectory: if the episode cannot be drawn again.
            EpisodeGoesOn: if it is not over yet.
            GoalUnknown: if it never knew goal poses.
            QueueFull: if too many jobs wait.
            StorageFull: if nothing more may be written.
            MissingExtra: if there is no ffmpeg.
        """
        if not job.is_finished:
            raise EpisodeGoesOn
        need_ffmpeg("A clip")
        if self.settings(job).method == "paper":
            raise GoalUnknown
        self.trajectory(job)
        for other in self._runner.jobs.live(CLIP_KIND):
            if ClipParams.from_json(other.params).episode == job.id:
                return other
        return self._runner.submit_job(CLIP_KIND, ClipParams(episode=job.id, title=self.name(job)))

    # Telling of one

    def page(self, limit: int, before: int | None = None, search: str = "", outcome: str | None = None) -> JobPage:
        """Some of the episodes, newest first, see `JobTable.page`.

        Args:
            limit: how many at most.
            before: only older ones than this number.
            search: words that name or objects hold, all of them; capitals do not count.
            outcome: only those that ended so, or are in that state.
        """
        words = search.casefold().split()

        def fits(job: Job) -> bool:
            ended = (job.result or {}).get("outcome")
            if outcome not in (None, ended, job.state):
                return False
            labels = map(self._runner.library.label, EpisodeParams.from_json(job.params).names) if words else ()
            text = " ".join((self.name(job), *labels)).casefold()
            return all(word in text for word in words)

        return self._runner.jobs.page(limit, before, KIND, fits)

    def name(self, job: Job) -> str:
        """What people call an episode: its own name, or that of its objects in episodes of earlier versions."""
        params = EpisodeParams.from_json(job.params)
        return params.title or ", ".join(map(self._runner.library.label, params.names))

    def rename(self, job: Job, name: str) -> Job:
        """Call an episode something else.

        Raises:
            InvalidInput: if the name is empty.
        """
        if not name.strip():
            raise InvalidInput("name", "empty", "some letters")
        return self._runner.jobs.rename(job.id, name.strip())

    def _new_name(self, goal: GoalRecord | None, names: tuple[str, ...]) -> str:
        """That of the goal, or of the objects; with a number if there is one of that name already."""
        name = ", ".join(map(self._runner.library.label, names)) if goal is None else goal.name
        taken = {self.name(job) for job in self._runner.jobs.page(_MOST_NAMES, None, KIND).jobs}
        numbered = itertools.chain([name], (f"{name} {n}" for n in itertools.count(2)))
        return next(one for one in numbered if one not in taken)

    def get(self, episode: str) -> Job:
        """One episode.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._runner.jobs.get(episode, KIND)

    @staticmethod
    def settings(job: Job) -> ChosenSettings:
        """How an episode goes now."""
        return EpisodeParams.from_json(job.params).settings

    # What one has left; its job makes it

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

    def thumbnail(self, job: Job, at: Literal["start", "end"]) -> bytes:
        """Small PNG of the table, as the goal camera saw it first or last.

        Raises:
            UnknownName: if there is no frame yet.
            CorruptFile: if it is damaged.
        """
        frames = self._folder(job) / FRAMES_FOLDER
        count = len(list(frames.glob("[0-9]*.png")))
        if not count:
            raise UnknownName("picture", at, ["none yet"])
        whole = read_frame(frames / f"{count - 1 if at == 'end' else 0:03d}.png")
        return encode_png(cv2.resize(part_of(whole, "now"), (THUMBNAIL_PX,) * 2, interpolation=cv2.INTER_AREA))

    def files(self, job: Job) -> tuple[str, ...]:
        """Names that can be downloaded now; those of an episode that was broken off are made when they are."""
        folder = self._folder(job)
        has_frames = job.is_finished and (folder / FRAMES_FOLDER / "000.png").is_file()
        made = (RECORDING_FILE, ARCHIVE_FILE, *[VIDEO_FILE] * (ffmpeg_or_none() is not None)) if has_frames else ()
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
            raise UnknownName("file of this episode", name[:80], names)
        with self._making:
            return self._made(job, name)

    def _made(self, job: Job, name: str) -> Path:
        """Where a file is; made if the episode has not left it, as one that was broken off, or if it is outdated."""
        path = self._folder(job) / name
        if path.is_file() and not (name == ARCHIVE_FILE and self._is_outdated(job, path)):
            return path
        if name == ARCHIVE_FILE:
            files = [self._made(job, other) for other in self.files(job) if other != ARCHIVE_FILE]
            with file_at_once(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
                for file in files:
                    archive.write(file, file.name)
        elif name == VIDEO_FILE:
            write_video(path, read_frames(path.parent / FRAMES_FOLDER))
        else:
            from ..episodes.recording import write_recording

            write_recording(path, self._runner.library, read_json(path.with_name(REPORT_FILE), _as_states))
        return path

    def _is_outdated(self, job: Job, archive: Path) -> bool:
        """Whether something was made after the archive, such as a clip."""
        made_at = archive.stat().st_mtime_ns
        files = (self._folder(job) / name for name in self.files(job))
        return any(file.is_file() and file.stat().st_mtime_ns > made_at for file in files)

    def _folder(self, job: Job) -> Path:
        return self._runner.jobs.folder(job.id)


def _of_all(poses: Poses, names: tuple[str, ...]) -> Poses:
    given = [name for name, _ in poses]
    if len(set(given)) != len(given) or set(given) != set(names):
        raise InvalidInput("objects of the goal", ", ".join(given) or "none", f"{', '.join(names)}, each once")
    for name, pose in poses:
        unit_quaternion(pose.quaternion, f"quaternion of {name}")
    return poses


def _entries(poses: Poses) -> tuple[ObjectJson, ...]:
    return tuple(ObjectJson.of(name, pose) for name, pose in poses)


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
