"""Records that are kept as folders: ROOT/ID with a JSON of facts and whatever files belong to them."""

from __future__ import annotations

import contextlib
import shutil
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from app.storage.schema import CannotStore
from osfcore.errors import CorruptFile, NotThere, OsfError
from osfcore.io.files import put_in_place

_TEMPORARY_PREFIX = ".new-"


class Dated(Protocol):
    """What every record tells."""

    @property
    def id(self) -> str:
        """Identifier, the name of its folder."""
        ...

    @property
    def created_at(self) -> str:
        """UTC, ISO 8601."""
        ...


Record = TypeVar("Record", bound=Dated)


class RecordFolders(Generic[Record]):
    """The records of one folder. Any thread may call.

    Args:
        root: the folder; made when the first record comes.
        what: a record is, in sentences.
        facts: name of the JSON in each record's folder.
        read: that JSON.
        most: records kept at once.
        too_many: the error that says so.
    """

    def __init__(
        self,
        root: Path,
        what: str,
        facts: str,
        read: Callable[[Path], Record],
        most: int,
        too_many: Callable[[int], OsfError],
    ) -> None:
        self._root, self._what, self._facts, self._read = root, what, facts, read
        self._most, self._too_many = most, too_many
        self._lock = threading.RLock()

    def start(self) -> None:
        """Remove what an earlier service left half done."""
        for folder in self._root.glob(f"{_TEMPORARY_PREFIX}*"):
            shutil.rmtree(folder, ignore_errors=True)

    def all(self) -> tuple[Record, ...]:
        """All records, newest first."""
        records = []
        for path in self._root.glob(f"[!.]*/{self._facts}"):
            with contextlib.suppress(CorruptFile, OSError):  # a damaged one must not hide the others
                records.append(self._read(path))
        return tuple(sorted(records, key=lambda record: (record.created_at, record.id), reverse=True))

    def get(self, name: str) -> Record:
        """One record.

        Raises:
            UnknownName: if there is none.
        """
        records = self.all()
        for record in records:
            if record.id == name:
                return record
        raise NotThere(self._what)

    def remove(self, name: str) -> None:
        """Delete a record.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        trash = self._temporary()
        with self._lock, self._stored():
            self.get(name)
            (self._root / name).rename(trash)
        shutil.rmtree(trash, ignore_errors=True)

    def _keep(self, name: str, files: Mapping[str, bytes | None]) -> None:
        """Put a new record in place, whole or not at all; files that are None are left out."""
        folder = self._temporary()
        try:
            with self._lock, self._stored():  # others may come in at the same time
                if len(self.all()) >= self._most:
                    raise self._too_many(self._most)
                write_files(folder, files)
                put_in_place(folder, self._root / name)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _replace(self, name: str, files: Mapping[str, bytes | None]) -> None:
        """Give a record that exists other files, the last one last; those that are None are removed."""
        folder = self._temporary()
        try:
            with self._lock, self._stored():
                self.get(name)
                write_files(folder, files)
                for file, data in files.items():
                    if data is None:
                        (self._root / name / file).unlink(missing_ok=True)
                    else:
                        put_in_place(folder / file, self._root / name / file)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _temporary(self) -> Path:
        return self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"

    @contextlib.contextmanager
    def _stored(self) -> Iterator[None]:
        """What the disk refuses, as an error for people."""
        try:
            yield
        except OSError as error:
            raise CannotStore(Path(self._root.name), error.strerror or str(error)) from error


def write_files(folder: Path, files: Mapping[str, bytes | None]) -> None:
    """Make a folder with files; those that are None are left out."""
    folder.mkdir(parents=True)
    for name, data in files.items():
        if data is not None:
            (folder / name).write_bytes(data)
