"""Objects that people add and delete: an uploaded mesh becomes a job, and one that is needed stays."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool

from app.jobs.job import Job
from app.jobs.kinds.objects import UPLOAD, MeshRefused
from app.services.runner import RESERVED, Runner
from app.storage.uploads import save
from osfcore.errors import CorruptFile, OsfError
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.fetch import NewObject

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
            chunks: a GLB, or a zip of an OBJ with its MTL and texture.
            file_name: what the uploader calls it.

        Raises:
            InvalidInput: if name, mass, scale or label are out of range.
            ObjectTaken: if the name is taken, or will be.
            MeshRefused: if it is neither a GLB nor a zip.
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
        scenes = sum(name in record.state.names for record in self._runner.scenes())
        if scenes:
            which = "a scene; delete that scene first" if scenes == 1 else f"{scenes} scenes; delete those scenes first"
            raise ObjectNeeded(label, which)
        if any(_needs(job, name) for job in self._runner.jobs.live()):
            raise ObjectNeeded(label, "a job that waits or runs; wait for it or cancel it first")
        self._runner.library.remove(name)
        self._runner.storage.outdate()

    def _check(self, new: NewObject) -> None:
        new.check()
        is_coming = any(job.params["object"]["name"] == new.name for job in self._runner.jobs.live(KIND))
        if is_coming or new.name in RESERVED or (self._runner.library.root / new.name).exists():
            raise ObjectTaken(new.name)

    def _queue(self, new: NewObject, folder: Path, file_name: str) -> Job:
        from osfcore.objects.mesh import check_upload  # loads trimesh, which the page's start need not wait for

        try:
            check_upload(folder / UPLOAD)
        except CorruptFile as error:
            raise MeshRefused(str(error).replace(str(folder / UPLOAD), "The uploaded file")) from error
        self._check(new)  # others may have come in since the upload began
        params = {"name": new.name, "object": asdict(new), "file_name": file_name}
        return self._runner.submit_with_inputs(KIND, params, folder)


def _needs(job: Job, name: str) -> bool:
    """Whether a job that has not finished may load an object."""
    params: dict[str, Any] = job.params
    if job.kind == "collect_pushes":  # it draws from all
        return True
    mesh = (params.get("source") or {}).get("mesh")
    return name == mesh or name == params.get("name") or name in params.get("names", ())
