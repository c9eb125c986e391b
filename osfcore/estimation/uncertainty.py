"""Uncertainty of an estimate: standard deviations from Gauss-Newton's normal matrices, doubts from residuals.

The covariance of a block is s^2 (J^T W J)^-1, with s^2 the mean squared residual. It is inflated by factors that were
calibrated on other scenes, because errors of neighbouring pixels are correlated and fields have errors as well. For an
object, s^2 is at most a share of its own mean squared residual, because the grain of a wooden table does not make the
object's pose less certain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective import FINE_SIDE, LIGHT, POSE, ObjectModels, ObservedViews, SceneParameters, views_of
from osfcore.estimation.search import difference_steps
from osfcore.geometry.states import EstimatedState, Observation, SceneState

# Calibrated on scenes that no reported figure uses.
_POSITION_FACTOR = 15.0
_ROTATION_FACTOR = 10.0
_LIGHT_FACTOR = 12.0
_MOST_SPREAD = 0.5  # s^2, of an object's mean squared residual; on the known table 0.15 at most in six goal images
MAX_RESIDUAL = 0.04  # radiance, root of mean square over an object's pixels
_RELATIVE_RESIDUAL = 0.5  # of the object's contrast, where masks bear out the pose; wrong ones were at 0.66 and more
_ALLOWANCE, _MOST_USUAL = 1.25, 0.1  # times what is usual, which is no more than this [radiance]
# Of a goal image: times what is usual where the objects are now, both as shares of the level; and the least allowed.
_SHARE_ALLOWANCE, _MOST_USUAL_SHARE, _LEAST_SHARE, _LEAST_RESIDUAL = 2.0, 0.3, 0.08, 0.02
_MIN_OVERLAP = 0.75  # of silhouette and mask
_MIN_PIXELS = 12.0  # of an object in all views together
_MOST_POSITION_STD_M, _MOST_ROTATION_STD_RAD = 0.005, np.deg2rad(2.5)
_MIN_RIVAL_RATIO = 1.05
# Loss of the best other orientation, over that of the one chosen, from which a residual of up to a share of the level
# rather shows that the field errs; wrong poses reached 7.5.
SURE_RIVAL_RATIO, _SURE_SHARE = 12.0, 0.3
AMBIGUOUS = "another orientation explains the images as well"  # a doubt
_MAX_HEIGHT_M = 0.006  # of the lowest point over or under the table; truths were within -1 and 4 mm


@dataclass(frozen=True, eq=False, slots=True)
class FitQuality:
    """How well a rendered guess fits the images.

    Attributes:
        residuals: root mean square error over the pixels of each object in each view [radiance]; 0 if it has none.
        pixels: number of pixels of each object in each view: the sum of its rendered opacity.
        contrast: standard deviation of the image over the pixels of each object in all views [radiance].
        level: root mean square of the image over the same pixels [radiance].
        overlap: intersection over union of rendered silhouettes and masks, over views with a mask; 1 without masks.
        surroundings: root mean square error over all other pixels [radiance].
        spread: estimated variance of a pixel's error.
    """

    residuals: Float[np.ndarray, "V N"]
    pixels: Float[np.ndarray, "V N"]
    contrast: Float[np.ndarray, "N"]
    level: Float[np.ndarray, "N"]
    overlap: Float[np.ndarray, "N"]
    surroundings: float
    spread: float


def evaluate_fit(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> FitQuality:
    """Compare a guess with the images.

    Args:
        models: models of the objects and the table.
        views: the images. Their masks, if any, give the overlap of silhouettes.
        params: guess of the scene.
    """
    rendered = models.together.render(
        params.repeated(), views.cameras, quality=views.quality, outputs={"rgb", "opacity"}
    )
    assert rendered.opacity is not None
    opacity = rendered.opacity[0].astype(float)
    squares = ((rendered.rgb[0] - views.images) ** 2).mean(axis=-1, dtype=float)
    pixels = opacity.sum(axis=(2, 3))
    residuals = np.sqrt((opacity * squares[:, None]).sum(axis=(2, 3)) / np.maximum(pixels, 1e-6))
    elsewhere = 1 - opacity.sum(axis=1).clip(0, 1) if len(params.names) else np.ones_like(squares)
    overlap = np.ones(len(params.names))
    if views.masks is not None:
        both, either = (f(opacity, views.masks).sum(axis=(2, 3)) for f in (np.minimum, np.maximum))
        if views.unmasked is not None:
            both, either = both * ~views.unmasked, either * ~views.unmasked
        both, either = both.sum(axis=0), either.sum(axis=0)
        overlap = both / np.maximum(either, 1e-6)
    surroundings = float(np.sqrt((elsewhere * squares).sum() / max(elsewhere.sum(), 1e-6)))
    spread = float(squares.mean())
    total = np.maximum(opacity.sum(axis=(0, 2, 3)), 1e-6)[:, None]
    first, second = (np.einsum("vnhw,vhwc->nc", opacity, views.images**power) / total for power in (1, 2))
    contrast, level = np.sqrt(np.maximum(second - first**2, 0).mean(axis=-1)), np.sqrt(second.mean(axis=-1))
    return FitQuality(residuals * (pixels > 0), pixels, contrast, level, overlap, surroundings, spread)


def relative_allowance(fit: FitQuality) -> Float[np.ndarray, "N"]:
    """Return the largest residual of a right pose with masks, for each object [radiance]: a share of its contrast."""
    return np.maximum(MAX_RESIDUAL, _RELATIVE_RESIDUAL * fit.contrast)


def object_residuals(fit: FitQuality) -> Float[np.ndarray, "N"]:
    """Return the root mean square error of each object over its pixels in all views [radiance]."""
    total = np.maximum(fit.pixels.sum(axis=0), 1e-6)
    return np.sqrt((fit.pixels * fit.residuals**2).sum(axis=0) / total)


def relative_residuals(fit: FitQuality) -> Float[np.ndarray, "N"]:
    """Return residuals as shares of the objects' levels, which do not depend on the brightness of the light."""
    return object_residuals(fit) / np.maximum(fit.level, 1e-6)


def expected_fit(models: ObjectModels, observation: Observation, state: SceneState) -> FitQuality:
    """Evaluate how well objects fit at an estimate.

    Fields have errors. A residual that is normal for an object must not raise doubts later.

    Args:
        models: models of the objects and the table.
        observation: one or more views. Masks are ignored.
        state: an estimate from this observation, which is rendered. The pusher is that of the observation.
    """
    views = views_of(observation, FINE_SIDE, samples=2)
    return evaluate_fit(models, views, SceneParameters.of(state, observation.pusher))


def expected_residuals(models: ObjectModels, observation: Observation, state: SceneState) -> Float[np.ndarray, "N"]:
    """Return the root mean square residual of each object at an estimate [radiance], see `expected_fit`."""
    return object_residuals(expected_fit(models, observation, state))


def goal_allowance(fit: FitQuality, usual: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Return the largest residual of each object that counts as found in a goal image [radiance].

    It is a share of the object's level, because the light of the goal may be brighter or dimmer than the scene's.

    Args:
        fit: fit of a guess of the goal image.
        usual: `relative_residuals` of the present scene; NaN if not known.
    """
    shares = np.maximum(_LEAST_SHARE, _SHARE_ALLOWANCE * np.minimum(usual, _MOST_USUAL_SHARE))
    return np.where(np.isnan(usual), MAX_RESIDUAL, np.maximum(_LEAST_RESIDUAL, shares * fit.level))


def allowed_residuals(usual: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Return the largest residuals that raise no doubt [radiance], given the `expected_residuals`."""
    return _ALLOWANCE * np.minimum(usual, _MOST_USUAL)


def estimate_with_uncertainty(
    params: SceneParameters,
    normals: Sequence[np.ndarray],
    fit: FitQuality,
    rivals: Mapping[int, float],
    *,
    light_held: bool = False,
    lowest: Float[np.ndarray, "N"] | None = None,
    allowed: Float[np.ndarray, "N"] | None = None,
) -> EstimatedState:
    """Return an estimate with its uncertainty and the doubts about it.

    Args:
        params: the scene that was found.
        normals: Gauss-Newton's matrices there, one for each object and one for the light.
        fit: fit of the guess.
        rivals: for each object, ratio of the best loss of a different orientation to the loss of the chosen one. A very
            large ratio allows larger residuals.
        light_held: whether the light was given and not searched.
        lowest: height of each object's lowest point [m], if objects can only stand on the table.
        allowed: largest residual of each object that raises no doubt [radiance]; `MAX_RESIDUAL` by default.
    """
    count = len(params.names)
    deviations = _deviations(normals, fit, count)
    poses = deviations[: POSE * count].reshape(count, 2, 3)
    position = _POSITION_FACTOR * np.sqrt((poses[:, 0] ** 2).mean(axis=1))
    rotation = _ROTATION_FACTOR * np.sqrt((poses[:, 1] ** 2).mean(axis=1))
    light = 0.0 if light_held else _LIGHT_FACTOR * float(np.sqrt((deviations[-LIGHT:] ** 2).mean()))
    heights = np.zeros(count) if lowest is None else lowest
    most = np.full(count, MAX_RESIDUAL) if allowed is None else allowed
    doubts = tuple(
        _reason_for_doubt(fit, n, most[n], position[n], rotation[n], rivals.get(n, np.inf), heights[n])
        for n in range(count)
    )
    return EstimatedState(params.state(), position, rotation, light, doubts, reason_for(params.names, doubts))


def reason_for(names: Sequence[str], doubts: Sequence[str]) -> str:
    """Join the doubts about objects into one text, such as "mug: it is hardly visible"; "" if there are none."""
    return "; ".join(f"{name}: {doubt}" for name, doubt in zip(names, doubts, strict=True) if doubt)


def _deviations(normals: Sequence[np.ndarray], fit: FitQuality, count: int) -> np.ndarray:
    """Return standard deviations of all parameters. They are very large if the images do not constrain a parameter."""
    own = np.where(fit.pixels.sum(axis=0) < _MIN_PIXELS, np.inf, _MOST_SPREAD * object_residuals(fit) ** 2)
    spreads = np.append(np.minimum(own, fit.spread), fit.spread)  # s^2 of the objects, and last of the light
    widths, found, start = difference_steps(count), [], 0
    for normal, spread in zip(normals, spreads, strict=True):
        own = widths[start : start + len(normal)]
        start += len(normal)
        scaled = normal * np.outer(own, own)
        scaled = scaled + (1e-6 * float(np.trace(scaled)) / len(scaled) + 1e-9) * np.eye(len(scaled))
        found.append(own * np.sqrt(np.maximum(np.diag(np.linalg.inv(scaled)), 0) * spread))
    return np.concatenate(found)


def _reason_for_doubt(
    fit: FitQuality, n: int, most: float, position_std: float, rotation_std: float, rival: float, height: float
) -> str:
    if SURE_RIVAL_RATIO <= rival < np.inf:
        most = max(most, _SURE_SHARE * fit.level[n])
    misfit = _misfit(fit, n, most)
    if misfit:
        return misfit
    if rival < _MIN_RIVAL_RATIO:
        return AMBIGUOUS
    if position_std > _MOST_POSITION_STD_M or rotation_std > _MOST_ROTATION_STD_RAD:
        return f"its pose is uncertain by {1000 * position_std:.0f} mm and {np.rad2deg(rotation_std):.0f} deg"
    if abs(height) > _MAX_HEIGHT_M:
        return f"it would {'float above' if height > 0 else 'sink into'} the table by {1000 * abs(height):.0f} mm"
    return ""


def _misfit(fit: FitQuality, n: int, most: float) -> str:
    if fit.pixels[:, n].sum() < _MIN_PIXELS:
        return "it is hardly visible"
    residual = object_residuals(fit)[n]
    if fit.overlap[n] < _MIN_OVERLAP:
        return f"its silhouette and its masks overlap by only {fit.overlap[n]:.0%}"
    return f"its images differ from the rendering by {residual:.2f}" if residual > most else ""


def misfits(fit: FitQuality, allowed: Float[np.ndarray, "N"]) -> list[int]:
    """Return indices of the objects that the images do not show at their rendered poses.

    Args:
        fit: fit of the guess.
        allowed: largest residual of each object that raises no doubt [radiance].
    """
    return [n for n in range(len(allowed)) if _misfit(fit, n, allowed[n])]
