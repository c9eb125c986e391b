"""Fields that need no training: the world's table as it is, and matte boxes."""

from pathlib import Path

import numpy as np

from osfcore.fields.field_library import FIELD_FILE
from osfcore.fields.kiloosf import write_field
from osfcore.fields.table import TableField, write_table
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.render.reference import solid_field
from osfcore.world.imaging import BACKGROUND_RADIANCE, TABLE_ALBEDO


def write_exact_table(data_dir: Path) -> None:
    """The table as the simulator draws it."""
    f = np.float32
    table = TableField(
        TABLE_SIDE_M / 2,
        np.tile(np.array(TABLE_ALBEDO, f), (2, 2, 1)),
        np.full(3, AMBIENT, f),
        np.array(BACKGROUND_RADIANCE, f),
        np.zeros((3, 4), f),
        np.zeros(4, f),
        np.zeros((4, 3), f),
        np.full(3, DIFFUSE, f),
    )
    folder = data_dir / "fields" / "table"
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / FIELD_FILE, table)


def write_box(data_dir: Path, name: str, size_m: np.ndarray, albedo: tuple[float, float, float]) -> None:
    """A matte box in place of an object."""
    half = np.asarray(size_m, float) / 2

    def depth(x: np.ndarray) -> np.ndarray:
        return (half - np.abs(x)).min(axis=-1)

    def normal(x: np.ndarray) -> np.ndarray:
        side = (half - np.abs(x)).argmin(axis=-1)
        return np.sign(x) * np.eye(3)[side]

    folder = data_dir / "fields" / name
    folder.mkdir(parents=True, exist_ok=True)
    write_field(folder / FIELD_FILE, solid_field(depth, normal, half, albedo, voxel=0.004, hidden=8))
