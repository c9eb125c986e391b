"""Surfels of a field: points of its surface with normal and albedo, a stand-in for it that draws in a millisecond.

The surface is where rays from outside have lost half of their light (transmittance 1/2). The normal is the direction of
the field's dipole; the albedo is the field's radiance where light and view both fall along the normal, where
ambient + diffuse = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from scipy.spatial import KDTree

from osfcore.estimation.objective.resting_orientations import fibonacci_sphere
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.ray_marching import march
from osfcore.geometry.poses import orthogonal_basis

_DIRECTIONS = 64  # views from all sides
_AVERAGED = 6  # points of a cell whose albedo is averaged
_NEIGHBOURS = 6  # whose normals are averaged


@dataclass(frozen=True, eq=False, slots=True)
class Surfels:
    """Points of an object's surface, in its frame.

    Attributes:
        points: [m].
        normals: outward, unit.
        albedo: linear reflectance per colour.
        spacing: distance between neighbours [m].
    """

    points: Float32[np.ndarray, "S 3"]
    normals: Float32[np.ndarray, "S 3"]
    albedo: Float32[np.ndarray, "S 3"]
    spacing: float

    @property
    def radius(self) -> float:
        """Distance of the farthest point from the origin [m]."""
        return float(np.linalg.norm(self.points, axis=1).max())


def surfels_of(field: KiloOSF, spacing: float) -> Surfels:
    """Sample the surface of a field.

    Args:
        field: of the object.
        spacing: wanted distance between points [m].
    """
    low, high = field.extent
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    points = np.concatenate([_seen_from(field, d, centre, radius, spacing) for d in fibonacci_sphere(_DIRECTIONS)])
    cells = np.floor(points / spacing).astype(np.int64)
    _, number, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    order = np.argsort(number, kind="stable")
    rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)  # within the cell
    used = order[rank < _AVERAGED]
    normals, albedo = _appearance(field, points[used])
    mean, normal, colour = (_means(a, number[used], len(counts)) for a in (points[used], normals, albedo))
    return Surfels(mean, _smoothed(mean, normal), colour, spacing)


def _means(values: np.ndarray, number: np.ndarray, count: int) -> Float32[np.ndarray, "S 3"]:
    """Mean of the values of each cell."""
    sums = np.stack([np.bincount(number, column, count) for column in values.T], axis=1)
    return (sums / np.bincount(number, minlength=count)[:, None]).astype(np.float32)


def _seen_from(field: KiloOSF, direction: np.ndarray, centre: np.ndarray, radius: float, step: float) -> np.ndarray:
    """Points where parallel rays along -direction have lost half of their light [m]."""
    right, up = orthogonal_basis(direction)
    line = np.arange(-radius, radius, step)
    a, b = np.meshgrid(line, line, indexing="ij")
    origins = centre + 1.5 * radius * direction + a.reshape(-1, 1) * right + b.reshape(-1, 1) * up
    rays = np.tile(-direction, (len(origins), 1))
    delta = field.voxel / 2
    ts, used = march(field, origins, rays, step=delta, min_weight=1e-4, min_transmittance=0.3, most=48)
    points = (origins[:, None] + ts[..., None] * rays[:, None]).astype(np.float32)
    taus = np.zeros(used.shape)
    with torch.no_grad():
        taus[used] = KiloQuery(field).density(torch.as_tensor(points[used])).numpy() * delta
    passed_half = np.cumsum(taus, axis=1) > np.log(2)
    return points[np.arange(len(points)), np.argmax(passed_half, axis=1)][passed_half.any(axis=1)]


def _appearance(field: KiloOSF, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals and albedos at points."""
    query = KiloQuery(field)
    with torch.no_grad():
        x = torch.as_tensor(points)
        normals = torch.nn.functional.normalize(query.features(x)[:, 4:7], dim=-1)
        scatter = query(x, normals, -normals)
        albedo = scatter.ambient + scatter.direct
    return normals.numpy(), albedo.numpy()


def _smoothed(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit normals, each the mean of those of its nearest neighbours."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    _, near = KDTree(points).query(points, k=_NEIGHBOURS)
    mean = unit[near].mean(axis=1)
    return (mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)).astype(np.float32)
