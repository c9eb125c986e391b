"""A lamp at a finite distance, from photographs of known objects and of the table around them.

Its share of light on each pixel (`LampShape`) is searched, everything else about the light is linear (`GainSolver`).
Directions are compared first, by the shadows that they cast and by shading, with a table whose brightness may vary
smoothly as it likes; then distances and cones, for the best of them; Levenberg-Marquardt refines what fits best, with
weights as of absolute errors. Deviations come from the curvature of the residuals, those of one patch of a surface
taken as one observation, since errors of albedo and normals are alike within a patch; and from what poses add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG
from osfcore.geometry.spot_lamp import MIN_LAMP_DISTANCE_M, SpotLamp
from osfcore.photo.light.lamp_search import LampSearch, Refined, apart
from osfcore.photo.light.lamp_shape import STEPS, LampShape
from osfcore.photo.light.light_gains import Gains
from osfcore.photo.light.lit_pixels import LitPixels

_COARSE_PIXELS, _MIDDLE_PIXELS, _FINE_PIXELS = 3000, 4000, 5000
_STARTS, _APART_RAD = 3, 0.15
_INVERSES = 0.2, 0.7, 1.2, 2.0  # of distances to start from [1/m]
_RADII_M = None, 0.15, 0.25, 0.4, 0.6  # of the pool of light to start from
_REFINED = 2  # of all starts; and the best without a cone
_SCALES = 4.0, 2.0, 1.0  # of steps: shadows' edges are seen from farther with long ones
_ROUNDS = 2  # of reweighting
_PATCH_M = 0.03
_PRIOR_STD = np.array([1e3, 1e3, 1e3, 0.3, 0.3, 1.0, 0.3])  # of what is searched, in its units: of the cone only
_POSE_STD_RAD, _POSE_STD_PER_M = 0.02, 0.09  # what errors of poses, albedo and table add, as simulated scenes showed
_MOST_LOG_STD = 0.25  # of a distance that is known
_LEAST_TABLE_GAIN = 0.12  # 0.3 and more in simulated scenes under a lamp, at most 0.1 in most photographs of rooms
_WIDE_DEG = 85.0  # half-angle of a cone whose border no photograph shows


@dataclass(frozen=True, eq=False, slots=True)
class NearLampFit:
    """The lamp of one scene.

    Attributes:
        shape: where it stands and what it looks at.
        std: of its direction, per axis [rad].
        log_distance_std: of the logarithm of its distance.
        strength: its light on a surface at the centre that faces it, per view and colour, where the radiance of white
            is 1: relative to the exposure, which is unknown. NaN where no object is seen.
        ambient: light from everywhere, likewise.
        gain: share of the squared residual without a lamp that it explains.
        is_diffuse: nothing speaks for a lamp; the rest then means little.
    """

    shape: LampShape
    std: float
    log_distance_std: float
    strength: Float[np.ndarray, "views 3"]
    ambient: Float[np.ndarray, "views 3"]
    gain: float
    is_diffuse: bool

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the centre toward the lamp."""
        return self.shape.direction

    @property
    def distance(self) -> float:
        """From the centre [m]; it means little if it is not known."""
        return 1 / self.shape.inverse

    @property
    def distance_known(self) -> bool:
        """Whether the photographs tell the distance."""
        return not self.is_diffuse and self.log_distance_std < _MOST_LOG_STD

    @property
    def lamp(self) -> SpotLamp | None:
        """The lamp over the table, as renderers take it; None if its distance is not known, or it is too near or low.

        Without a cone in the photographs, it has a wide one.
        """
        place, cone = self.shape.place, self.shape.cone_rad
        distance = float(np.linalg.norm(place))
        is_low = place[2] < distance * np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))
        if not self.distance_known or distance < MIN_LAMP_DISTANCE_M or is_low:
            return None
        inner, outer = (_WIDE_DEG, _WIDE_DEG) if cone is None else np.rad2deg(cone)
        return SpotLamp(place, self.shape.aim_point, float(inner), float(outer))


def fit_near_lamp(pixels: LitPixels, centre: Float[np.ndarray, "3"]) -> NearLampFit:
    """Find the lamp.

    Args:
        pixels: of all photographs of one scene.
        centre: what its direction and distance are told from [m], such as the table's centre.
    """
    start = _start(pixels, centre)
    search = LampSearch(_about(pixels, _FINE_PIXELS))
    weights = np.ones(len(search.pixels.radiance))
    weights = search.weights(search.gains(start, weights).residual)
    found = search.refine(start, weights)
    for _ in range(_ROUNDS):
        weights = search.weights(search.gains(found.lamp, weights).residual)
        found = search.refine(found.lamp, weights)
    covariance = _covariance(found, search.pixels)
    std = float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2 + _POSE_STD_RAD**2))
    log_std = float(np.sqrt(covariance[2, 2] + _POSE_STD_PER_M**2)) / found.lamp.inverse
    under, without = search.gains(found.lamp, weights), search.gains(None, weights)
    left = [float((weights[:, None] * g.residual**2).sum()) for g in (under, without)]
    gain = 1 - left[0] / max(left[1], 1e-12)
    is_diffuse = _is_diffuse(gain, under, without, on_table=search.is_on_table)
    return NearLampFit(found.lamp, std, log_std, under.lamp, under.ambient, gain, is_diffuse)


def _is_diffuse(gain: float, under: Gains, without: Gains, *, on_table: bool) -> bool:
    """Whether light without a lamp explains as much; objects alone must show that it is no more directed than a room's.

    On a table, a lamp casts shadows that nothing else explains.
    """
    if not np.nanmax(under.lamp, initial=0.0) > 0:
        return True
    if on_table:
        return gain <= _LEAST_TABLE_GAIN
    directed = np.linalg.norm(without.gradient) > _MOST_DIRECTED * max(float(np.nanmean(without.ambient)), 0.0)
    return not (directed or gain > _LEAST_GAIN)


def _about(pixels: LitPixels, count: int) -> LitPixels:
    return pixels.every(max(len(pixels.radiance) // count, 1))


def _start(pixels: LitPixels, centre: Float[np.ndarray, "3"]) -> LampShape:
    """The best lamp on few pixels."""
    coarse = LampSearch(_about(pixels, _COARSE_PIXELS))
    directions = coarse.around(apart(coarse.by_direction(centre), _STARTS, _APART_RAD))
    search = LampSearch(_about(pixels, _MIDDLE_PIXELS))
    flat = search.weights(search.gains(None, np.ones(len(search.pixels.radiance))).residual)
    starts = _with_cones(search, apart(directions, _STARTS, _APART_RAD), flat)
    tried = [*starts[:_REFINED], next(lamp for lamp in starts if lamp.radius is None)]
    ends, costs = [], []
    for first in tried:
        lamp, weights = first, flat
        for scale in _SCALES:
            weights = search.weights(search.gains(lamp, weights).residual)
            lamp = search.refine(lamp, weights, scale).lamp
        ends.append(lamp)
        costs.append(search.cost(search.gains(lamp, weights).residual))
    return ends[int(np.argmin(costs))]


def _with_cones(search: LampSearch, lamps: Sequence[LampShape], weights: np.ndarray) -> list[LampShape]:
    """Lamps at several distances and with several cones, the best first."""
    costs, tried = [], []
    for lamp in (replace(lamp, inverse=inverse) for lamp in lamps for inverse in _INVERSES):
        visible = search.visible(lamp)
        for radius in _RADII_M if search.is_on_table else (None,):
            tried.append(replace(lamp, radius=radius))
            costs.append(search.cost(search.gains(tried[-1], weights, visible).residual))
    return [tried[k] for k in np.argsort(costs, kind="stable")]


def _covariance(found: Refined, pixels: LitPixels) -> Float[np.ndarray, "count count"]:
    """Of the lamp's numbers, in their units: H^-1 (sum of g g^T over patches) H^-1, g the gradient from one patch."""
    count = found.lamp.count
    curvature = np.einsum("pci,pcj->ij", found.jacobian, found.jacobian)
    curvature += np.diag((STEPS[:count] / _PRIOR_STD[:count]) ** 2)
    gradients = np.einsum("pci,pc->pi", found.jacobian, found.residual)
    cells = np.column_stack([np.floor(pixels.points / _PATCH_M).astype(np.int64), pixels.owner])
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    sums = np.stack([np.bincount(patch.reshape(-1), column) for column in gradients.T], axis=1)
    inverse = np.linalg.pinv(curvature)
    return inverse @ (sums.T @ sums) @ inverse * np.outer(STEPS[:count], STEPS[:count])
