"""What outlives the service: scenes, jobs and job events, in one SQLite file of the data directory.

One process at a time: a lock file keeps a second service out, which would take the first one's jobs for dead.
What was accepted is on the disk before its caller hears of it. What has happened anyway, such as a push, is remembered
while the disk refuses, and written with the next write or `retry` that it takes.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import sqlite3
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from app.processes.messages.scene_messages import SceneRecord
from app.storage.rows import SCENE_COLUMNS, SENSELESS, SetAside, job_of_row, scene_of_row, scene_row, set_aside_row
from app.storage.schema import FILE, SCHEMA_VERSION, CannotStore, UnusableDatabase, open_database, put_aside
from osfcore.errors import OsfError
from osfcore.io.json_codec import decode

Statement = tuple[str, tuple[Any, ...]]
_log = logging.getLogger(__name__)


class DataDirectoryInUse(OsfError):
    """Another service works in the data directory."""

    def __init__(self, data_dir: Path) -> None:
        super().__init__(f"Another service uses the data directory {data_dir}; stop it or choose another one.")


def now_utc() -> str:
    """The time in UTC, ISO 8601 with milliseconds."""
    return utc_of(datetime.now(UTC).timestamp())


def utc_of(seconds: float) -> str:
    """A moment since the epoch [s] in the same form."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def check_data_dir(data_dir: Path) -> None:
    """Tell now what would keep a `Store` from opening; a file that it would put aside is left to it.

    Raises:
        DataDirectoryInUse, CorruptFile, CannotStore: as `Store`.
    """
    with _claim(data_dir), contextlib.suppress(UnusableDatabase):
        open_database(data_dir / FILE).close()


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
        self._lock_file = _claim(data_dir)
        try:
            self._database = self._open()
        except BaseException:
            self._lock_file.close()
            raise

    def close(self) -> None:
        """Close the file and let others use the directory. Calling it again does nothing."""
        self.retry()
        with self._lock:
            self._waiting.clear()
            self._database.close()
            self._lock_file.close()

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
        return number

    def _read(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._lock:
            try:
                return self._database.execute(sql, values).fetchall()
            except sqlite3.DatabaseError as error:
                raise CannotStore(Path(FILE), str(error)) from error

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
            f"INSERT INTO scenes ({', '.join(SCENE_COLUMNS)}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
            " ON CONFLICT (id) DO UPDATE SET state = excluded.state, time_s = excluded.time_s,"
            " revision = excluded.revision"
        )
        self._write((sql, scene_row(record)), waits_as=f"scene {record.id}" if can_wait else None)

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
            f"SELECT rowid, is_current, {', '.join(SCENE_COLUMNS)} FROM scenes ORDER BY created_at, rowid"
        ):
            row = dict(zip(SCENE_COLUMNS, values, strict=True))
            try:
                records.append(scene_of_row(row))
            except SENSELESS as error:
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
            event: how it is told of, as JSON; None for the fields.
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
                found.append((decode(int, number, "number"), parse(job_of_row(text, job))))
            except SENSELESS as error:
                self._put_aside("job", rowid, {"id": job, "number": number, "job": text}, error)
        return tuple(found)

    def events_after(self, number: int, parse: Callable[[dict[str, Any]], Any] = dict) -> tuple[tuple[int, Any], ...]:
        """Events later than `number`, as far as they are kept and `parse` understands them, in order."""
        found = []
        for event, text in self._read("SELECT id, job FROM events WHERE id > ? ORDER BY id", (number,)):
            with contextlib.suppress(*SENSELESS):
                found.append((event, parse(job_of_row(text))))
        return tuple(found)

    def _put_aside(self, kind: str, rowid: int, row: dict[str, Any], error: Exception) -> None:
        entry = SetAside(kind, str(row["id"]), json.dumps(row, default=repr), str(error).rstrip("."), now_utc())
        self._set_aside.append(entry)
        with contextlib.suppress(CannotStore):  # the next start finds the row again
            self._write(_note(entry), (f"DELETE FROM {kind}s WHERE rowid = ?", (rowid,)))


def _claim(data_dir: Path) -> IO[str]:
    """The lock file of a data directory, held until it is closed."""
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
        file = (data_dir / "service.lock").open("w")
    except OSError as error:
        raise CannotStore(data_dir, error.strerror or str(error)) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise DataDirectoryInUse(data_dir) from error
    return file


def _note(entry: SetAside) -> Statement:
    return "INSERT INTO set_aside (kind, id, row, reason, at) VALUES (?, ?, ?, ?, ?)", set_aside_row(entry)
