"""Backups: what is worth keeping of a data directory in one zip, made while a service works there, and put back.

The zip holds the database as it was at one moment, then the folders, and `manifest.json`. Downloads, which can be had
again, lock files and whatever is hidden because it is half-made stay out.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import zipfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Literal

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError, shown
from osfcore.io.archives import ArchiveKind, unpack
from osfcore.io.files import file_at_once, folder_at_once, read_json, writing
from osfcore.io.json_codec import Entry, Text, decode
from osfcore.io.output_paths import check_place

from .database import FILE, SCHEMA_VERSION, CannotStore, check_database, copy_database, now_utc

FOLDERS = ("objects", "fields", "goals", "photos", "sets", "collections", "training", "dynamics", "paper_fields")
MANIFEST = "manifest.json"
_PROGRAM = "osf-manipulation"
_MOST_PARTS, _MOST_NAME_BYTES = 16, 200  # of a path, as unpacking takes it
_BACKUP = ArchiveKind(
    "backup",
    PurePosixPath(MANIFEST),
    (MANIFEST, FILE, *FOLDERS),
    "a zip that 'osf backup' wrote",
    max_depth=_MOST_PARTS,
)
_MAX_BYTES, _MAX_FILES = 1 << 40, 10_000_000  # a data directory has no bounds of its own
_CHUNK_BYTES = 1 << 20


class Manifest(Entry):
    """What a backup holds."""

    program: Literal["osf-manipulation"]
    version: Text
    schema_version: int
    created_at: Text
    files: int
    bytes: int


def back_up(data_dir: Path, out: Path) -> Manifest:
    """Write a backup, in the place of an older one if need be; a service may go on working meanwhile.

    Args:
        data_dir: of the service.
        out: FILE.zip.

    Raises:
        InvalidInput: if the name has another suffix, or a file has a name that no backup can keep.
        CorruptFile: if nothing is stored there, or the database cannot be used.
        CannotWrite: if the disk refuses; then nothing is left.
    """
    if out.suffix != ".zip":
        raise InvalidInput("backup file", out, "a path that ends in .zip")
    check_place(out)
    if not any((data_dir / name).exists() for name in (FILE, *FOLDERS)):
        raise CorruptFile(data_dir, "there is no such data directory, or nothing is stored there")
    database = out.with_name(f".{out.name}.{os.getpid()}.sqlite3")
    try:
        with writing(out):
            out.parent.mkdir(parents=True, exist_ok=True)
        # Not packed: images, weights and meshes hardly shrink.
        with file_at_once(out) as partial, zipfile.ZipFile(partial, "w") as archive:
            return _fill(archive, data_dir, database)
    except sqlite3.DatabaseError as error:
        raise CannotWrite(out, str(error)) from error
    finally:
        with contextlib.suppress(OSError):
            database.unlink(missing_ok=True)


def restore(archive: Path, data_dir: Path) -> Manifest:
    """Make a data directory from a backup, whole or not at all.

    Args:
        archive: that `back_up` wrote.
        data_dir: must not exist or be empty.

    Raises:
        InvalidInput: if there is something in the data directory.
        CorruptFile: if it is no backup, damaged, or a newer version wrote it.
        CannotWrite: if the disk refuses.
    """
    if os.path.lexists(data_dir) and (not data_dir.is_dir() or any(data_dir.iterdir())):
        raise InvalidInput(
            "data directory", data_dir, "a new or empty folder; name one with --data-dir, or move this one away"
        )
    data_dir = data_dir.resolve()  # a link to an empty folder is as good as the folder
    with folder_at_once(data_dir) as folder:
        unpack(archive, folder, _BACKUP, _MAX_BYTES, _MAX_FILES)
        manifest = _checked(archive, folder)
        with writing(data_dir):
            (folder / MANIFEST).unlink()
    return manifest


def _fill(archive: zipfile.ZipFile, data_dir: Path, database: Path) -> Manifest:
    """Write everything to an archive, the database by way of a temporary file."""
    sizes = []
    # The database comes first: what it names was complete by then. A job that comes later merely adds files.
    if (data_dir / FILE).exists():
        check_database(data_dir / FILE)
        copy_database(data_dir / FILE, database)
        sizes.append(_add(archive, database, FILE))
    for path in _files(data_dir):
        with contextlib.suppress(FileNotFoundError):  # deleted since the folder was listed
            sizes.append(_add(archive, path, _name(path.relative_to(data_dir))))
    manifest = Manifest(
        program=_PROGRAM,
        version=version(_PROGRAM),
        schema_version=SCHEMA_VERSION,
        created_at=now_utc(),
        files=len(sizes),
        bytes=sum(sizes),
    )
    archive.writestr(MANIFEST, manifest.model_dump_json(indent=1) + "\n")
    return manifest


def _files(data_dir: Path) -> Iterator[Path]:
    """Plain files that are worth keeping, in linked folders too; hidden ones are half-made.

    In each folder what describes the others (JSON) comes last: if it is being deleted meanwhile, no part of it counts.
    """
    seen: set[str] = set()  # folders: links may lead back to where they are

    def unless_gone(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise error

    for name in FOLDERS:
        for place, folders, names in os.walk(data_dir / name, onerror=unless_gone, followlinks=True):
            real = os.path.realpath(place)
            if real in seen:
                folders.clear()
                continue
            seen.add(real)
            folders[:] = sorted(folder for folder in folders if not folder.startswith("."))
            ordered = sorted(names, key=lambda file: (file.endswith(".json"), file))
            for path in (Path(place, file) for file in ordered if not file.startswith(".")):
                if path.is_file():
                    yield path


def _name(path: Path) -> str:
    """What a file is called in the archive; refused now if restoring would refuse it."""
    name = path.as_posix()
    is_short = len(path.parts) <= _MOST_PARTS and all(len(os.fsencode(part)) <= _MOST_NAME_BYTES for part in path.parts)
    if not is_short or not name.isprintable() or "\\" in name:
        raise InvalidInput("name of a stored file", shown(repr(name)), "short and printable; rename it")
    return name


def _add(archive: zipfile.ZipFile, path: Path, name: str) -> int:
    with path.open("rb") as source:
        info = zipfile.ZipInfo.from_file(path, name, strict_timestamps=False)
        with archive.open(info, "w", force_zip64=True) as sink:  # it may grow while it is read
            shutil.copyfileobj(source, sink, _CHUNK_BYTES)
    return info.file_size


def _checked(archive: Path, folder: Path) -> Manifest:
    """The manifest of an unpacked backup, in which all is as it says."""
    try:
        manifest = read_json(folder / MANIFEST, lambda data: decode(Manifest, data, "manifest"))
    except OsfError as error:
        raise CorruptFile(archive, "it is no backup; a zip that 'osf backup' wrote is expected") from error
    if manifest.schema_version > SCHEMA_VERSION:
        formats = f"format {manifest.schema_version}, this one knows {SCHEMA_VERSION}"
        raise CorruptFile(archive, f"a newer version wrote it ({formats}); update first")
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST]
    if (len(sizes), sum(sizes)) != (manifest.files, manifest.bytes):
        expected = f"{manifest.files} files of {manifest.bytes} bytes, but holds {len(sizes)} of {sum(sizes)}"
        raise CorruptFile(archive, f"it is damaged: it should hold {expected}")
    try:
        if (folder / FILE).exists():
            check_database(folder / FILE)
    except (CorruptFile, CannotStore) as error:
        raise CorruptFile(archive, "the database in it is damaged") from error
    return manifest
