"""What outlives the service: scenes, jobs and job events, in one SQLite file of the data directory.

One process at a time: a lock file keeps a second service out, which would take the first one's jobs for dead.
What was accepted is on the disk before its caller hears of it. What has happened anyway, such as a push, is remembered
while the disk refuses, and written with the next write or `retry` that it takes. Nothing is accepted once the file is
not what was opened any more: moved, replaced, emptied or damaged by somebody else.

A file of an older version is migrated, with a copy kept beside it. One that a newer version wrote, or that is damaged,
is renamed and an empty one takes its place: a service that does not start helps nobody, and nothing is deleted.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from filelock import FileLock, Timeout
from pydantic import Field, FiniteFloat

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError, shown
from osfcore.geometry.cameras import image_side
from osfcore.io.files import put_in_place, sync
from osfcore.io.json_codec import Entry, Text, decode
from osfcore.io.scene_file import StateJson, state_to_json

from ..processes.messages.scene_messages import SceneRecord

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
_SCENE_COLUMNS: tuple[str, ...] = ("id", "seed", "created_at", "image_size", "initial", "state", "time_s", "revision")
_SENSELESS = (ValueError, TypeError, RecursionError)  # what reading a row raises if it makes no sense
_Count = Annotated[int, Field(ge=0)]
_MADE_BY_SERVICES = ("collections", "goals", "photos", "sets")  # folders that nothing else makes
PUT_BACK = "put it back, or stop the service and restore a backup"
_CHECK_S = 600.0  # between two looks at a file that nobody seems to have changed
Statement = tuple[str, tuple[Any, ...]]
_log = logging.getLogger(__name__)


class DataDirectoryInUse(OsfError):
    """Another service works in the data directory."""

    def __init__(self, data_dir: Path) -> None:
        super().__init__(f"Another service uses the data directory {data_dir}; stop it or choose another one.")


class CannotStore(OsfError):
    """The data directory cannot be written.

    Args:
        path: what cannot be written.
        reason: why.
        advice: what to do.
    """

    def __init__(
        self, path: Path, reason: str, advice: str = "free some space or choose another data directory"
    ) -> None:
        super().__init__(f"{path} cannot be written ({reason}); {advice}.")


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


@contextlib.contextmanager
def storing(path: Path) -> Iterator[None]:
    """Raise what the disk refuses as `CannotStore` of a path."""
    try:
        yield
    except CannotWrite as error:
        raise CannotStore(path, error.reason) from error
    except OSError as error:
        raise CannotStore(path, error.strerror or str(error)) from error
    except sqlite3.DatabaseError as error:
        raise CannotStore(path, str(error)) from error


def now_utc() -> str:
    """The time in UTC, ISO 8601 with milliseconds."""
    return utc_of(datetime.now(UTC).timestamp())


def utc_of(seconds: float, timespec: str = "milliseconds") -> str:
    """A moment since the epoch [s] in the same form, or as exactly as `datetime.isoformat` is asked."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec=timespec).replace("+00:00", "Z")


# The open database


def check_data_dir(data_dir: Path) -> None:
    """Report now what would keep a `Store` from opening; a file that it would put aside is left to it.

    Raises:
        DataDirectoryInUse, CorruptFile, CannotStore: as `Store`.
    """
    claimed = _claim(data_dir)
    try:
        if (data_dir / FILE).exists():
            with contextlib.suppress(UnusableDatabase):
                open_database(data_dir / FILE).close()
    finally:
        claimed.release()


class Store:
    """The open database. Every method may be called from any thread.

    Args:
        data_dir: made if it does not exist.
        max_events: job events kept.

    Raises:
        DataDirectoryInUse: if another service has it.
        CorruptFile: if the file is another program's; it is left as it is.
        CannotStore: if the directory cannot be written.
    """

    def __init__(self, data_dir: Path, max_events: int = 1000) -> None:
        self._path = data_dir / FILE
        self._max_events = max_events
        self._lock = threading.Lock()
        self._waiting: dict[str, tuple[Statement, ...]] = {}  # what the disk refused, oldest first
        self._set_aside: list[SetAside] = []
        self._claimed = _claim(data_dir)
        try:
            self._database = self._open()
            self._files = identities(self._path, self._path.with_name(f"{FILE}-wal"))
            self._left_as, self._checked_at = stamp(self._path), time.monotonic()
        except BaseException:
            self._claimed.release()
            raise

    def close(self) -> None:
        """Close the file and let others use the directory. Calling it again does nothing."""
        self.retry()
        with self._lock:
            self._waiting.clear()
            self._database.close()
            self._claimed.release()

    @property
    def set_aside(self) -> tuple[SetAside, ...]:
        """What was found to make no sense since this was opened."""
        return tuple(self._set_aside)

    @property
    def unwritten(self) -> int:
        """How many scenes and jobs have changed in ways that the disk has refused so far."""
        return len(self._waiting)

    def retry(self) -> None:
        """Write what waits, if there is any and the disk takes it now."""
        if self._waiting:
            with contextlib.suppress(CannotStore):
                self._write()

    def probe(self) -> str | None:
        """Write what waits, or what changes nothing; returns why the disk refuses, None if it does not."""
        try:
            self._write((f"PRAGMA user_version = {SCHEMA_VERSION}", ()))
        except CannotStore as error:
            return str(error)
        return None

    def _open(self) -> sqlite3.Connection:
        if not self._path.exists() and any(any(self._path.parent.glob(f"{name}/*")) for name in _MADE_BY_SERVICES):
            self._set_aside.append(SetAside("database", "", "", "it is missing", now_utc()))
        try:
            return open_database(self._path)
        except UnusableDatabase as error:
            place = put_aside(self._path, error.label)
            database = open_database(self._path)
            self._set_aside.append(SetAside("database", place.name, "", error.reason, now_utc()))
            with contextlib.suppress(sqlite3.DatabaseError):  # the file is there, and that is what counts
                database.execute(*_note(self._set_aside[-1]))
            return database

    def _write(self, *statements: Statement, waits_as: str | None = None) -> int:
        """Carry out statements in one transaction, after those that wait; returns the last row's number.

        Args:
            statements: SQL with its values.
            waits_as: what they are remembered under if the disk refuses, instead of older ones; None to raise.

        Raises:
            CannotStore: if the disk refuses.
        """
        with self._lock:
            if waits_as is not None:
                self._waiting.pop(waits_as, None)
            try:
                number = self._commit([*(one for group in self._waiting.values() for one in group), *statements])
            except CannotStore as error:
                if waits_as is None:
                    raise
                if not self._waiting:
                    _log.error("%s It is tried again until it can be written.", error)
                self._waiting[waits_as] = statements
                return 0
            self._waiting.clear()
            return number

    def _commit(self, statements: list[Statement]) -> int:
        self._check_file()
        number = 0
        try:
            self._database.execute("BEGIN IMMEDIATE")
            for sql, values in statements:
                number = self._database.execute(sql, values).lastrowid or number
            self._database.execute("COMMIT")
        except sqlite3.DatabaseError as error:
            with contextlib.suppress(sqlite3.DatabaseError):  # some failures have ended the transaction already
                self._database.execute("ROLLBACK")
            raise CannotStore(Path(FILE), str(error)) from error
        self._left_as = stamp(self._path)
        return number

    def _check_file(self) -> None:
        """Refuse to write what would be gone at the next start.

        The pages of a file that somebody else has changed are read anew, and now and then those of one that seems
        unchanged; the rest costs microseconds.

        Raises:
            CannotStore: if another file, or none, has the name of the one that was opened, or if it is damaged.
        """
        reason = None
        if identities(*self._files) != self._files:
            reason = "it, its log or the data directory was moved, deleted or replaced while the service runs"
        elif self._path.stat().st_size == 0:  # SQLite would delete the log if it were opened
            reason = "it was emptied while the service runs"
        elif stamp(self._path) != self._left_as or time.monotonic() - self._checked_at > _CHECK_S:
            try:
                check_database(self._path)
            except CorruptFile:
                reason = "it was damaged while the service runs"
            else:
                self._left_as, self._checked_at = stamp(self._path), time.monotonic()
        if reason is not None:
            raise CannotStore(Path(FILE), reason, PUT_BACK)

    def _read(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._lock, storing(Path(FILE)):
            return self._database.execute(sql, values).fetchall()

    # Scenes

    def save_scene(self, record: SceneRecord, *, can_wait: bool = False) -> None:
        """Insert or update a scene.

        Args:
            record: the scene as it is now.
            can_wait: remember it, if the disk refuses, and write it later.

        Raises:
            CannotStore: if the disk refuses and it cannot wait.
        """
        sql = (
            f"INSERT INTO scenes ({', '.join(_SCENE_COLUMNS)}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (id) DO UPDATE SET state = excluded.state, time_s = excluded.time_s,"
            " revision = excluded.revision"
        )
        self._write((sql, _scene_row(record)), waits_as=f"scene {record.id}" if can_wait else None)

    def delete_scene(self, scene: str) -> None:
        """Forget a scene.

        Raises:
            CannotStore: if the disk refuses.
        """
        self._write(("DELETE FROM scenes WHERE id = ?", (scene,)))

    def set_current(self, scene: str | None) -> None:
        """Remember which scene is shown, later if the disk refuses now."""
        self._write(("UPDATE scenes SET is_current = (id IS ?)", (scene,)), waits_as="current scene")

    def scenes(self) -> tuple[tuple[SceneRecord, ...], str | None]:
        """All scenes, oldest first, and the one that is shown; what makes no sense is set aside."""
        records, current = [], None
        for rowid, is_current, *values in self._read(
            f"SELECT rowid, is_current, {', '.join(_SCENE_COLUMNS)} FROM scenes ORDER BY rowid"
        ):
            row = dict(zip(_SCENE_COLUMNS, values, strict=True))
            try:
                records.append(_scene_of_row(row))
            except _SENSELESS as error:
                self._put_aside("scene", rowid, row, error)
                continue
            current = records[-1].id if is_current else current
        return tuple(records), current

    # Jobs and events

    def save_job(
        self,
        job: str,
        number: int,
        fields: dict[str, Any],
        event: dict[str, Any] | None = None,
        *,
        can_wait: bool = False,
    ) -> int:
        """Insert or update a job, and remember that it changed; old events are dropped.

        Args:
            job: identifier.
            number: orders the jobs; an update leaves it.
            fields: as JSON.
            event: how it is sent to pages, as JSON; None for the fields.
            can_wait: remember it, if the disk refuses, and write it later.

        Returns:
            The event's number; 0 if it has to wait.

        Raises:
            CannotStore: if the disk refuses and it cannot wait.
        """
        return self._write(
            (
                "INSERT INTO jobs VALUES (?, ?, ?) ON CONFLICT (id) DO UPDATE SET job = excluded.job",
                (job, number, json.dumps(fields)),
            ),
            ("INSERT INTO events (job) VALUES (?)", (json.dumps(fields if event is None else event),)),
            ("DELETE FROM events WHERE id <= last_insert_rowid() - ?", (self._max_events,)),
            waits_as=f"job {job}" if can_wait else None,
        )

    def forget_job(self, job: str) -> int:
        """Delete a job with its events; returns the number of the event that says so.

        Raises:
            CannotStore: if the disk refuses; then nothing is deleted.
        """
        its_id = "CASE WHEN json_valid(job) THEN json_extract(job, '$.id') END"
        return self._write(
            ("DELETE FROM jobs WHERE id = ?", (job,)),
            (f"DELETE FROM events WHERE {its_id} = ?", (job,)),
            ("INSERT INTO events (job) VALUES (?)", (json.dumps({"forgotten": job}),)),
            ("DELETE FROM events WHERE id <= last_insert_rowid() - ?", (self._max_events,)),
        )

    def jobs(self, parse: Callable[[dict[str, Any]], Any] = dict) -> tuple[tuple[int, Any], ...]:
        """Numbers of all jobs, and what `parse` makes of their fields, oldest first.

        Args:
            parse: raises an OsfError for what makes no sense; then the job is set aside.
        """
        found = []
        for rowid, job, number, text in self._read("SELECT rowid, id, number, job FROM jobs ORDER BY number, rowid"):
            try:
                found.append((decode(int, number, "number"), parse(_job_of_row(text, job))))
            except _SENSELESS as error:
                self._put_aside("job", rowid, {"id": job, "number": number, "job": text}, error)
        return tuple(found)

    def events_after(self, number: int, parse: Callable[[dict[str, Any]], Any] = dict) -> tuple[tuple[int, Any], ...]:
        """Events later than `number`, as far as they are kept and `parse` understands them, in order."""
        found = []
        for event, text in self._read("SELECT id, job FROM events WHERE id > ? ORDER BY id", (number,)):
            with contextlib.suppress(*_SENSELESS):
                found.append((event, parse(_job_of_row(text))))
        return tuple(found)

    def _put_aside(self, kind: str, rowid: int, row: dict[str, Any], error: Exception) -> None:
        entry = SetAside(kind, str(row["id"]), json.dumps(row, default=repr), str(error).rstrip("."), now_utc())
        self._set_aside.append(entry)
        with contextlib.suppress(CannotStore):  # the next start finds the row again
            self._write(_note(entry), (f"DELETE FROM {kind}s WHERE rowid = ?", (rowid,)))


def identities(*paths: Path) -> dict[Path, tuple[int, int] | None]:
    """Return what distinguishes a file or folder from any other that takes its name; None where there is none."""
    found: dict[Path, tuple[int, int] | None] = dict.fromkeys(paths)
    for path in paths:
        with contextlib.suppress(OSError):
            state = path.stat()
            found[path] = state.st_dev, state.st_ino
    return found


def stamp(path: Path) -> tuple[int, int, int] | None:
    """Return what changes whenever a file or folder does; None if there is none."""
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_ino, state.st_size, state.st_mtime_ns


def _claim(data_dir: Path) -> FileLock:
    """The lock of a data directory, held until it is released or this process ends."""
    lock = FileLock(data_dir / "service.lock", blocking=False, thread_local=False)
    with storing(data_dir):
        data_dir.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout as error:
            raise DataDirectoryInUse(data_dir) from error
    return lock


def _note(entry: SetAside) -> Statement:
    """What stores an entry; halves of characters, which no database takes, are spelled out."""
    values = tuple(text.encode("utf-8", "backslashreplace").decode() for text in astuple(entry))
    return "INSERT INTO set_aside (kind, id, row, reason, at) VALUES (?, ?, ?, ?, ?)", values


# Rows: what is written for scenes and jobs, and what is checked when it is read again


@dataclass(frozen=True, slots=True)
class SetAside:
    """Something stored that makes no sense to this version, and was moved out of the way.

    Attributes:
        kind: "scene", "job" or "database".
        id: identifier, or the name that a whole file has now; empty if that was missing.
        row: all that was stored, as JSON; empty for a file.
        reason: why it makes no sense.
        at: UTC, ISO 8601.
    """

    kind: str
    id: str
    row: str
    reason: str
    at: str

    @property
    def sentence(self) -> str:
        """What happened, for people."""
        if self.kind == "database":
            then = f"it is named {self.id} now" if self.id else "scenes and jobs are gone"
            return f"{FILE} cannot be used: {self.reason}; {then}, and an empty one took its place."
        return f"The stored {self.kind} {shown(self.id)} makes no sense and was set aside: {self.reason}."


class _Scene(Entry):
    id: Text
    seed: _Count
    created_at: Text
    image_size: int
    initial: StateJson
    state: StateJson
    time_s: Annotated[FiniteFloat, Field(ge=0)]
    revision: _Count


def _scene_row(record: SceneRecord) -> tuple[Any, ...]:
    """The values of a scene in the order of the columns."""
    initial, state = (json.dumps(state_to_json(each)) for each in (record.initial, record.state))
    return record.id, record.seed, record.created_at, record.image_size, initial, state, record.time_s, record.revision


def _scene_of_row(row: Mapping[str, Any]) -> SceneRecord:
    """The scene in a row, by the names of the columns.

    Raises:
        ValueError, TypeError, RecursionError: if it makes no sense.
    """
    texts = {name: json.loads(row[name]) for name in ("initial", "state")}
    entry = decode(_Scene, {**row, **texts}, "scene")
    initial, state = entry.initial.state(), entry.state.state()
    if initial.names != state.names:
        raise InvalidInput("list of objects", ", ".join(state.names), f"as it began: {', '.join(initial.names)}")
    size = image_side(entry.image_size)
    return SceneRecord(entry.id, entry.seed, entry.created_at, size, initial, state, entry.time_s, entry.revision)


def _job_of_row(text: str, job: str | None = None) -> dict[str, Any]:
    """The fields of a job in a row, such that they can be sent to pages.

    Args:
        text: that was stored.
        job: identifier of the row, if it has one.

    Raises:
        ValueError, TypeError, RecursionError: if they make no sense.
    """
    fields = json.loads(text)
    if not isinstance(fields, dict):
        raise InvalidInput("job", shown(fields), "a JSON object")
    if job is not None and fields.get("id", job) != job:
        raise InvalidInput("id", shown(fields["id"]), f"that of its row, {shown(job)}")
    json.dumps(fields, allow_nan=False, ensure_ascii=False).encode()  # neither NaN nor halves of characters
    return fields


# The file: opened whatever state it is in, brought to this version, or put aside


def check_database(path: Path) -> int:
    """Return the version of a database file; 0 if there is none.

    Raises:
        UnusableDatabase: if it is damaged or has no bytes, or a newer version wrote it.
        CorruptFile: if it is another program's.
        CannotStore: if it cannot be opened.
    """
    if stamp(path) is not None and path.stat().st_size == 0:  # opened, it would be a new one, and its log deleted
        raise UnusableDatabase(path, "empty", "it is empty")
    try:
        with contextlib.closing(sqlite3.connect(path)) as database:
            version = database.execute("PRAGMA user_version").fetchone()[0]
            owner = database.execute("PRAGMA application_id").fetchone()[0]
            if database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0:
                return 0
            if owner != _APPLICATION_ID:
                raise CorruptFile(path, "it is another program's database; move it away")
            if version > SCHEMA_VERSION:
                formats = f"format {version}, this one knows {SCHEMA_VERSION}"
                raise UnusableDatabase(path, f"newer-{version}", f"a newer version wrote it ({formats})")
            if version < 1 or not _is_sound(database):
                raise UnusableDatabase(path, "damaged", "it is damaged")
            return version
    except sqlite3.OperationalError as error:
        raise CannotStore(path, str(error)) from error
    except sqlite3.DatabaseError as error:
        raise UnusableDatabase(path, "damaged", "it is damaged") from error


def open_database(path: Path) -> sqlite3.Connection:
    """A connection to a database of this version, which is made or migrated if need be.

    Raises:
        UnusableDatabase: if it is damaged, or a newer version wrote it.
        CorruptFile: if it is another program's.
        CannotStore: if it cannot be written.
    """
    version = check_database(path)
    with storing(path):
        if 0 < version < SCHEMA_VERSION:
            older = unused(path.with_name(f"{path.name}.format-{version}"))
            partial_copy = older.with_name(f".{older.name}.part")
            partial_copy.unlink(missing_ok=True)
            copy_database(path, partial_copy)
            put_in_place(partial_copy, older)
        return _migrated(path, version)


def put_aside(path: Path, label: str) -> Path:
    """Rename a database with what belongs to it, so that another one can take its place; returns its new name.

    Raises:
        CannotStore: if that is not allowed.
    """
    place = unused(path.with_name(f"{path.name}.{label}"))
    with storing(path):
        for suffix in ("-wal", "-shm", ""):  # beside a new file, the older one's log would be taken for its own
            part = path.with_name(path.name + suffix)
            if part.exists():
                part.rename(place.with_name(place.name + suffix))
        sync(path.parent)
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


def _is_sound(database: sqlite3.Connection) -> bool:
    if database.execute("PRAGMA quick_check").fetchone()[0] != "ok":
        return False
    try:
        for statement in _READ_BY_EVERY_VERSION:
            database.execute(statement)
    except sqlite3.OperationalError:  # no such table, or column
        return False
    return True


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
        database.execute("SELECT count(*) FROM sqlite_master").fetchone()  # the log is there from now on
    except BaseException:
        database.close()
        raise
    return database
