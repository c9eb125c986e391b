"""Objects as the service keeps them: adding and deleting one's own, and thumbnails."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool

from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.io.files import write_atomically
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.fetch import NewObject

from ..jobs.job import Job
from ..jobs.kinds.objects import UPLOAD, AddObjectParams, MeshRefused
from ..processes.client import ProcessClient, ProcessUnavailable
from ..processes.thumbnail_process import thumbnails_main
from ..storage.uploads import save
from .runner import RESERVED, Runner

# Objects that people add and delete: an uploaded mesh becomes a job, and one that is needed stays


KIND = "add_object"


class ObjectTaken(OsfError):
    """A second object of a name."""

    def __init__(self, name: str) -> None:
        super().__init__(f"There is an object named {name} already; take another name, or delete that object first.")


class ObjectNeeded(OsfError):
    """An object that something needs."""

    def __init__(self, label: str, by: str) -> None:
        super().__init__(f"{label} is needed by {by}.")


class CatalogueObject(OsfError):
    """An object that belongs to the catalogue."""

    def __init__(self, label: str) -> None:
        super().__init__(f"{label} belongs to the catalogue; only objects that were added here can be deleted.")


class OwnObjects:
    """Adds and deletes objects of one data directory.

    Args:
        runner: scenes and jobs.
    """

    def __init__(self, runner: Runner) -> None:
        self._runner = runner

    async def receive(self, new: NewObject, chunks: AsyncIterator[bytes], file_name: str) -> Job:
        """Take in a mesh, bit by bit, and queue the job that makes it an object.

        Args:
            new: what is said of it.
            chunks: a mesh in one file, or a zip of one with the files that it names.
            file_name: what the uploader calls it; its end tells the format of all but GLB and zip.

        Raises:
            InvalidInput: if name, mass, scale or label are out of range.
            ObjectTaken: if the name is taken, or will be.
            MeshRefused: if it is neither.
            StorageFull, CannotStore, QueueFull: if there is no room for it.
        """
        await run_in_threadpool(self._check, new)
        await run_in_threadpool(self._runner.storage.check_room)
        with self._runner.jobs.new_inputs() as folder:
            await save(chunks, folder / UPLOAD)
            return await run_in_threadpool(self._queue, new, folder, file_name)

    def delete(self, name: str) -> None:
        """Delete an object that was added here, damaged or not.

        Raises:
            UnknownName: if there is none.
            CatalogueObject: if it was not added here.
            ObjectNeeded: if a scene or a job uses it.
            CannotWrite: if the disk refuses.
        """
        label = self._runner.library.label(name)
        if name in CATALOGUE:
            raise CatalogueObject(label)
        scenes = sum(name in record.state.names for record in self._runner.scenes.all())
        if scenes:
            which = "a scene; delete that scene first" if scenes == 1 else f"{scenes} scenes; delete those scenes first"
            raise ObjectNeeded(label, which)
        if any(_needs(job, name) for job in self._runner.jobs.live()):
            raise ObjectNeeded(label, "a job that waits or runs; wait for it or cancel it first")
        self._runner.library.remove(name)
        self._runner.storage.outdate()

    def _check(self, new: NewObject) -> None:
        new.check()
        is_coming = any(AddObjectParams.from_json(job.params).name == new.name for job in self._runner.jobs.live(KIND))
        if is_coming or new.name in RESERVED or (self._runner.library.root / new.name).exists():
            raise ObjectTaken(new.name)

    def _queue(self, new: NewObject, folder: Path, file_name: str) -> Job:
        from osfcore.objects.mesh import check_upload  # loads trimesh, which the page's start need not wait for

        try:
            check_upload(folder / UPLOAD, file_name)
        except CorruptFile as error:
            raise MeshRefused(str(error).replace(str(folder / UPLOAD), "The uploaded file")) from error
        self._check(new)  # others may have come in since the upload began
        params = AddObjectParams(name=new.name, object=new, file_name=file_name)
        return self._runner.submit_with_inputs(KIND, params, folder)


def _needs(job: Job, name: str) -> bool:
    """Whether a job that has not finished may load an object."""
    params: dict[str, Any] = job.params
    if job.kind == "collect_pushes":  # it draws from all
        return True
    mesh = (params.get("source") or {}).get("mesh")
    return name == mesh or name == params.get("name") or name in params.get("names", ())


# Thumbnails of objects: drawn once in a process of their own, which leaves when it is idle, and kept on disk


VERSION = 1  # of the picture; another one makes all anew
_NAME = "drawer of thumbnails"
_IDLE_S = 20.0
_ANSWER_S = 60.0


class Thumbnails:
    """Draws thumbnails, one at a time. Any thread may call.

    Args:
        library: the objects.
        cache: folder of what was drawn; made when needed.
        idle_s: after which the process ends [s].
    """

    def __init__(self, library: AssetLibrary, cache: Path, idle_s: float = _IDLE_S) -> None:
        self._library, self._cache, self._idle_s = library, cache, idle_s
        self._drawing = threading.Lock()
        self._lock = threading.Lock()
        self._process: ProcessClient | None = None
        self._timer: threading.Timer | None = None
        self._is_stopped = False

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        with self._lock:
            self._is_stopped = True
        self._end()

    def png(self, name: str) -> bytes:
        """The object from all around, as `osfcore.inspection.contact_sheet` draws it. Blocks.

        Raises:
            UnknownName, MissingAssets, CorruptFile: if there is no such object here, or it is damaged.
            ProcessUnavailable: if it could not be drawn.
        """
        file = self._cache / f"{self._library.digest(name)}-{VERSION}.png"
        with contextlib.suppress(OSError):
            return file.read_bytes()
        with self._drawing:
            with contextlib.suppress(OSError):  # another request may have drawn it meanwhile
                return file.read_bytes()
            png = self._draw(name)
        with contextlib.suppress(CannotWrite):  # on a full disk it is drawn again the next time
            write_atomically(file, png)
        return png

    def _draw(self, name: str) -> bytes:
        with self._lock:
            if self._is_stopped:  # requests that wait must not begin another process each
                raise ProcessUnavailable(_NAME, "has been stopped")
            if self._timer is not None:
                self._timer.cancel()
            if self._process is None:
                root = self._library.root
                self._process = ProcessClient(thumbnails_main, (root,), _NAME, answer_s=_ANSWER_S)
            process = self._process
        try:
            return process.call(name)
        finally:
            with self._lock:
                self._timer = threading.Timer(self._idle_s, self._end)
                self._timer.daemon = True
                self._timer.start()
                is_stopped = self._is_stopped
            if is_stopped:
                self._end()

    def _end(self) -> None:
        with self._lock:
            process, self._process = self._process, None
            if self._timer is not None:
                self._timer.cancel()
        if process is not None:
            process.stop()
