"""Gauss-Newton on the pose of one object: direct image alignment of its visible surfels, and its outline on the mask's.

For visible surfels X_s with projections u_s, in each photograph and colour,

    r_s = I(u_s) - albedo_s * (a + b . n_s),          d r_s / d xi = grad I(u_s) . d u_s / d xi,

with the light a, b by robust least squares (Tukey) at every step; for surfels on the drawn outline

    r_c = phi(u_c) - phi_drawn(u_c),                  d r_c / d xi = grad phi(u_c) . d u_c / d xi,

phi and phi_drawn the signed distances to the borders of the mask and of the drawn outline. A mask whose border is off
by a constant is marginalised where the table tells how large an object appears. xi is a shift in the world and a turn
about the object's origin. Which surfels are visible is found anew at each step and frozen within it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, map_coordinates

from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, quaternion_to_matrix
from osfcore.photo.poses.object_window import ObjectWindow, signed_distance
from osfcore.photo.poses.pose_loss import PoseLoss, draw
from osfcore.photo.poses.surfels import Surfels

_ITERATIONS = 40
_DAMPING = 1e-4
_MOST_TURN_RAD, _MOST_SHIFT = 0.1, 0.05  # of a step; the shift as a share of the distance
_LEAST_TURN_RAD, _LEAST_SHIFT = 2e-4, 2e-5
_COLOUR_WEIGHT = 0.1  # of a surfel's colour: neighbours err together
_FARTHEST_PX, _OUTLINE_STD_PX = 8.0, 1.0
_HUBER, _TUKEY = 1.5, 4.0  # deviations at which residuals begin to count less, and nothing
_LEAST_STD = 0.004  # of colours [radiance]
_FEWEST = 30  # surfels for colours to count
_REWEIGHTINGS = 2
_WORSE = 0.15  # a loss that much above the first: it went astray
_BORDER_STD_PX, _BORDER_STD_ON_TABLE_PX = 0.1, 2.0  # of a constant error of the mask's border
_CORRELATED = 0.03  # share of independent residuals: what the table says counts against them
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_RIDGE = np.diag([1e-4, 2e-2, 2e-2, 2e-2])


@dataclass(frozen=True, eq=False, slots=True)
class _Prepared:
    """A window, its image blurred to the surfels' spacing, gradients, and where no other object is near."""

    window: ObjectWindow
    blurred: Float[np.ndarray, "h w 3"]
    gradient: tuple[np.ndarray, np.ndarray]  # along x and y
    distance_gradient: tuple[np.ndarray, np.ndarray]
    clear: Bool[np.ndarray, "h w"]


def align(loss: PoseLoss, start: Pose) -> tuple[Pose, float]:
    """Refine one pose.

    Args:
        loss: whose windows, surfels and table are used. It decides in the end: a result that is clearly worse than the
            best pose on the way gives way to that one.
        start: near the solution: about a centimetre and ten degrees.

    Returns:
        The pose and its loss.
    """
    prepared = [_prepare(window, loss.surfels, start) for window in loss.windows]
    first = float(loss(_batch(start))[0])
    pose, best, least, value = start, start, first, first
    for _ in range(_ITERATIONS):
        normal, right = _normal_equations(prepared, loss, pose)
        step = np.linalg.solve(normal + np.diag(_DAMPING * np.diag(normal) + 1e-9), right)
        depth = float(np.linalg.norm((loss.windows[0].T_camera_world @ pose).position))
        shift, turn = step[:3], step[3:]
        shift *= min(1.0, _MOST_SHIFT * depth / max(float(np.linalg.norm(shift)), 1e-12))
        turn *= min(1.0, _MOST_TURN_RAD / max(float(np.linalg.norm(turn)), 1e-12))
        pose = Pose(pose.position + shift, quaternion_multiply(quaternion_exp(turn), pose.quaternion))
        value = float(loss(_batch(pose))[0])
        if value < least:
            best, least = pose, value
        if np.linalg.norm(shift) < _LEAST_SHIFT * depth and np.linalg.norm(turn) < _LEAST_TURN_RAD:
            break
    return (pose, value) if value < first + _WORSE else (best, least)


def _batch(pose: Pose) -> Pose:
    return Pose(pose.position[None], pose.quaternion[None])


def _prepare(window: ObjectWindow, surfels: Surfels, start: Pose) -> _Prepared:
    depth = (window.T_camera_world @ start).position[2]
    sigma = max(0.5 * surfels.spacing * window.intrinsics[0, 0] / depth, 0.7)
    blurred = gaussian_filter(window.image, (sigma, sigma, 0))
    phi = gaussian_filter(window.signed_distance, 1.0)
    unknown = (~window.known).astype(np.uint8)
    clear = cv2.dilate(unknown, np.ones((5, 5), np.uint8)) == 0
    return _Prepared(window, blurred, _gradient(blurred), _gradient(phi), clear)


def _gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along x and y [per px]."""
    return np.asarray(np.gradient(image, axis=1)), np.asarray(np.gradient(image, axis=0))


def _normal_equations(prepared: list[_Prepared], loss: PoseLoss, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for part in prepared:
        index, _ = draw(loss.surfels, part.window, _batch(pose))
        std = _BORDER_STD_PX if loss.table is None else _BORDER_STD_ON_TABLE_PX
        terms = [_outline_terms(part, loss.surfels, pose, index[0], std)]
        if loss.kind == "all":
            terms.append(_colour_terms(part, loss.surfels, pose, index[0]))
        for more_normal, more_right in terms:
            normal += _CORRELATED * more_normal
            right += _CORRELATED * more_right
    if loss.table is not None:
        more_normal, more_right = loss.table.normal_equations(pose)
        normal += more_normal
        right += more_right
    return normal, right


def _colour_terms(part: _Prepared, surfels: Surfels, pose: Pose, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normal, right = np.zeros((6, 6)), np.zeros(6)
    seen = np.unique(index[(index >= 0) & part.window.plain])
    pixels, jacobian = _project(part.window, pose, surfels.points[seen])
    within = _sample(part.window.plain.astype(np.float32), pixels) > 0.6
    seen, pixels, jacobian = seen[within], pixels[within], jacobian[within]
    if len(seen) < _FEWEST:
        return normal, right
    rotation = quaternion_to_matrix((part.window.T_camera_world @ pose).quaternion)
    basis = np.concatenate([np.ones((len(seen), 1)), surfels.normals[seen] @ rotation.T], axis=1)
    for colour in range(3):
        shades = basis * surfels.albedo[seen, colour, None]
        residual, weights = _robust_fit(shades, _sample(part.blurred[..., colour], pixels))
        x, y = (_sample(g[..., colour], pixels) for g in part.gradient)
        slope = x[:, None] * jacobian[:, 0] + y[:, None] * jacobian[:, 1]
        weighted = slope * (_COLOUR_WEIGHT * weights)[:, None]
        normal += weighted.T @ slope
        right -= weighted.T @ residual
    return normal, right


def _robust_fit(shades: np.ndarray, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the least-squares light, and their weights over variance by Tukey's biweight."""
    residual, std = _light_residual(shades, observed, np.ones(len(observed)))
    for _ in range(_REWEIGHTINGS):
        residual, std = _light_residual(shades, observed, _tukey(residual, std))
    return residual, _tukey(residual, std) / std**2


def _light_residual(shades: np.ndarray, observed: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Residuals under the light of weighted least squares, and their standard deviation by their median."""
    normal = (shades * weights[:, None]).T @ shades
    normal += _RIDGE * normal[0, 0] + 1e-9 * np.eye(len(normal))
    residual = observed - shades @ np.linalg.solve(normal, (shades * weights[:, None]).T @ observed)
    return residual, max(1.4826 * float(np.median(np.abs(residual))), _LEAST_STD)


def _tukey(residual: np.ndarray, std: float) -> np.ndarray:
    return (1 - np.minimum(np.abs(residual) / (_TUKEY * std), 1) ** 2) ** 2


def _outline_terms(
    part: _Prepared, surfels: Surfels, pose: Pose, index: np.ndarray, border_std_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the outline; a border of the mask that is off by a constant is marginalised."""
    shown = index >= 0
    border = shown & (cv2.erode(shown.astype(np.uint8), _CROSS) == 0) & part.clear
    pixels, jacobian = _project(part.window, pose, surfels.points[index[border]])
    residual = _sample(part.window.signed_distance, pixels) - _sample(signed_distance(shown), pixels)
    x, y = (_sample(g, pixels) for g in part.distance_gradient)
    slope = x[:, None] * jacobian[:, 0] + y[:, None] * jacobian[:, 1]
    sizes = np.abs(residual) / _OUTLINE_STD_PX
    weights = np.where(np.abs(residual) < _FARTHEST_PX, np.minimum(1, _HUBER / np.maximum(sizes, 1e-9)), 0)
    weights /= _OUTLINE_STD_PX**2
    normal, right = (slope * weights[:, None]).T @ slope, -(slope * weights[:, None]).T @ residual
    coupling, shift = slope.T @ weights, -float(weights @ residual)
    own = float(weights.sum()) + 1 / (_CORRELATED * border_std_px**2)
    return normal - np.outer(coupling, coupling) / own, right - coupling * shift / own


def _project(
    window: ObjectWindow, pose: Pose, points: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "S 2"], Float[np.ndarray, "S 2 6"]]:
    """Pixels of an object's points, and their derivatives by a shift in the world and a turn about its origin."""
    arms = points @ quaternion_to_matrix(pose.quaternion).T
    local = window.T_camera_world.apply(arms + pose.position)
    x, y, z = local.T
    fx, fy = window.intrinsics[0, 0], window.intrinsics[1, 1]
    pixels = local @ window.intrinsics.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    zero = np.zeros_like(z)
    slope = np.stack([np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1)
    slope = slope @ quaternion_to_matrix(window.T_camera_world.quaternion)
    cross = np.zeros((len(points), 3, 3))  # of -[arm]x: a turn w moves a point by w x arm
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = arms[:, 2], -arms[:, 1], arms[:, 0]
    cross -= np.swapaxes(cross, 1, 2)
    return pixels, np.concatenate([slope, slope @ cross], axis=2)


def _sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear values at pixel coordinates, whose centres are at +0.5."""
    return map_coordinates(image, [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], order=1, mode="nearest")
