"""The direction toward a lamp, from the shading of surfaces whose normals and albedo are known.

For each colour c and pixel p, with b small (a ridge),

    I_pc = albedo_pc * (a_c + b_c . n_p + k_c * max(n_p . l, 0) * visible_p(l)),

so that a, b and k follow from linear least squares and only l is searched: over a grid of directions, then by
Levenberg-Marquardt on the sphere. Residuals are weighted by Tukey's biweight: highlights and shadows that others cast
must not count. The light is called diffuse if ambient light and first-order harmonics alone explain the image nearly
as well, and these are not more directed than a room's: |b| / a is 2 for a point light (E(n) = 1/4 + n . l / 2 + ...),
0 for a sky.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from osfcore.errors import InvalidInput
from osfcore.estimation.objective.resting_orientations import fibonacci_sphere
from osfcore.geometry.poses import orthogonal_basis

Visibility = Callable[[Float[np.ndarray, "3"]], Float[np.ndarray, "P"]]

_DIRECTIONS = 600
_SHADED = 60  # of them, the best without shadows, that are compared with them
_RIDGE = 0.05  # of the harmonics: a lamp explains a gradient rather than they
_ROUNDS = 3  # of reweighting
_TUKEY = 4.685  # deviations; 95 % efficient for normal errors
_LEAST_STD = 2e-3  # [radiance]
_LEAST_GAIN = 0.05  # share of the harmonics' squared residual that a lamp must explain
_MOST_DIRECTED = 1.0  # |b| / a of what is called diffuse
_FEWEST = 50


@dataclass(frozen=True, eq=False, slots=True)
class ShadedPixels:
    """Pixels whose surface is known.

    Attributes:
        radiance: linear, well exposed.
        albedo: linear.
        normals: unit, outward.
    """

    radiance: Float[np.ndarray, "P 3"]
    albedo: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]

    def __post_init__(self) -> None:
        """Check the number of pixels.

        Raises:
            InvalidInput: if there are fewer than 50.
        """
        if len(self.radiance) < _FEWEST:
            raise InvalidInput("number of shaded pixels", len(self.radiance), f"{_FEWEST} or more")


@dataclass(frozen=True, eq=False, slots=True)
class LampFit:
    """The light of one photograph.

    Attributes:
        direction: unit vector toward the lamp, in the frame of the normals.
        std: of it, per axis, from the curvature of the residuals [rad].
        strength: light of the lamp on a surface that faces it, per colour, where the radiance of white is 1.
        ambient: light from everywhere, per colour.
        gain: share of the squared residual of ambient light and harmonics that the lamp explains.
        is_diffuse: nothing speaks for a lamp; the direction then means little.
    """

    direction: Float[np.ndarray, "3"]
    std: float
    strength: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"]
    gain: float
    is_diffuse: bool


def fit_lamp(pixels: ShadedPixels, visible: Visibility | None = None) -> LampFit:
    """Find the lamp.

    Args:
        pixels: of all objects in one photograph.
        visible: share of a lamp's light from a direction that reaches each pixel past objects; all by default.
    """
    weights = np.ones(len(pixels.radiance))
    grid = fibonacci_sphere(_DIRECTIONS)
    for shadows in [None] if visible is None else [None, visible]:
        costs = [_squared(_solve(pixels, d, shadows, weights)[0], weights) for d in grid]
        grid = grid[np.argsort(costs, kind="stable")[:_SHADED]]
    direction = grid[0]
    for _ in range(_ROUNDS):
        direction, std = _refine(pixels, direction, visible, weights)
        weights = _tukey(_solve(pixels, direction, visible, weights)[0])
    direction, std = _refine(pixels, direction, visible, weights)
    residual, light = _solve(pixels, direction, visible, weights)
    without, harmonics = _solve(pixels, None, visible, weights)
    gain = 1 - _squared(residual, weights) / max(_squared(without, weights), 1e-12)
    ambient, gradient = harmonics.mean(axis=0)[0], harmonics.mean(axis=0)[1:]
    is_directed = np.linalg.norm(gradient) > _MOST_DIRECTED * max(float(ambient), 0.0)
    is_diffuse = light[:, -1].mean() <= 0 or not (is_directed or gain > _LEAST_GAIN)
    return LampFit(direction, std, light[:, -1], light[:, 0], float(gain), bool(is_diffuse))


def _solve(
    pixels: ShadedPixels, direction: np.ndarray | None, visible: Visibility | None, weights: np.ndarray
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "3 K"]]:
    """Residuals of the least-squares light under a lamp from a direction, or without a lamp; and that light."""
    basis = [np.ones(len(weights)), *pixels.normals.T]
    if direction is not None:
        lit = np.maximum(pixels.normals @ direction, 0)
        basis.append(lit if visible is None else lit * visible(direction))
    shape = np.stack(basis, axis=1)
    ridge = np.array([0.0, _RIDGE, _RIDGE, _RIDGE, 0.0])[: shape.shape[1]] if direction is not None else np.zeros(4)
    residual, light = np.empty_like(pixels.radiance), np.empty((3, shape.shape[1]))
    for c in range(3):
        shades = shape * pixels.albedo[:, c, None]
        weighted = shades * weights[:, None]
        normal = weighted.T @ shades
        normal += np.diag(ridge * normal[0, 0] + 1e-9 * max(normal[0, 0], 1e-9))
        light[c] = np.linalg.solve(normal, weighted.T @ pixels.radiance[:, c])
        residual[:, c] = pixels.radiance[:, c] - shades @ light[c]
    return residual, light


def _refine(
    pixels: ShadedPixels, start: np.ndarray, visible: Visibility | None, weights: np.ndarray
) -> tuple[np.ndarray, float]:
    """The direction nearby with the least weighted residual, and its standard deviation [rad]."""
    right, up = orthogonal_basis(start)
    root = np.sqrt(weights)[:, None]

    def at(x: np.ndarray) -> np.ndarray:
        turned = start + x[0] * right + x[1] * up
        return turned / np.linalg.norm(turned)

    def cost(x: np.ndarray) -> np.ndarray:
        return (root * _solve(pixels, at(x), visible, weights)[0]).ravel()

    found = least_squares(cost, np.zeros(2), diff_step=1e-3, max_nfev=30)
    variance = 2 * found.cost / max(len(found.fun) - 20, 1)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    return at(found.x), float(np.sqrt(np.trace(covariance) / 2))


def _tukey(residual: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(residual, axis=1) / np.sqrt(3)
    std = max(1.4826 * float(np.median(size)), _LEAST_STD)
    return (1 - np.minimum(size / (_TUKEY * std), 1) ** 2) ** 2


def _squared(residual: np.ndarray, weights: np.ndarray) -> float:
    return float((weights[:, None] * residual**2).sum())
