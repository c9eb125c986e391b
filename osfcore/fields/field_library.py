"""The fields on this machine: those trained here come before those that ship with the package."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.kiloosf import KiloOSF, read_field
from osfcore.fields.table import TableField, read_table

TABLE_NAME = "table"
FIELD_FILE = "field.safetensors"
METRICS_FILE = "field.json"
_SUFFIX = ".safetensors"
_QUALITY = ("psnr_full", "psnr_mask", "psnr", "test_images", "train_images")
_NUMBERS = (*_QUALITY, "bytes", "minutes", "iterations", "seed", "threads")
_WORDS = ("device", "data", "command", "machine")
_LARGEST = 2**63
_MOST_CHARACTERS = 1000


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """Facts about one field.

    Attributes:
        name: name of its object.
        source: "shipped" with the package or "trained" on this machine.
        path: file of its weights.
        bytes: size of that file.
        metrics: measurements from its training, as plain numbers and words; empty if they are not known.
    """

    name: str
    source: Literal["shipped", "trained"]
    path: Path
    bytes: int
    metrics: Mapping[str, Any]


class FieldLibrary:
    """Trained fields on this machine: those in DATA_DIR/fields/NAME, then those that ship with the package.

    Args:
        data_dir: folder that may hold fields/NAME/field.safetensors and field.json; None for the shipped fields only.
        shipped: folder with NAME.safetensors and NAME.json; the package's own by default.

    Example:
        >>> fields = FieldLibrary(None)
        >>> fields.has("006_mustard_bottle")
        True
    """

    def __init__(self, data_dir: Path | None, *, shipped: Path | None = None) -> None:
        self._trained = None if data_dir is None else data_dir / "fields"
        self._shipped = shipped or Path(str(files("osfcore.fields") / "shipped"))

    def __eq__(self, other: object) -> bool:
        """Return whether both look into the same folders."""
        return isinstance(other, FieldLibrary) and self._folders() == other._folders()

    def __hash__(self) -> int:
        """Hash the folders."""
        return hash(self._folders())

    def _folders(self) -> tuple[Path | None, Path]:
        return self._trained, self._shipped

    def stamp(self, name: str) -> tuple[int, int] | None:
        """Return a value that changes when the field is trained or deleted; None for a shipped field."""
        if self._trained is None:
            return None
        try:
            status = (self._trained / name / FIELD_FILE).stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size

    def folder(self, name: str) -> Path:
        """Return the folder that a trained field of this name belongs in.

        Raises:
            UnknownName: if this library has no data directory.
        """
        if self._trained is None:
            raise UnknownName("folder for field", name, ())
        return self._trained / name

    def names(self) -> tuple[str, ...]:
        """Return the names of all objects with a field, sorted."""
        shipped = {path.stem for path in self._shipped.glob(f"*{_SUFFIX}")} - {TABLE_NAME}
        trained = set()
        if self._trained is not None and self._trained.is_dir():
            trained = {path.parent.name for path in self._trained.glob(f"*/{FIELD_FILE}")} - {TABLE_NAME}
        return tuple(sorted(name for name in shipped | trained if name.isprintable()))

    def has(self, name: str) -> bool:
        """Return whether an object has a field."""
        return name in self.names()

    def info(self, name: str) -> FieldInfo:
        """Return facts about a field without loading it.

        Raises:
            UnknownName: if the object has no field.
        """
        if not self.has(name):
            raise UnknownName("field", name, self.names())
        try:
            return self._info(name)
        except FileNotFoundError:  # it has just been deleted
            raise UnknownName("field", name, self.names()) from None

    def _info(self, name: str) -> FieldInfo:
        path = None if self._trained is None else self._trained / name / FIELD_FILE
        if path is not None and path.is_file():
            return FieldInfo(name, "trained", path, path.stat().st_size, _metrics(path.with_name(METRICS_FILE)))
        path = self._shipped / f"{name}{_SUFFIX}"
        return FieldInfo(name, "shipped", path, path.stat().st_size, _metrics(path.with_suffix(".json")))

    def load(self, name: str) -> KiloOSF:
        """Load the field of an object.

        Raises:
            UnknownName: if the object has no field.
            CorruptFile: if its file is broken.
        """
        return read_field(self.info(name).path)

    def load_table(self) -> TableField:
        """Load the field of the table: that in DATA_DIR/fields/table, or else the shipped one.

        Raises:
            CorruptFile: if its file is broken.
        """
        try:
            path = self._info(TABLE_NAME).path
        except OSError as error:
            raise CorruptFile(self._shipped / f"{TABLE_NAME}{_SUFFIX}", "the package lacks its table") from error
        return read_table(path)


def _metrics(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return {key: value for key, value in content.items() if _is_metric(key, value)} if isinstance(content, dict) else {}


def _is_metric(key: str, value: object) -> bool:
    """Return whether it is a known figure or word that may be shown as it is."""
    if key in _NUMBERS and isinstance(value, int | float) and not isinstance(value, bool):
        return -_LARGEST <= value < _LARGEST  # not for NaN either
    if key in _WORDS and isinstance(value, str):
        return value.isprintable() and len(value) <= _MOST_CHARACTERS
    return key == "hollow" and isinstance(value, bool)
