"""Where a lamp may stand: costs of lamps on some pixels, the comparison of all directions, refinement of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from osfcore.estimation.objective.resting_orientations import fibonacci_sphere
from osfcore.photo.light.lamp_shape import STEPS, LampShape
from osfcore.photo.light.light_gains import RIDGE, Gains, GainSolver, smooth_light, spread
from osfcore.photo.light.lit_pixels import LitPixels

_DIRECTIONS = 260  # on the sphere
_LEAST_HEIGHT = 0.1  # of those above a table
_INVERSES = 0.4, 1.4  # of the distances that they are compared at [1/m]
_RING, _RINGS_RAD = 6, (0.06, 0.12)  # directions near the best of them
_FINE_INVERSES = 0.1, 0.7, 1.3, 2.1
_EVALUATIONS = 6  # of one refinement


@dataclass(frozen=True, eq=False, slots=True)
class Refined:
    """A lamp with the least weighted residual nearby.

    Attributes:
        lamp: where it is.
        residual: weighted, there.
        jacobian: of it with respect to the lamp's numbers, in steps.
    """

    lamp: LampShape
    residual: Float[np.ndarray, "P 3"]
    jacobian: Float[np.ndarray, "P 3 count"]


class LampSearch:
    """Costs of lamps on the pixels of one scene.

    Args:
        pixels: of the scene.
    """

    def __init__(self, pixels: LitPixels) -> None:
        self.pixels = pixels
        self._table, self._lifted, self._solver = pixels.on_table, pixels.lifted(), GainSolver(pixels)
        self.is_on_table = bool(self._table.any())
        """Whether the plane z = 0 is seen, so that the lamp is above it."""

    def visible(self, lamp: LampShape) -> Float[np.ndarray, "P"]:
        """Share of the lamp that each pixel sees."""
        return self.pixels.shadows.from_place(lamp.place, self._lifted)

    def gains(
        self, lamp: LampShape | None, weights: Float[np.ndarray, "P"], visible: Float[np.ndarray, "P"] | None = None
    ) -> Gains:
        """The light under a lamp, or without one; `visible` if that is known already."""
        if lamp is None:
            return self._solver(None, weights)
        visible = self.visible(lamp) if visible is None else visible
        return self._solver(lamp.unshaded(self.pixels) * visible, weights)

    def cost(self, residual: Float[np.ndarray, "P C"]) -> float:
        """Logarithms of the mean absolute residual of objects and table, weighted by their pixels."""
        size = np.abs(residual).mean(axis=1)
        parts = [part for part in (self._table, ~self._table) if part.any()]
        return sum(float(part.mean() * np.log(size[part].mean() + 1e-6)) for part in parts)

    def weights(self, residual: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """As of absolute errors, which shadows that are still misplaced do not lose, over variances."""
        size, usual = spread(residual, self.pixels)
        return 1 / np.sqrt(1 + (size / usual) ** 2) / usual**2

    def by_direction(self, centre: Float[np.ndarray, "3"]) -> list[LampShape]:
        """Lamps without a cone in all directions, the best first; see `ranked`.

        Args:
            centre: what directions and distances are told from [m].
        """
        directions = fibonacci_sphere(_DIRECTIONS)
        if self.is_on_table:
            directions = directions[directions[:, 2] > _LEAST_HEIGHT]
        return self.ranked([LampShape(centre, d, q, np.zeros(2)) for d in directions for q in _INVERSES])

    def around(self, lamps: Sequence[LampShape]) -> list[LampShape]:
        """Lamps without a cone near some, at several distances, the best first; see `ranked`."""
        angles = np.linspace(0, 2 * np.pi, _RING, endpoint=False)
        steps = [(0.0, 0.0), *((r * np.cos(a), r * np.sin(a)) for r in _RINGS_RAD for a in angles)]
        near = [lamp.moved(np.array([*step, 0.0]), above_table=self.is_on_table) for lamp in lamps for step in steps]
        return self.ranked([replace(lamp, inverse=q) for lamp in near for q in _FINE_INVERSES])

    def ranked(self, lamps: Sequence[LampShape]) -> list[LampShape]:
        """The best first; the table's brightness may vary smoothly, so that its shadows count and no cone matters."""
        grey, albedo = self._normalised(), self.pixels.albedo.mean(axis=1)
        costs = [self.cost(self._left_over(lamp, grey, albedo)) for lamp in lamps]
        return [lamps[k] for k in np.argsort(costs, kind="stable")]

    def refine(self, lamp: LampShape, weights: Float[np.ndarray, "P"], scale: float = 1.0) -> Refined:
        """Levenberg-Marquardt from a lamp, with central differences over `STEPS` times a scale."""
        steps, root = scale * STEPS[: lamp.count], np.sqrt(weights)[:, None]

        def cost(x: np.ndarray) -> np.ndarray:
            moved = lamp.moved(x * steps, above_table=self.is_on_table)
            return (root * self.gains(moved, weights).residual).ravel()

        def jacobian(x: np.ndarray) -> np.ndarray:
            return np.stack([(cost(x + e) - cost(x - e)) / 2 for e in np.eye(len(x))], axis=1)

        start = np.zeros(lamp.count)
        found = least_squares(cost, start, jacobian, method="lm", max_nfev=_EVALUATIONS)  # pyright: ignore[reportArgumentType]
        shape = len(weights), 3
        moved = lamp.moved(found.x * steps, above_table=self.is_on_table)
        return Refined(moved, found.fun.reshape(shape), found.jac.reshape(*shape, -1) / scale)

    def _normalised(self) -> Float[np.ndarray, "P 1"]:
        """Radiance, mean of the colours, such that views have about the same exposure."""
        grey, albedo = self.pixels.radiance.mean(axis=1), self.pixels.albedo.mean(axis=1)
        for view in np.unique(self.pixels.view):
            for part in (self._table, ~self._table):
                chosen = part & (self.pixels.view == view)
                if chosen.any():
                    grey[chosen] /= max(float(np.median(grey[chosen] / np.maximum(albedo[chosen], 1e-3))), 1e-6)
        return grey[:, None]

    def _left_over(
        self, lamp: LampShape, grey: Float[np.ndarray, "P 1"], albedo: Float[np.ndarray, "P"]
    ) -> Float[np.ndarray, "P 1"]:
        """What a lamp does not explain of such radiance."""
        visible, objects = self.visible(lamp), ~self._table
        left = np.zeros_like(grey)
        if objects.any():
            share = (lamp.unshaded(self.pixels) * visible)[objects]
            plain = np.column_stack([np.ones(len(share)), self.pixels.normals[objects], share])
            basis = plain * albedo[objects, None]
            normal = basis.T @ basis + 1e-6 * np.eye(5)
            normal[[1, 2, 3], [1, 2, 3]] += RIDGE * normal[0, 0]
            light = np.linalg.solve(normal, basis.T @ grey[objects])
            light[4] = np.maximum(light[4], 0)
            left[objects] = grey[objects] - basis @ light
        if self.is_on_table:
            of_table, lit = self.pixels.points[self._table], visible[self._table]
            one = np.ones(len(lit))
            left[self._table] = grey[self._table] - smooth_light(of_table, grey[self._table], one, lit)
        return left


def apart(lamps: Sequence[LampShape], count: int, angle_rad: float) -> list[LampShape]:
    """The first so many lamps, none within an angle of another."""
    kept: list[LampShape] = []
    for lamp in lamps:
        if len(kept) < count and all(lamp.direction @ other.direction < np.cos(angle_rad) for other in kept):
            kept.append(lamp)
    return kept
