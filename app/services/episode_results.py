"""What an episode has left: report, course, frames, files to download; `app.jobs.kinds.episodes` makes them."""

from __future__ import annotations

import threading
import zipfile
from pathlib import Path
from typing import Any, Literal

import cv2

from app.episodes.file_names import (
    ARCHIVE_FILE,
    CLIP_FILE,
    CSV_FILE,
    FRAMES_FOLDER,
    GOAL_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VIDEO_FILE,
)
from app.episodes.frames import Part, part_of, read_frame, read_frames, write_video
from app.jobs.job import Job
from app.services.runner import Runner
from osfcore.errors import InvalidInput, OsfError, UnknownName, shown
from osfcore.geometry.states import SceneState
from osfcore.io.files import file_at_once, read_json
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import Entry, decode
from osfcore.io.scene_file import StateJson

FILES = (REPORT_FILE, CSV_FILE, GOAL_FILE, VIDEO_FILE, CLIP_FILE, RECORDING_FILE, ARCHIVE_FILE)
THUMBNAIL_PX = 96


class NoTrajectory(OsfError):
    """An episode that cannot be replayed."""

    def __init__(self) -> None:
        super().__init__(
            "This episode cannot be replayed in 3D: it has not looked at anything yet, or an earlier version ran it."
        )


class EpisodeResults:
    """The results of the episodes of one service. Methods block; any thread may call.

    Args:
        runner: holds the jobs.
    """

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self._making = threading.Lock()  # of files on demand

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
        count = len(list((self._folder(job) / FRAMES_FOLDER).glob("[0-9]*.png")))
        if not count:
            raise UnknownName("picture", at, ["none yet"])
        whole = read_frame(self._folder(job) / FRAMES_FOLDER / f"{count - 1 if at == 'end' else 0:03d}.png")
        return encode_png(cv2.resize(part_of(whole, "now"), (THUMBNAIL_PX,) * 2, interpolation=cv2.INTER_AREA))

    def files(self, job: Job) -> tuple[str, ...]:
        """Names that can be downloaded now; those of an episode that was broken off are made when they are."""
        folder = self._folder(job)
        has_frames = job.is_finished and (folder / FRAMES_FOLDER / "000.png").is_file()
        made = (VIDEO_FILE, RECORDING_FILE, ARCHIVE_FILE) if has_frames else ()
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
        path = self._folder(job) / name
        if not path.is_file() or (name == ARCHIVE_FILE and self._is_outdated(job, path)):
            self._make(job, path)
        return path

    def _is_outdated(self, job: Job, archive: Path) -> bool:
        """Whether something was made after the archive, such as a clip."""
        made_at = archive.stat().st_mtime_ns
        files = (self._folder(job) / name for name in self.files(job))
        return any(file.is_file() and file.stat().st_mtime_ns > made_at for file in files)

    def _make(self, job: Job, path: Path) -> None:
        """What an episode has not left itself: all in one, or video and recording of one that was broken off."""
        if path.name == ARCHIVE_FILE:
            _pack(path, [self._made(job, name) for name in self.files(job) if name != ARCHIVE_FILE])
            return
        if path.name == VIDEO_FILE:
            write_video(path, read_frames(path.parent / FRAMES_FOLDER))
            return
        from app.episodes.recording import write_recording

        states = read_json(path.with_name(REPORT_FILE), _as_states)
        write_recording(path, self._runner.library, states)

    def _folder(self, job: Job) -> Path:
        return self._runner.jobs.folder(job.id)


def _pack(path: Path, files: list[Path]) -> None:
    """Put files into a zip, which takes its name only when it is whole."""
    with file_at_once(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)


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
