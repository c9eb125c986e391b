"""Convex parts of what is solid in a field, and the files that keep them.

The hull of a drill or a mug is no use for telling where it is touched. To cut a field into convex parts takes up to
half a minute, so the parts are kept in a file that says of which field they are.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy import ndimage

from osfcore.dynamics.shapes.object_shapes import SURFACE_G
from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import EMPTY_G, KiloOSF
from osfcore.geometry.convex_parts import convex_parts
from osfcore.io.files import write_atomically

FORMAT = "parts-1"
_INSIDE_G = 5.0  # deep inside, where no training says how dense it is
_SPECK = 0.02  # of the largest body: smaller ones are noise
_EDGE_G = 0.01  # by which corners are on their side of the surface at least

Parts = tuple[Float32[np.ndarray, "_ 3"], ...]


def field_parts(field: KiloOSF) -> Parts:
    """Corners of convex parts that together fill what is solid in a field [m]; none if it is as good as convex."""
    try:
        parts = convex_parts(*field_mesh(field))
    except InvalidInput:  # thinner than a voxel somewhere: its hull has to do
        return ()
    return parts if len(parts) > 1 else ()


def field_mesh(field: KiloOSF) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 3"]]:
    """The closed surface of what is solid in a field: vertices in the object's frame [m] and triangles.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    from skimage.measure import marching_cubes

    density = np.pad(field.density.astype(np.float32), 1, constant_values=EMPTY_G)
    solid = _without_specks(np.asarray(ndimage.binary_fill_holes(density > SURFACE_G)))
    density = np.where(solid, np.maximum(density, SURFACE_G + _EDGE_G), np.minimum(density, SURFACE_G - _EDGE_G))
    density[np.asarray(ndimage.binary_erosion(solid), bool)] = _INSIDE_G
    vertices, faces, _, _ = marching_cubes(density, SURFACE_G, gradient_direction="ascent")
    return field.origin + field.voxel * (vertices.astype(float) - 1), faces


def _without_specks(solid: np.ndarray) -> np.ndarray:
    """Bodies of some size: a thin neck may be lost in a field, and what it bears is no speck."""
    labels, count = ndimage.label(solid)  # pyright: ignore[reportGeneralTypeIssues]
    if not count:
        raise InvalidInput("field", "without any solid part", "a solid body")
    sizes = ndimage.sum_labels(solid, labels, range(1, count + 1))
    return np.isin(labels, 1 + np.flatnonzero(sizes >= _SPECK * sizes.max()))


def write_parts(path: Path, parts: Parts, field_digest: str) -> None:
    """Write the parts of a field.

    Args:
        path: of the file.
        parts: corners of each part, in the object's frame [m].
        field_digest: of the field's file; `read_parts` refuses the parts of another.

    Raises:
        CannotWrite: if the disk refuses.
    """
    tensors = {str(number): np.ascontiguousarray(part, np.float32) for number, part in enumerate(parts)}
    write_atomically(path, save(tensors, {"format": FORMAT, "field": field_digest}))


def read_parts(path: Path, field_digest: str) -> Parts | None:
    """The parts of a field; None if the file is not there, broken or of another field, for they can be made again."""
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT or metadata.get("field") != field_digest:
                return None
            known = set(file.keys())
            names = itertools.takewhile(known.__contains__, map(str, itertools.count()))
            parts = tuple(file.get_tensor(name) for name in names)
    except (SafetensorError, OSError, ValueError):
        return None
    return parts if all(_is_body(part) for part in parts) else None


def _is_body(part: np.ndarray) -> bool:
    return part.ndim == 2 and part.shape[1] == 3 and len(part) > 0 and bool(np.isfinite(part).all())
