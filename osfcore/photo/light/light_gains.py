"""The linear part of the light: by weighted least squares for each colour and view, given the lamp's share of light.

With s the lamp's share on each pixel, n . l times visibility, falloff and cone, and b small (a ridge),

    objects: I = albedo * (a + b . n + k * s),      table: I = A + K * s with A, K >= 0,

since the table's albedo is unknown. k is not negative either: no lamp takes light away. Without a lamp, light on the
table may vary smoothly, as a quadratic of the place: shadows and cones speak for lamps, vignetting does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.photo.light.lit_pixels import LitPixels

RIDGE = 0.05  # of the harmonics: a lamp explains a gradient rather than they
_TINY = 1e-9
_TABLE_SCALE_M = 0.4
_LEAST_SHARE = 0.05  # of the median radiance


@dataclass(frozen=True, eq=False, slots=True)
class Gains:
    """Light of one scene.

    Attributes:
        residual: radiance less what the light explains.
        lamp: k of each view and colour; NaN where no object is seen.
        ambient: a of them.
        gradient: b of them, mean over views and colours.
    """

    residual: Float[np.ndarray, "P 3"]
    lamp: Float[np.ndarray, "views 3"]
    ambient: Float[np.ndarray, "views 3"]
    gradient: Float[np.ndarray, "3"]


class GainSolver:
    """Least squares of the light's linear part.

    Args:
        pixels: of one scene.
    """

    def __init__(self, pixels: LitPixels) -> None:
        self._pixels = pixels
        self._views = int(pixels.view.max()) + 1
        table, views = pixels.on_table, range(self._views)
        self._tables = [found for v in views if len(found := np.flatnonzero(table & (pixels.view == v)))]
        self._objects = [(v, found) for v in views if len(found := np.flatnonzero(~table & (pixels.view == v)))]

    def __call__(self, share: Float[np.ndarray, "P"] | None, weights: Float[np.ndarray, "P"]) -> Gains:
        """The light and what it leaves, for the lamp's share of light on each pixel; without a lamp for None."""
        radiance = self._pixels.radiance
        residual = np.empty_like(radiance)
        lamp, ambient = np.full((2, self._views, 3), np.nan)
        gradients = [np.zeros(3)]
        for view, chosen in self._objects:
            light = self._on_objects(chosen, None if share is None else share[chosen], weights[chosen], residual)
            ambient[view], lamp[view] = light[:, 0], light[:, 4] if share is not None else 0.0
            gradients.append(light[:, 1:4].mean(axis=0))
        for chosen in self._tables:
            if share is None:
                lit = smooth_light(self._pixels.points[chosen], radiance[chosen], weights[chosen])
            else:
                lit = _table_light(share[chosen], radiance[chosen], weights[chosen])
            residual[chosen] = radiance[chosen] - lit
        return Gains(residual, lamp, ambient, np.mean(gradients[1:] or gradients, axis=0))

    def _on_objects(
        self, chosen: np.ndarray, share: np.ndarray | None, weights: np.ndarray, residual: np.ndarray
    ) -> Float[np.ndarray, "3 K"]:
        """The light of objects in one view; writes the residual."""
        pixels = self._pixels
        plain = np.column_stack([np.ones(len(chosen)), pixels.normals[chosen]])
        lit = plain if share is None else np.column_stack([plain, share])
        light = np.zeros((3, 5 if share is not None else 4))
        for c in range(3):
            albedo, target = pixels.albedo[chosen, c], pixels.radiance[chosen, c]
            found = _ridge(lit, albedo, target, weights, 0.0 if share is None else RIDGE)
            if share is not None and found[4] < 0:
                found = np.append(_ridge(plain, albedo, target, weights, 0.0), 0.0)
            light[c] = found
            residual[chosen, c] = target - albedo * (lit @ found)
        return light


def smooth_light(
    points: Float[np.ndarray, "P 3"],
    radiance: Float[np.ndarray, "P C"],
    weights: Float[np.ndarray, "P"],
    visible: Float[np.ndarray, "P"] | None = None,
) -> Float[np.ndarray, "P C"]:
    """The quadratic of x and y that fits the table's radiance best; with visibility, a constant and that times it."""
    x, y = ((points[:, :2] - points[:, :2].mean(axis=0)) / _TABLE_SCALE_M).T
    basis = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    if visible is not None:
        basis = np.column_stack([np.ones_like(x), basis * visible[:, None]])
    weighted = basis * weights[:, None]
    normal = weighted.T @ basis
    normal[np.diag_indices(len(normal))] += _TINY + 1e-6 * normal[0, 0]
    return basis @ np.linalg.solve(normal, weighted.T @ radiance)


def _table_light(
    share: Float[np.ndarray, "P"], radiance: Float[np.ndarray, "P C"], weights: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P C"]:
    """A + K s that fits radiance best, neither negative."""
    total = max(float(weights.sum()), _TINY)
    mean = weights @ radiance / total
    middle = float(weights @ share) / total
    centred = share - middle
    slope = np.maximum((weights * centred) @ radiance / max(float((weights * centred) @ centred), _TINY), 0)
    base = mean - slope * middle
    through_zero = (weights * share) @ radiance / max(float((weights * share) @ share), _TINY)
    slope, base = np.where(base < 0, through_zero, slope), np.maximum(base, 0)
    return base + share[:, None] * slope


def _ridge(
    basis: np.ndarray, albedo: np.ndarray, target: np.ndarray, weights: np.ndarray, ridge: float
) -> Float[np.ndarray, "K"]:
    weighted = basis * (weights * albedo)[:, None]
    normal = weighted.T @ (basis * albedo[:, None])
    scale = max(float(normal[0, 0]), _TINY)
    normal[np.diag_indices(len(normal))] += _TINY * scale
    normal[[1, 2, 3], [1, 2, 3]] += ridge * scale
    return np.linalg.solve(normal, weighted.T @ target)


def spread(
    residual: Float[np.ndarray, "P C"], pixels: LitPixels
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Root mean square of each pixel's residual and its usual size, that of objects and of the table apart.

    The usual size is at least a share of the radiance: on a plain table a shadow is no outlier by its contrast alone.
    """
    size, usual = np.sqrt((residual**2).mean(axis=1)), np.empty(len(residual))
    for part in (pixels.on_table, ~pixels.on_table):
        if part.any():
            least = _LEAST_SHARE * float(np.median(pixels.radiance[part].mean(axis=1)))
            usual[part] = max(1.4826 * float(np.median(size[part])), least, _LEAST_STD)
    return size, usual
