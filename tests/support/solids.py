"""Fields that need no training: boxes and cylinders of known colour in place of real objects, and the exact table."""

from pathlib import Path

import numpy as np

from osfcore.fields.field_library import FIELD_FILE, TABLE_NAME, FieldLibrary
from osfcore.fields.kiloosf import without_light, write_field
from osfcore.fields.table import TableField, write_table
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.render.reference import solid_field
from osfcore.world.imaging import BACKGROUND_RADIANCE, TABLE_ALBEDO

SOLIDS = ("003_cracker_box", "005_tomato_soup_can", "009_gelatin_box")


def exact_table() -> TableField:
    """What the simulator's table sends out."""
    f = np.float32
    return TableField(
        half_side=TABLE_SIDE_M / 2,
        albedo=np.broadcast_to(f(TABLE_ALBEDO), (2, 2, 3)).copy(),
        ambient=np.full(3, AMBIENT, f),
        background=np.array(BACKGROUND_RADIANCE, f),
        w1=np.zeros((3, 1), f),
        b1=np.ones(1, f),
        w2=np.full((1, 3), DIFFUSE, f),
        b2=np.zeros(3, f),
    )


def solid(half: np.ndarray, *, is_round: bool, voxel: float = 0.004, albedo=(0.5, 0.4, 0.3)):
    """A box, or a cylinder about y or z, whichever fits the half sizes."""
    axis = 2 if abs(half[0] - half[1]) < abs(half[0] - half[2]) else 1
    across = [i for i in range(3) if i != axis]

    def depths(x):
        return np.stack([np.hypot(x[..., across[0]], x[..., across[1]]) - half[0], np.abs(x[..., axis]) - half[axis]])

    def depth(x):
        return -depths(x).max(axis=0) if is_round else (half - np.abs(x)).min(axis=-1)

    def normal(x):
        if not is_round:
            nearest = np.eye(3)[np.argmin(half - np.abs(x), axis=-1)]
            return nearest * np.sign(x)
        wall = x * (1 - np.eye(3)[axis])
        wall = wall / np.maximum(np.linalg.norm(wall, axis=-1, keepdims=True), 1e-9)
        is_cap = depths(x).argmax(axis=0)[..., None] == 1
        return np.where(is_cap, np.eye(3)[axis] * np.sign(x), wall)

    return solid_field(depth, normal, half, albedo, voxel=voxel, hidden=16)


def write_fields(data_dir: Path, library: AssetLibrary) -> None:
    """Put solids in the place of three objects' fields, and the table, into DATA_DIR/fields."""
    for name in SOLIDS:
        path = data_dir / "fields" / name / FIELD_FILE
        path.parent.mkdir(parents=True)
        write_field(path, solid(library.size_m(name) / 2, is_round="can" in name))
        path.with_suffix(".json").write_text('{"minutes": 1.5}')
    write_table(data_dir / "fields" / TABLE_NAME / FIELD_FILE, exact_table())


def write_nerfs(data_dir: Path) -> None:
    """Put the shipped fields of the three objects, made blind for light, into DATA_DIR/nerf/fields."""
    for name in SOLIDS:
        path = data_dir / "nerf" / "fields" / name / FIELD_FILE
        path.parent.mkdir(parents=True)
        write_field(path, without_light(FieldLibrary(None).load(name)))
