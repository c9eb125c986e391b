"""The tables of the database, how older files become newer ones, and what is done with a file that cannot be used.

A service always starts. A file that is damaged or of a newer version is put aside under another name, whole, and an
empty one takes its place; whoever wants it back stops the service and gives it its name again.
"""

from __future__ import annotations

import contextlib
import itertools
import sqlite3
from pathlib import Path

from osfcore.errors import CorruptFile

_APPLICATION_ID = 0x4F534631  # "OSF1"
_BUSY_S = 2.0  # a backup may hold it for a moment; nobody else should
_SIDE_FILES = ("-wal", "-shm")
# The statement at place n leads from format n to format n + 1; none is ever changed.
MIGRATIONS = (
    """
CREATE TABLE scenes (
    id TEXT PRIMARY KEY, seed INTEGER NOT NULL, created_at TEXT NOT NULL, image_size INTEGER NOT NULL,
    initial TEXT NOT NULL, state TEXT NOT NULL, time_s REAL NOT NULL, revision INTEGER NOT NULL,
    is_current INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER NOT NULL, job TEXT NOT NULL);
CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL);
""",
    # Rows that make no sense to this version; kept for whoever can read them.
    "CREATE TABLE set_aside (kind TEXT NOT NULL, id TEXT NOT NULL, row TEXT NOT NULL, reason TEXT NOT NULL,"
    " at TEXT NOT NULL);",
)
SCHEMA_VERSION = len(MIGRATIONS)


class _Unusable(Exception):
    """A file that is put aside."""

    def __init__(self, suffix: str, reason: str) -> None:
        super().__init__(reason)
        self.suffix, self.reason = suffix, reason


def open_database(path: Path) -> tuple[sqlite3.Connection, str | None]:
    """The database of a file, brought to this version's format.

    Args:
        path: of the file; made if it does not exist.

    Returns:
        The connection, and a sentence if a file had to be put aside.

    Raises:
        CorruptFile: if the file is another program's; it is left as it is.
        sqlite3.OperationalError: if it cannot be read or written.
    """
    try:
        return _opened(path), None
    except _Unusable as error:
        aside = _put_aside(path, error.suffix)
        return _opened(path), (
            f"The database was put aside as {aside.name}, because {error.reason}; the service began with an empty one."
        )


def _opened(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, timeout=_BUSY_S, check_same_thread=False, isolation_level=None)
    try:
        version = _checked_version(database, path)
        database.execute("PRAGMA journal_mode = WAL")
        # What was answered is on the disk: with NORMAL a loss of power could take the last commits, jobs that were
        # accepted among them. It costs one fsync a commit, of which there are a few a second at most.
        database.execute("PRAGMA synchronous = FULL")
        if version < SCHEMA_VERSION:
            _migrate(database, path, version)
    except sqlite3.OperationalError:
        database.close()
        raise
    except sqlite3.DatabaseError as error:
        database.close()
        raise _Unusable("damaged", "it is damaged") from error
    except BaseException:
        database.close()
        raise
    return database


def _checked_version(database: sqlite3.Connection, path: Path) -> int:
    """The format of a file that can be used; 0 for an empty one."""
    version = database.execute("PRAGMA user_version").fetchone()[0]
    owner = database.execute("PRAGMA application_id").fetchone()[0]
    if not database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        return 0
    if owner != _APPLICATION_ID:
        raise CorruptFile(path, "it is another program's database; move it away")
    if version > SCHEMA_VERSION:
        raise _Unusable(f"format-{version}", f"a newer version of this program wrote it (format {version})")
    if database.execute("PRAGMA quick_check").fetchone()[0] != "ok":
        raise _Unusable("damaged", "it is damaged")
    return version


def _migrate(database: sqlite3.Connection, path: Path, version: int) -> None:
    """Bring a file to this version's format, all or nothing; what it was is kept beside it."""
    if version > 0:
        with contextlib.closing(sqlite3.connect(_free(path, f"format-{version}"))) as copy:
            database.backup(copy)
    steps = "".join(MIGRATIONS[version:])
    database.executescript(
        f"BEGIN IMMEDIATE; PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
        f"{steps} COMMIT;"
    )


def _put_aside(path: Path, suffix: str) -> Path:
    aside = _free(path, suffix)
    for side in _SIDE_FILES:  # first, so that none is left that would be taken for the new file's
        with contextlib.suppress(FileNotFoundError):
            path.with_name(path.name + side).rename(aside.with_name(aside.name + side))
    path.rename(aside)
    return aside


def _free(path: Path, suffix: str) -> Path:
    """A name beside the file that is not taken."""
    names = itertools.chain([f"{path.name}.{suffix}"], (f"{path.name}.{suffix}-{n}" for n in itertools.count(2)))
    return next(place for name in names if not (place := path.with_name(name)).exists())
