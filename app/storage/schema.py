"""How the database file is laid out: opened whatever state it is in, brought to this version, or put aside.

A file of an older version is migrated, with a copy kept beside it. One that a newer version wrote, or that is damaged,
is renamed and an empty one takes its place: a service that does not start helps nobody, and nothing is deleted.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from osfcore.errors import CorruptFile, OsfError
from osfcore.io.files import put_in_place, sync

FILE = "service.sqlite3"
_APPLICATION_ID = 0x4F534631  # "OSF1"
# Each brings a file of the version before it to its own; what was released is never changed.
_MIGRATIONS = (
    (
        1,
        """
CREATE TABLE scenes (
    id TEXT PRIMARY KEY, seed INTEGER NOT NULL, created_at TEXT NOT NULL, image_size INTEGER NOT NULL,
    initial TEXT NOT NULL, state TEXT NOT NULL, time_s REAL NOT NULL, revision INTEGER NOT NULL,
    is_current INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER NOT NULL, job TEXT NOT NULL);
CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL);
""",
    ),
    (
        2,
        """
CREATE TABLE set_aside (
    number INTEGER PRIMARY KEY, kind TEXT NOT NULL, id TEXT NOT NULL, row TEXT NOT NULL, reason TEXT NOT NULL,
    at TEXT NOT NULL
);
""",
    ),
)
SCHEMA_VERSION = _MIGRATIONS[-1][0]
_READ_BY_EVERY_VERSION = (
    "SELECT id, seed, created_at, image_size, initial, state, time_s, revision, is_current FROM scenes LIMIT 0",
    "SELECT id, number, job FROM jobs LIMIT 0",
    "SELECT id, job FROM events LIMIT 0",
)


class CannotStore(OsfError):
    """The data directory cannot be written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} cannot be written ({reason}); free some space or choose another data directory.")


class UnusableDatabase(CorruptFile):
    """A database of this program that this version cannot work with.

    Args:
        path: of the file.
        label: what is wrong with it, as part of a file name.
        reason: the same for people.
    """

    def __init__(self, path: Path, label: str, reason: str) -> None:
        super().__init__(path, reason)
        self.label, self.reason = label, reason


def check_database(path: Path) -> int:
    """The version of a database file; 0 if it is empty.

    Raises:
        UnusableDatabase: if it is damaged, or a newer version wrote it.
        CorruptFile: if it is another program's.
        CannotStore: if it cannot be opened.
    """
    with _connected(path) as database:
        version = database.execute("PRAGMA user_version").fetchone()[0]
        owner = database.execute("PRAGMA application_id").fetchone()[0]
        if database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0:
            return 0
        if owner != _APPLICATION_ID:
            raise CorruptFile(path, "it is another program's database; move it away")
        if version > SCHEMA_VERSION:
            raise UnusableDatabase(
                path,
                f"newer-{version}",
                f"a newer version wrote it (format {version}, this one knows {SCHEMA_VERSION})",
            )
        if version < 1 or not _is_sound(database):
            raise UnusableDatabase(path, "damaged", "it is damaged")
    return version


def open_database(path: Path) -> sqlite3.Connection:
    """A connection to a database of this version, which is made or migrated if need be.

    Raises:
        UnusableDatabase: if it is damaged, or a newer version wrote it.
        CorruptFile: if it is another program's.
        CannotStore: if it cannot be written.
    """
    version = check_database(path)
    try:
        if 0 < version < SCHEMA_VERSION:
            _keep_copy(path, unused(path.with_name(f"{path.name}.format-{version}")))
        return _migrated(path, version)
    except sqlite3.DatabaseError as error:
        raise CannotStore(path, str(error)) from error
    except OSError as error:
        raise CannotStore(path, error.strerror or str(error)) from error


def put_aside(path: Path, label: str) -> Path:
    """Rename a database with what belongs to it, so that another one can take its place; returns its new name.

    Raises:
        CannotStore: if that is not allowed.
    """
    place = unused(path.with_name(f"{path.name}.{label}"))
    try:
        for suffix in ("-wal", "-shm", ""):  # beside a new file, the older one's log would be taken for its own
            part = path.with_name(path.name + suffix)
            if part.exists():
                part.rename(place.with_name(place.name + suffix))
        sync(path.parent)
    except OSError as error:
        raise CannotStore(path, error.strerror or str(error)) from error
    return place


def copy_database(path: Path, place: Path) -> None:
    """Write a copy of a database that others may be using, as it is at one moment; it outlives a power failure.

    Raises:
        sqlite3.DatabaseError: if it cannot be read or the copy cannot be written.
        OSError: likewise.
    """
    source = sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)
    with contextlib.closing(source), contextlib.closing(sqlite3.connect(place)) as copy:
        source.backup(copy)
    sync(place)


def unused(path: Path) -> Path:
    """A path that nothing has: this one, or with a number behind it."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}.{number}")
    return free


@contextlib.contextmanager
def _connected(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection for a look, after which every failure is one of ours."""
    try:
        with contextlib.closing(sqlite3.connect(path)) as database:
            yield database
    except sqlite3.OperationalError as error:
        raise CannotStore(path, str(error)) from error
    except sqlite3.DatabaseError as error:
        raise UnusableDatabase(path, "damaged", "it is damaged") from error


def _is_sound(database: sqlite3.Connection) -> bool:
    if database.execute("PRAGMA quick_check").fetchone()[0] != "ok":
        return False
    try:
        for statement in _READ_BY_EVERY_VERSION:
            database.execute(statement)
    except sqlite3.OperationalError:  # no such table, or column
        return False
    return True


def _keep_copy(path: Path, place: Path) -> None:
    partial_copy = place.with_name(f".{place.name}.part")
    partial_copy.unlink(missing_ok=True)
    copy_database(path, partial_copy)
    put_in_place(partial_copy, place)


def _migrated(path: Path, version: int) -> sqlite3.Connection:
    database = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
    try:
        database.execute("PRAGMA journal_mode = WAL")
        # With NORMAL a power failure may take the last commits with it, and jobs that were answered 202 would be gone.
        # FULL waits for the disk at every commit: 0.3 ms on an SSD instead of 0.02 ms, for a few commits a second.
        database.execute("PRAGMA synchronous = FULL")
        database.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")  # one bad text hides no other
        if version < SCHEMA_VERSION:
            steps = "".join(sql for target, sql in _MIGRATIONS if target > version)
            marks = f"PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
            database.executescript(f"BEGIN IMMEDIATE; {marks} {steps} COMMIT;")
    except BaseException:
        database.close()
        raise
    return database
