"""The table as a field: the radiance of the plane z = 0 under a distant light, learned from images.

    radiance(x, y, l) = albedo(x, y) * (ambient + l_z * network(l))

The direct part has the factor l_z, so that it vanishes for a light in the table's plane. This separates it from the
ambient part, although no training image shows a shadow. Shadows remove the direct part.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from safetensors.numpy import save

from osfcore.errors import CorruptFile, shown
from osfcore.fields.kiloosf import Tensors, read_tensors, tensors_from_bytes
from osfcore.io.files import write_atomically

TABLE_FORMAT = "table-1"
_ARRAYS = ("albedo", "ambient", "background", "w1", "b1", "w2", "b2")


@dataclass(frozen=True, eq=False, slots=True)
class TableField:
    """The field of the bare table.

    Attributes:
        half_side: the table covers |x|, |y| <= half_side [m].
        albedo: reflectance on a regular grid over the table, x by y, interpolated.
        ambient: radiance of an unlit white point.
        background: radiance beyond the table's edge.
        w1, b1, w2, b2: weights of the network from the light's direction to the direct light per unit of l_z.
    """

    half_side: float
    albedo: Float32[np.ndarray, "g g 3"]
    ambient: Float32[np.ndarray, "3"]
    background: Float32[np.ndarray, "3"]
    w1: Float32[np.ndarray, "3 H"]
    b1: Float32[np.ndarray, "H"]
    w2: Float32[np.ndarray, "H 3"]
    b2: Float32[np.ndarray, "3"]

    def direct(self, lights: Float[np.ndarray, "B 3"]) -> Float32[np.ndarray, "B 3"]:
        """Return the direct light on an unshaded white point of the table under each light."""
        hidden = np.maximum(lights.astype(np.float32) @ self.w1 + self.b1, 0)
        return np.maximum(hidden @ self.w2 + self.b2, 0) * np.maximum(lights[:, 2:], 0).astype(np.float32)


def write_table(path: Path, table: TableField) -> None:
    """Write a table. The file appears only once it is complete.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, table_bytes(table))


def table_bytes(table: TableField) -> bytes:
    """Return a table as the contents of a file."""
    tensors = {name: getattr(table, name) for name in _ARRAYS}
    return save({**tensors, "half_side": np.array([table.half_side])}, metadata={"format": TABLE_FORMAT})


def read_table(path: Path) -> TableField:
    """Read a table.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or not a table.
    """
    return _table(read_tensors(path, TABLE_FORMAT), path)


def table_from_bytes(data: bytes, where: Path | str) -> TableField:
    """Return the table in the contents of a file.

    Args:
        data: contents, as `table_bytes` returns them.
        where: name of the file in messages.

    Raises:
        CorruptFile: if the data are truncated, of another version or not a table.
    """
    return _table(tensors_from_bytes(data, TABLE_FORMAT, where), where)


def _table(content: Tensors, path: Path | str) -> TableField:
    _, tensors = content
    try:
        arrays = {name: tensors[name].astype(np.float32) for name in _ARRAYS}
        half_side = float(tensors["half_side"].reshape(-1)[0])
        hidden, side = arrays["b1"].size, len(arrays["albedo"])
    except (KeyError, IndexError, TypeError) as error:
        raise CorruptFile(path, f"it is not a sound table ({shown(error)})") from error
    shapes = {"ambient": (3,), "background": (3,), "w1": (3, hidden), "b1": (hidden,), "w2": (hidden, 3), "b2": (3,)}
    shapes["albedo"] = (max(side, 2), max(side, 2), 3)
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.all(np.isfinite(arrays[name])):
            raise CorruptFile(path, f"{name} has shape {arrays[name].shape} or values that are not finite")
    if not 0 < half_side < 1e6:
        raise CorruptFile(path, f"half_side is {half_side}")
    return TableField(half_side=half_side, **arrays)
