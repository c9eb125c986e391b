"""Which method is asked for, and which objects have a field as published. Nothing here loads torch."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Literal, get_args

from osfcore.errors import UnknownName

Method = Literal["ours", "paper"]
METHODS: tuple[Method, ...] = get_args(Method)
_FOLDER = "paper_fields"


def own_field_path(name: str, data_dir: Path) -> Path:
    """Return where a KiloOSF as published that this machine trained lies: DATA_DIR/paper_fields/NAME.safetensors."""
    return data_dir / _FOLDER / f"{name}.safetensors"


def paper_field_path(name: str, data_dir: Path | None) -> Path:
    """Return where an object's KiloOSF as published lies: that trained on this machine, else the package's.

    Raises:
        UnknownName: if there is none.
    """
    for folder in _field_folders(data_dir):
        path = folder / f"{name}.safetensors"
        if path.is_file():
            return path
    raise UnknownName("field as published", name, paper_field_names(data_dir))


def paper_field_names(data_dir: Path | None) -> tuple[str, ...]:
    """Return the objects with a KiloOSF as published, in order."""
    return tuple(sorted({path.stem for folder in _field_folders(data_dir) for path in folder.glob("*.safetensors")}))


def _field_folders(data_dir: Path | None) -> tuple[Path, ...]:
    """Return where to look, in this order."""
    shipped = Path(str(files("osfcore.paper") / "shipped" / "fields"))
    return (shipped,) if data_dir is None else (data_dir / _FOLDER, shipped)
