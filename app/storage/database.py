"""What outlives the service: scenes, jobs and job events, in one SQLite file of the data directory.

One process at a time: a lock file keeps a second service out, which would take the first one's jobs for dead.
"""

from __future__ import annotations

import fcntl
import json
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from app.processes.messages.scene_messages import SceneRecord
from osfcore.errors import CorruptFile, OsfError
from osfcore.geometry.states import SceneState
from osfcore.io.json_codec import decode, encode
from osfcore.io.scene_file import StateJson

FILE = "service.sqlite3"
SCHEMA_VERSION = 1
_APPLICATION_ID = 0x4F534631  # "OSF1"
_SCHEMA = """
CREATE TABLE scenes (
    id TEXT PRIMARY KEY, seed INTEGER NOT NULL, created_at TEXT NOT NULL, image_size INTEGER NOT NULL,
    initial TEXT NOT NULL, state TEXT NOT NULL, time_s REAL NOT NULL, revision INTEGER NOT NULL,
    is_current INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER NOT NULL, job TEXT NOT NULL);
CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL);
"""


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
        CorruptFile: if the file is damaged, not ours, or a newer version's; it is left as it is.
        CannotStore: if the directory cannot be written.
    """

    def __init__(self, data_dir: Path, max_events: int = 1000) -> None:
        self._path = data_dir / FILE
        self._max_events = max_events
        self._lock = threading.Lock()
        self._lock_file = self._claim(data_dir)
        try:
            self._database = self._open()
        except BaseException:
            self._lock_file.close()
            raise

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

    def _open(self) -> sqlite3.Connection:
        database = sqlite3.connect(self._path, check_same_thread=False, isolation_level=None)
        try:
            version = database.execute("PRAGMA user_version").fetchone()[0]
            owner = database.execute("PRAGMA application_id").fetchone()[0]
            tables = database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            if tables and owner != _APPLICATION_ID:
                raise CorruptFile(self._path, "it is another program's database; move it away")
            if version > SCHEMA_VERSION:
                formats = f"format {version}, this one knows {SCHEMA_VERSION}"
                raise CorruptFile(self._path, f"a newer version wrote it ({formats}); update, or move it away")
            if tables and database.execute("PRAGMA quick_check").fetchone()[0] != "ok":
                raise CorruptFile(self._path, "it is damaged; move it away to start with an empty one")
            database.execute("PRAGMA journal_mode = WAL")
            database.execute("PRAGMA synchronous = NORMAL")
            if not tables:
                database.executescript(
                    f"BEGIN; PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
                    f"{_SCHEMA} COMMIT;"
                )
        except sqlite3.OperationalError as error:
            database.close()
            raise CannotStore(self._path, str(error)) from error
        except sqlite3.DatabaseError as error:
            database.close()
            raise CorruptFile(self._path, "it is damaged; move it away to start with an empty one") from error
        except BaseException:
            database.close()
            raise
        return database

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                self._database.execute("BEGIN IMMEDIATE")
                try:
                    yield self._database
                except BaseException:
                    self._database.execute("ROLLBACK")
                    raise
                self._database.execute("COMMIT")
            except sqlite3.DatabaseError as error:
                raise CannotStore(self._path, str(error)) from error

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
        with self._transaction() as database:
            database.execute(
                "INSERT INTO scenes (id, seed, created_at, image_size, initial, state, time_s, revision)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET state = excluded.state,"
                " time_s = excluded.time_s, revision = excluded.revision",
                row,
            )

    def delete_scene(self, scene: str) -> None:
        """Forget a scene."""
        with self._transaction() as database:
            database.execute("DELETE FROM scenes WHERE id = ?", (scene,))

    def set_current(self, scene: str | None) -> None:
        """Remember which scene is shown."""
        with self._transaction() as database:
            database.execute("UPDATE scenes SET is_current = (id IS ?)", (scene,))

    def scenes(self) -> tuple[tuple[SceneRecord, ...], str | None]:
        """All scenes, oldest first, and the one that is shown.

        Raises:
            CorruptFile: if a row makes no sense.
        """
        with self._transaction() as database:
            rows = database.execute(
                "SELECT id, seed, created_at, image_size, initial, state, time_s, revision, is_current"
                " FROM scenes ORDER BY created_at, rowid"
            ).fetchall()
        try:
            records = tuple(_record_from_row(row) for row in rows)
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptFile(self._path, f"a stored scene makes no sense ({error})") from error
        return records, next((row[0] for row in rows if row[8]), None)

    # Jobs and events

    def save_job(self, job: str, number: int, fields: dict[str, Any]) -> None:
        """Insert or update a job.

        Args:
            job: identifier.
            number: orders the jobs; an update leaves it.
            fields: as JSON.

        Raises:
            CannotStore: if the disk is full.
        """
        with self._transaction() as database:
            database.execute(
                "INSERT INTO jobs VALUES (?, ?, ?) ON CONFLICT (id) DO UPDATE SET job = excluded.job",
                (job, number, json.dumps(fields)),
            )

    def jobs(self) -> tuple[tuple[int, dict[str, Any]], ...]:
        """Numbers and fields of all jobs, oldest first."""
        with self._transaction() as database:
            rows = database.execute("SELECT number, job FROM jobs ORDER BY number").fetchall()
        return tuple((number, json.loads(text)) for number, text in rows)

    def forget_job(self, job: str) -> int:
        """Delete a job with its events; returns the number of the event that says so.

        Raises:
            CannotStore: if the disk refuses; then nothing is deleted.
        """
        with self._transaction() as database:
            database.execute("DELETE FROM jobs WHERE id = ?", (job,))
            database.execute("DELETE FROM events WHERE json_extract(job, '$.id') = ?", (job,))
            fields = json.dumps({"forgotten": job})
            return database.execute("INSERT INTO events (job) VALUES (?)", (fields,)).lastrowid or 0

    def add_event(self, fields: dict[str, Any]) -> int:
        """Remember how a job was; returns the event's number. Old events are dropped."""
        with self._transaction() as database:
            number = database.execute("INSERT INTO events (job) VALUES (?)", (json.dumps(fields),)).lastrowid or 0
            database.execute("DELETE FROM events WHERE id <= ?", (number - self._max_events,))
        return number

    def events_after(self, number: int) -> tuple[tuple[int, dict[str, Any]], ...]:
        """Events later than `number`, as far as they are kept, in order."""
        with self._transaction() as database:
            rows = database.execute("SELECT id, job FROM events WHERE id > ? ORDER BY id", (number,)).fetchall()
        return tuple((event, json.loads(text)) for event, text in rows)


def _record_from_row(row: tuple[Any, ...]) -> SceneRecord:
    scene, seed, created_at, image_size, initial, state, time_s, revision, _ = row
    return SceneRecord(
        scene, seed, created_at, image_size, _state_from_json(initial), _state_from_json(state), time_s, revision
    )


def _state_from_json(text: str) -> SceneState:
    return decode(StateJson, json.loads(text), "state").state()
