"""A flat printed pattern in a photograph, aligned patch by patch to hundredths of a pixel.

Corner detectors see a few pixels around a corner, and what else is printed there pulls them off by a tenth of a pixel.
Here the known print is drawn as the camera would see it, and each patch of it is shifted until it lies on the
photograph, so that every edge in the patch counts and the marks near a corner help instead of disturbing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

_BLUR_PX = 0.8  # of a sharp photograph; half or twice as much hardly moves the result
_INK = 0.06  # reflectance of black, where white is 1
_GAMMA = 1 / 2.2  # of the photograph's values; edges look shifted where light is mixed before it is encoded
_ROUNDS = 8
_SETTLED_PX = 0.005
_MAX_SHIFT_PX = 3.0
_MIN_CORRELATION = 0.5  # between a patch and the photograph: below, something lies on it or it is not there
_MIN_PIXELS = 30
_UNLIKE = 0.02  # more than three times the usual lack of correlation, and a patch is left out
_LEAST = 4  # points make a homography
_OUTLIER_PX, _LEAST_OUTLIER_PX = 2.0, 0.1
_RIDGE = 1e-7
_FINE_PATCH_PX = 150  # a patch is drawn at least so large, if that is at most three times larger than it is seen
_MAX_ENLARGEMENT = 3
_MARGIN_PX = 2
_FAR_PX = 1e6  # no print reaches so far
_PIXEL_CENTRE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # from indices to coordinates [px]
PATCH_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])

Homography = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """A print and the patches by which it is aligned.

    Attributes:
        image: reflectance, from 0 (black) to 1 (paper); its centre is the origin, its top lies along +y.
        size_m: width and height of the image [m].
        centres_m: of the square patches [m].
        patch_m: side of a patch [m].
    """

    image: Float[np.ndarray, "h w"]
    size_m: tuple[float, float]
    centres_m: Float[np.ndarray, "P 2"]
    patch_m: float


@dataclass(frozen=True, eq=False, slots=True)
class FoundPoints:
    """Centres of those patches that were found.

    Attributes:
        points_m: in the pattern's plane [m].
        points_px: in the photograph [px].
    """

    points_m: Float[np.ndarray, "N 2"]
    points_px: Float[np.ndarray, "N 2"]


NOTHING = FoundPoints(np.empty((0, 2)), np.empty((0, 2)))


def transform(homography: Homography, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Apply a homography to points of the plane."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def find_points(grey: UInt8[np.ndarray, "h w"], pattern: Pattern, guess: Homography) -> FoundPoints:
    """Align a pattern with a photograph.

    In turn each patch's shift d is found, for which the photograph is closest to a R(x - d) + b with the print R drawn
    as the camera sees it and any contrast a and brightness b, and the homography is fitted anew to the shifted centres.
    Patches that look different from the print, or moved otherwise than the others, are left out: something lies on
    them, or a shadow's edge.

    Args:
        grey: the photograph, as encoded by the camera.
        pattern: that is looked for.
        guess: homography from the pattern's plane [m] to the photograph [px], right within 1 to 2 px.

    Returns:
        The patches that agree; none, if fewer than 4 do.
    """
    homography, outlier_px, found = guess, _OUTLIER_PX, NOTHING
    for _ in range(_ROUNDS):
        seen = _seen_patches(grey, pattern, homography)
        if len(seen.points_m) < _LEAST:
            return NOTHING
        fit, inliers = cv2.findHomography(seen.points_m, seen.points_px, cv2.RANSAC, outlier_px)
        if fit is None:
            return NOTHING
        fits = inliers.ravel() > 0
        found = FoundPoints(seen.points_m[fits], seen.points_px[fits])
        moved = transform(fit, found.points_m) - transform(homography, found.points_m)
        residuals = np.linalg.norm(transform(fit, seen.points_m) - seen.points_px, axis=1)
        outlier_px = float(np.clip(3 * np.median(residuals), _LEAST_OUTLIER_PX, _OUTLIER_PX))
        homography = fit
        if np.abs(moved).max() < _SETTLED_PX:
            break
    return found


def _seen_patches(grey: UInt8[np.ndarray, "h w"], pattern: Pattern, homography: Homography) -> FoundPoints:
    """Where patches lie, near where the homography puts them, without those that are less like the print than most."""
    fine, enlargement = _resampled(pattern, homography)
    seen = np.array([_patch_shift(grey, fine, homography, centre, enlargement) for centre in pattern.centres_m])
    there = np.isfinite(seen[:, 2])
    if not there.any():
        return NOTHING
    unlike = 1 - seen[:, 2]
    there &= unlike <= 3 * np.median(unlike[there]) + _UNLIKE
    centres = pattern.centres_m[there]
    return FoundPoints(centres, transform(homography, centres) + seen[there, :2])


def _resampled(pattern: Pattern, homography: Homography) -> tuple[Pattern, int]:
    """The pattern about as fine as it is drawn, and how many times finer than the photograph it is drawn."""
    quads = transform(homography, pattern.centres_m[:, None] + pattern.patch_m * PATCH_CORNERS)
    side_px = float(np.median(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).max(axis=1)))
    enlargement = int(np.clip(np.ceil(_FINE_PATCH_PX / max(side_px, 1.0)), 1, _MAX_ENLARGEMENT))
    pixels = enlargement * side_px / pattern.patch_m * np.array(pattern.size_m)
    if not np.all(pixels < pattern.image.shape[::-1]):
        return pattern, enlargement
    image = cv2.resize(pattern.image, np.maximum(pixels, 8).astype(int).tolist(), interpolation=cv2.INTER_AREA)
    return replace(pattern, image=image), enlargement


def _patch_shift(
    grey: UInt8[np.ndarray, "h w"],
    pattern: Pattern,
    homography: Homography,
    centre_m: Float[np.ndarray, "2"],
    enlargement: int,
) -> Float[np.ndarray, "3"]:
    """How far a patch lies from where the homography puts it [px], and the correlation; NaN if it is not there."""
    missing = np.full(3, np.nan)
    quad = transform(homography, centre_m + pattern.patch_m * PATCH_CORNERS)
    size = np.array(grey.shape[::-1])
    if not np.all(np.abs(quad) < _FAR_PX) or not np.all((quad.mean(axis=0) > 0) & (quad.mean(axis=0) < size)):
        return missing
    low = np.maximum(np.floor(quad.min(axis=0)) - _MARGIN_PX, 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0)) + _MARGIN_PX, size).astype(int)
    drawn = _drawn(pattern, homography, low, high, enlargement)
    mask = cv2.fillConvexPoly(np.zeros(drawn.shape, np.uint8), np.round(quad - low - 0.5).astype(np.int32), 1) > 0
    if mask.sum() < _MIN_PIXELS:
        return missing
    slopes = [cv2.Scharr(drawn, cv2.CV_32F, *order, scale=1 / 32)[mask] for order in ((1, 0), (0, 1))]
    design = np.stack([*slopes, drawn[mask], np.ones(mask.sum(), np.float32)], axis=1).astype(float)
    seen = grey[low[1] : high[1], low[0] : high[0]][mask] / 255.0
    correlation = np.corrcoef(design[:, 2], seen)[0, 1] if np.ptp(seen) > 0 else 0.0
    if not correlation > _MIN_CORRELATION:
        return missing
    # a R(x - d) + b is a R - a d . grad R + b for small d
    *moved, contrast, _ = np.linalg.solve(design.T @ design + _RIDGE * len(seen) * np.eye(4), design.T @ seen)
    shift = -np.array(moved) / contrast
    return np.append(shift, correlation) if contrast > 0 and np.linalg.norm(shift) < _MAX_SHIFT_PX else missing


def _drawn(
    pattern: Pattern, homography: Homography, low: Int[np.ndarray, "2"], high: Int[np.ndarray, "2"], enlargement: int
) -> Float[np.ndarray, "h w"]:
    """What a camera shows of a pattern between two corners of its image, with values from 0 to 1."""
    height, width = pattern.image.shape
    from_pixels = np.array(
        [
            [pattern.size_m[0] / width, 0, -pattern.size_m[0] / 2],
            [0, -pattern.size_m[1] / height, pattern.size_m[1] / 2],
            [0, 0, 1],
        ]
    )
    shrink = np.array([[enlargement, 0, -enlargement * low[0]], [0, enlargement, -enlargement * low[1]], [0, 0, 1]])
    warp = np.linalg.inv(_PIXEL_CENTRE) @ shrink @ homography @ from_pixels @ _PIXEL_CENTRE
    columns, rows = (high - low).tolist()
    light = cv2.warpPerspective(pattern.image, warp, (columns * enlargement, rows * enlargement), borderValue=(1.0,))
    light = cv2.GaussianBlur(cv2.resize(light, (columns, rows), interpolation=cv2.INTER_AREA), (0, 0), _BLUR_PX)
    return (_INK + (1 - _INK) * light) ** _GAMMA
