"""Near lamps for the compiled renderer: where they are in every object's coordinates, and where their shadows fall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from osfcore.fields.table_field import TableField
from osfcore.geometry.spot_lamp import MIN_PENUMBRA_RAD, SpotLamp
from osfcore.render.packing import Packed

_HIGHEST = 0.98  # of a lamp's height: what reaches higher may cast its shadow anywhere


class Lamps(NamedTuple):
    """The near lamps of B scenes.

    Attributes:
        position: B x (N + 1) x 3, in the voxel coordinates of each object; the last: in the world [m].
        axis: B x (N + 1) x 3, unit vectors from the lamp toward what it looks at, along the same axes.
        cone: B x 3, outer half-angle [rad], 1 / the width of the penumbra [1/rad], squared distance from the table's
            centre [m^2].
        w1, b1, w2, b2: how the table answers to light from a direction (`TableField`).
    """

    position: np.ndarray
    axis: np.ndarray
    cone: np.ndarray
    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray


def place_lamps(
    spots: Sequence[SpotLamp],
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    table: TableField | None,
) -> Lamps:
    """The lamps of B scenes, worked out in double precision.

    Args:
        spots: one for each scene.
        pack: the fields.
        numbers: which of them each object has.
        rotations: from the world into each object's frame.
        positions: of the objects [m].
        table: what they shine on; None if there is none.
    """
    scales = pack.scales[numbers].astype(float)
    place, axis = (np.array([getattr(spot, name) for spot in spots]) for name in ("position", "axis"))
    local = np.einsum("bnij,bnj->bni", rotations, place[:, None] - positions)
    local = (local - scales[:, :3]) / scales[:, 3:]
    cone = [(outer, 1 / max(outer - inner, MIN_PENUMBRA_RAD)) for inner, outer in (spot.cone_rad for spot in spots)]
    if table is None:
        network = np.zeros((3, 0)), np.zeros(0), np.zeros((0, 3)), np.zeros(3)
    else:
        network = table.w1, table.b1, table.w2, table.b2
    arrays = (
        np.concatenate([local, place[:, None]], axis=1),
        np.concatenate([np.einsum("bnij,bj->bni", rotations, axis), axis[:, None]], axis=1),
        np.column_stack([cone, np.sum(place**2, axis=1)]),
        *network,
    )
    return Lamps(*(np.array(array, np.float32, order="C") for array in arrays))  # any other layout is compiled anew


def lamps_of(lamps: Lamps, chosen: Int[np.ndarray, "L"]) -> Lamps:
    """The lamps of some of the scenes."""
    return Lamps(lamps.position[chosen], lamps.axis[chosen], lamps.cone[chosen], *lamps[3:])


def numbers_of_lamps(spots: Sequence[SpotLamp]) -> Float[np.ndarray, "B 8"]:
    """All that tells one lamp from another, a row for each."""
    return np.array([(*spot.position, *spot.aim, spot.inner_deg, spot.outer_deg) for spot in spots])


def below_lamps(points: Float[np.ndarray, "B N 8 3"], spots: Sequence[SpotLamp]) -> Float[np.ndarray, "B N 8 3"]:
    """Where lamps drop points onto the plane z = 0; NaN where a point is about as high as the lamp, or higher."""
    lamps = np.array([spot.position for spot in spots])[:, None, None]
    height = lamps[..., 2:]
    is_below = points[..., 2:] < _HIGHEST * height
    dropped = lamps + (points - lamps) * height / np.where(is_below, height - points[..., 2:], 1)
    dropped[..., 2] = 0
    return np.where(is_below, dropped, np.nan)
