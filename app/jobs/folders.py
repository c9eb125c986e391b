"""The folders of jobs: collections/JOB in the data directory holds what a job was given and what it has made."""

from __future__ import annotations

import contextlib
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from osfcore.io.files import put_in_place, sync

from ..storage.database import CannotStore
from .job import INPUTS

_TEMPORARY_PREFIX = ".new-"


class JobFolders:
    """Those of one data directory.

    Args:
        data_dir: of the service.
    """

    def __init__(self, data_dir: Path) -> None:
        self._root = data_dir / "collections"

    def sweep(self) -> None:
        """Remove what an earlier service left half done."""
        for folder in self._root.glob(f"{_TEMPORARY_PREFIX}*"):
            shutil.rmtree(folder, ignore_errors=True)
        for folder in self._root.glob("[!.]*"):
            remove_half_made(folder)

    def folder(self, job: str) -> Path:
        """Where a job's outputs are."""
        return self._root / job

    def inputs(self, job: str) -> Path:
        """Where a job's inputs are, if it was given any."""
        return self.folder(job) / INPUTS

    @contextlib.contextmanager
    def new_inputs(self) -> Iterator[Path]:
        """Where a folder of inputs may be made for `take`; what no job has taken is removed."""
        folder = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def put_aside(self, job: str) -> Path:
        """Rename a job's folder, if there is one, to one that the next start removes.

        Raises:
            CannotStore: if that is not allowed.
        """
        aside = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            if self.folder(job).is_dir():
                self.folder(job).rename(aside)
                sync(self._root)  # or the files would be there again after a power failure
        except OSError as error:
            raise CannotStore(self.folder(job), error.strerror or str(error)) from error
        return aside

    def take(self, job: str, inputs: Path) -> None:
        """Make a folder from `new_inputs` a job's own.

        Raises:
            CannotStore: if it cannot be put in place.
        """
        place = self.inputs(job)
        try:
            place.parent.mkdir(parents=True)
            put_in_place(inputs, place)
        except OSError as error:
            raise CannotStore(Path(self._root.name), error.strerror or str(error)) from error


def remove_half_made(folder: Path) -> None:
    """Remove from a job's folder what had not got its name yet when whoever made it ended."""
    for left in folder.glob(".*"):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):  # on a read-only disk it stays
                left.unlink()
