"""A lamp at a finite distance, from photographs of known objects and of the table around them.

Its share of light on each pixel (`LampShape`) is searched, everything else about the light is linear (`GainSolver`).
Directions are compared first, by the shadows that they cast and by shading, with a table whose brightness may vary
smoothly as it likes; then distances and cones, for the best of them; Levenberg-Marquardt refines what fits best, with
the weights of Tukey's biweight. Deviations come from the curvature of the residuals, those of one patch of a surface
taken as one observation: errors of albedo, normals and poses are alike within a patch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from osfcore.estimation.objective.resting_orientations import fibonacci_sphere
from osfcore.geometry.poses import orthogonal_basis
from osfcore.geometry.spot_lamp import SpotLamp
from osfcore.photo.light.lamp_shape import PLACE_NUMBERS, STEPS, LampShape
from osfcore.photo.light.light_gains import Gains, GainSolver, tukey_weights
from osfcore.photo.light.lit_pixels import LitPixels

_DIRECTIONS = 400  # on the sphere
_COARSE_PIXELS, _MIDDLE_PIXELS, _FINE_PIXELS = 1500, 3000, 8000
_INVERSES = 0.1, 0.9, 1.8  # of distances that directions are compared at [1/m]
_STARTS, _APART_RAD = 4, 0.25
_RADII_M = None, 0.2, 0.35, 0.6
_START_INVERSES = 0.1, 0.7, 1.2, 2.0
_ROUNDS = 3  # of reweighting
_MOST_LOG_STD = 0.3  # of a distance that is known
_CONE_GAIN = 0.02  # by which the mean error must fall for a cone to be believed
_PATCH_M = 0.03


@dataclass(frozen=True, eq=False, slots=True)
class NearLampFit:
    """The lamp of one scene.

    Attributes:
        shape: where it stands and what it looks at.
        std: of its direction, per axis [rad].
        log_distance_std: of the logarithm of its distance.
        strength: its light on a surface at the centre that faces it, per view and colour, where the radiance of white
            is 1: relative to the exposure, which is unknown.
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
        """From the centre [m]."""
        return 1 / self.shape.inverse

    @property
    def distance_known(self) -> bool:
        """Whether the photographs tell the distance."""
        return not self.is_diffuse and self.log_distance_std < _MOST_LOG_STD


class _Search:
    """Costs of lamps on some pixels."""

    def __init__(self, pixels: LitPixels) -> None:
        self.pixels, self.solver, self.table = pixels, GainSolver(pixels), pixels.on_table
        self.lifted = pixels.lifted()
        self.above_table = bool(self.table.any())

    def share(self, lamp: LampShape) -> np.ndarray:
        return lamp.unshaded(self.pixels) * lamp.visible(self.pixels, self.lifted)

    def l1(self, residual: np.ndarray) -> float:
        size = np.abs(residual).sum(axis=1)
        return sum(float(p.sum() * np.log(size[p].mean() + 1e-9)) for p in (self.table, ~self.table) if p.any()) / len(size)

    def gains(self, lamp: LampShape | None, weights: np.ndarray) -> Gains:
        return self.solver(None if lamp is None else self.share(lamp), weights)

    def soft(self, residual: np.ndarray) -> np.ndarray:
        w, std = tukey_weights(residual, self.table)
        size = np.linalg.norm(residual, axis=1) / np.sqrt(3)
        return 1 / np.sqrt(1 + (size / std) ** 2) / std**2

    def tukey(self, residual: np.ndarray) -> np.ndarray:
        w, std = tukey_weights(residual, self.table)
        return w / std**2

    def refine(self, lamp: LampShape, weights: np.ndarray, most: int = 12):
        root = np.sqrt(weights)[:, None]
        steps = STEPS[: lamp.count]

        def cost(x):
            return (root * self.gains(lamp.moved(x * steps, above_table=self.above_table), weights).residual).ravel()

        def jac(x):
            base = cost(x)
            out = np.empty((len(base), len(x)))
            for k in range(len(x)):
                e = np.zeros(len(x)); e[k] = 1.0
                out[:, k] = (cost(x + e) - cost(x - e)) / 2
            return out

        found = least_squares(cost, np.zeros(lamp.count), jac=jac, max_nfev=most, x_scale=1.0, method="lm" if False else "trf")
        return lamp.moved(found.x * steps, above_table=self.above_table), found
