"""What outlives the service: scenes, jobs and job events, in one SQLite file of the data directory.

One process at a time: a lock file keeps a second service out, which would take the first one's jobs for dead.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import logging
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Literal

from pydantic import FiniteFloat, StrictInt

from app.processes.messages.scene_messages import SceneRecord
from app.storage.schema import SCHEMA_VERSION, open_database
from osfcore.errors import OsfError
from osfcore.geometry.states import SceneState
from osfcore.io.json_codec import Text, decode, encode
from osfcore.io.scene_file import StateJson

FILE = "service.sqlite3"
_log = logging.getLogger(__name__)


class DataDirectoryInUse(OsfError):
    """Another service works in the data directory."""

    def __init__(self, data_dir: Path) -> None:
        super().__init__(f"Another service uses the data directory {data_dir}; stop it or choose another one.")


class CannotStore(OsfError):
    """The data directory cannot be written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} cannot be written ({reason}); free some space or choose another data directory.")


def now_utc() -> str:
    """The time in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class Store:
    """The open database. Every method may be called from any thread.

    Args:
        data_dir: made if it does not exist.
        max_events: job events kept.

    Raises:
        DataDirectoryInUse: if another service has it.
        CorruptFile: if the file is another program's; it is left as it is.
        CannotStore: if the directory cannot be written.

    Attributes:
        problem: why the latest write failed, for people; None if it did not.
        oddities: what had to be put aside since the start, a sentence each.
    """

    def __init__(self, data_dir: Path, max_events: int = 1000) -> None:
        self._path = data_dir / FILE
        self._max_events = max_events
        self._lock = threading.Lock()
        self._lock_file = self._claim(data_dir)
        try:
            self._database, put_aside = self._open()
        except BaseException:
            self._lock_file.close()
            raise
        self.problem: str | None = None
        self.oddities: list[str] = [] if put_aside is None else [put_aside]

    def close(self) -> None:
        """Close the file and let others use the directory. Calling it again does nothing."""
        with self._lock:
            self._database.close()
            self._lock_file.close()

    @staticmethod
    def _claim(data_dir: Path) -> IO[str]:
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

    def _open(self) -> tuple[sqlite3.Connection, str | None]:
        try:
            return open_database(self._path)
        except (sqlite3.Error, OSError) as error:
            raise CannotStore(self._path, str(error)) from error

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                self._database.execute(begin)
                try:
                    yield self._database
                    self._database.execute("COMMIT")
                except BaseException:
                    if self._database.in_transaction:
                        self._database.execute("ROLLBACK")
                    raise
            except sqlite3.DatabaseError as error:
                raise CannotStore(self._path, str(error)) from error

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        try:
            with self._transaction("BEGIN IMMEDIATE") as database:
                yield database
        except CannotStore as error:
            self.problem = str(error)
            raise
        self.problem = None

    def probe(self) -> None:
        """Write something that changes nothing, to see whether the database can be written again."""
        with contextlib.suppress(CannotStore), self._writing() as database:
            database.execute("DELETE FROM events WHERE id < 0")
            database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    # Scenes

    def save_scene(self, record: SceneRecord) -> None:
        """Insert or update a scene."""
        row = (
            record.id,
            record.seed,
            record.created_at,
            record.image_size,
            json.dumps(encode(StateJson.of(record.initial))),
            json.dumps(encode(StateJson.of(record.state))),
            record.time_s,
            record.revision,
        )
        with self._writing() as database:
            database.execute(
                "INSERT INTO scenes (id, seed, created_at, image_size, initial, state, time_s, revision)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET state = excluded.state,"
                " time_s = excluded.time_s, revision = excluded.revision",
                row,
            )

    def delete_scene(self, scene: str) -> None:
        """Forget a scene."""
        with self._writing() as database:
            database.execute("DELETE FROM scenes WHERE id = ?", (scene,))

    def set_current(self, scene: str | None) -> None:
        """Remember which scene is shown."""
        with self._writing() as database:
            database.execute("UPDATE scenes SET is_current = (id IS ?)", (scene,))

    def scenes(self) -> tuple[tuple[SceneRecord, ...], str | None]:
        """All scenes, oldest first, and the one that is shown; rows that make no sense are set aside."""
        with self._transaction("BEGIN") as database:
            rows = database.execute(
                "SELECT id, seed, created_at, image_size, initial, state, time_s, revision, is_current"
                " FROM scenes ORDER BY created_at, rowid"
            ).fetchall()
        records = []
        for row in rows:
            try:
                records.append(_record_from_row(row))
            except (TypeError, ValueError, RecursionError) as error:
                self.set_aside("scene", str(row[0]), str(error))
        return tuple(records), next((row[0] for row in rows if row[8]), None)

    # Jobs and events

    def save_job(self, job: str, number: int, fields: dict[str, Any], event: dict[str, Any] | None = None) -> int:
        """Insert or update a job, and remember how it was, both or neither.

        Args:
            job: identifier.
            number: orders the jobs; an update leaves it.
            fields: as JSON.
            event: as in `add_event`; None for no event.

        Returns:
            The event's number; 0 without an event.

        Raises:
            CannotStore: if the disk is full.
        """
        with self._writing() as database:
            database.execute(
                "INSERT INTO jobs VALUES (?, ?, ?) ON CONFLICT (id) DO UPDATE SET job = excluded.job",
                (job, number, json.dumps(fields)),
            )
            return 0 if event is None else self._add_event(database, event)

    def jobs(self) -> tuple[tuple[int, dict[str, Any]], ...]:
        """Numbers and fields of all jobs, oldest first; rows that are no JSON objects are set aside."""
        with self._transaction("BEGIN") as database:
            rows = database.execute("SELECT id, number, job FROM jobs ORDER BY number").fetchall()
        jobs = []
        for job, number, text in rows:
            try:
                jobs.append((int(number), _fields(text)))
            except (TypeError, ValueError, RecursionError) as error:
                self.set_aside("job", str(job), str(error))
        return tuple(jobs)

    def forget_job(self, job: str) -> int:
        """Delete a job with its events; returns the number of the event that says so.

        Raises:
            CannotStore: if the disk refuses; then nothing is deleted.
        """
        its_id = "CASE WHEN json_valid(job) THEN json_extract(job, '$.id') END"
        with self._writing() as database:
            database.execute("DELETE FROM jobs WHERE id = ?", (job,))
            database.execute(f"DELETE FROM events WHERE {its_id} = ?", (job,))
            return self._add_event(database, {"forgotten": job})

    def add_event(self, fields: dict[str, Any]) -> int:
        """Remember how a job was; returns the event's number. Old events are dropped."""
        with self._writing() as database:
            return self._add_event(database, fields)

    def _add_event(self, database: sqlite3.Connection, fields: dict[str, Any]) -> int:
        number = database.execute("INSERT INTO events (job) VALUES (?)", (json.dumps(fields),)).lastrowid or 0
        database.execute("DELETE FROM events WHERE id <= ?", (number - self._max_events,))
        return number

    def events_after(self, number: int) -> tuple[tuple[int, dict[str, Any]], ...]:
        """Events later than `number`, as far as they are kept and make sense, in order."""
        with self._transaction("BEGIN") as database:
            rows = database.execute("SELECT id, job FROM events WHERE id > ? ORDER BY id", (number,)).fetchall()
        events = []
        for event, text in rows:
            with contextlib.suppress(TypeError, ValueError, RecursionError):
                events.append((event, _fields(text)))
        return tuple(events)

    def set_aside(self, kind: Literal["scene", "job"], name: str, reason: str) -> None:
        """Move a row that makes no sense to where nobody reads it, and tell of it.

        Args:
            kind: which table it is in.
            name: identifier of the row.
            reason: why it makes no sense.
        """
        sentence = f"A stored {kind} ({name[:40]}) makes no sense to this version and was set aside: {reason[:200]}"
        self.oddities.append(sentence)
        _log.warning("%s", sentence)
        table = {"scene": "scenes", "job": "jobs"}[kind]
        with contextlib.suppress(CannotStore), self._writing() as database:  # else the next start tries again
            cursor = database.execute(f"SELECT * FROM {table} WHERE id = ?", (name,))
            names = [column[0] for column in cursor.description]
            for row in cursor.fetchall():
                text = json.dumps(dict(zip(names, row, strict=True)), default=repr)
                database.execute("INSERT INTO set_aside VALUES (?, ?, ?, ?, ?)", (kind, name, text, reason, now_utc()))
            database.execute(f"DELETE FROM {table} WHERE id = ?", (name,))


def _fields(text: str) -> dict[str, Any]:
    fields = json.loads(text)
    if not isinstance(fields, dict):
        raise TypeError("it is no JSON object")
    return fields


@dataclass(frozen=True, slots=True)
class _SceneRow:
    id: Text
    seed: StrictInt
    created_at: Text
    image_size: StrictInt
    time_s: FiniteFloat
    revision: StrictInt


def _record_from_row(row: tuple[Any, ...]) -> SceneRecord:
    scene, seed, created_at, image_size, initial, state, time_s, revision, _ = row
    facts = (scene, seed, created_at, image_size, time_s, revision)
    names = (field.name for field in dataclasses.fields(_SceneRow))
    checked = decode(_SceneRow, dict(zip(names, facts, strict=True)), "scene")
    return SceneRecord(**dataclasses.asdict(checked), initial=_state_from_json(initial), state=_state_from_json(state))


def _state_from_json(text: str) -> SceneState:
    return decode(StateJson, json.loads(text), "state").state()
