"""Poses of objects in photographs, from masks: search, alignment of surfels, doubts, and the objects' table."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import ConvexHull, KDTree

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.estimation.objective import RestingOrientations, resting_orientations
from osfcore.estimation.search import CMAES
from osfcore.fields.kiloosf import KiloOSF
from osfcore.geometry.poses import (
    Pose,
    orthogonal_basis,
    quaternion_exp,
    quaternion_multiply,
    quaternion_to_matrix,
    rotate,
    rotation_angle,
)
from osfcore.io.image_file import to_uint8
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry
from osfcore.objects.catalogue import CATALOGUE
from osfcore.photo.board import Intrinsics, camera_matrix
from osfcore.photo.photograph import Photograph, check_shared
from osfcore.photo.placement import Shape, Sight, place_cameras
from osfcore.photo.pose_loss import (
    LossKind,
    ObjectWindow,
    PoseLoss,
    Surfels,
    TablePrior,
    draw,
    object_windows,
    print_match,
    signed_distance,
    surfels_of,
)
from osfcore.photo.segmentation import mask_near
from osfcore.progress import Progress

Pair = tuple[np.ndarray, np.ndarray]
Photos = Sequence[Photograph]
Rng = np.random.Generator
Losses = Float[np.ndarray, "K"]

# Gauss-Newton on the pose of one object: direct image alignment of its visible surfels, and its outline on the
# mask's.
#
# For visible surfels X_s with projections u_s, in each photograph and colour,
#
#     r_s = I(u_s) - albedo_s * (a + b . n_s),          d r_s / d xi = grad I(u_s) . d u_s / d xi,
#
# with the light a, b by robust least squares (Tukey) at every step; for surfels on the drawn outline
#
#     r_c = phi(u_c) - phi_drawn(u_c),                  d r_c / d xi = grad phi(u_c) . d u_c / d xi,
#
# phi and phi_drawn the signed distances to the borders of the mask and of the drawn outline. A mask whose border is
# off by a constant is marginalised where the table fixes how large an object appears. xi is a shift in the world
# and a turn about the object's origin. Visibility of surfels is determined at each step and fixed within it.


_ITERATIONS = 20
_DAMPING = 1e-4
_MOST_TURN_RAD, _MOST_SHIFT = 0.1, 0.05  # of a step; the shift as a share of the distance
_LEAST_TURN_RAD, _LEAST_SHIFT = 2e-3, 2e-4
_COLOUR_WEIGHT = 0.1  # of a surfel's colour: neighbours err together
_FARTHEST_PX, _OUTLINE_STD_PX = 8.0, 1.0
_HUBER, _TUKEY = 1.5, 4.0  # deviations at which residuals begin to count less, and nothing
_LEAST_STD = 0.004  # of colours [radiance]
_FEWEST = 30  # surfels for colours to count
_REWEIGHTINGS = 2
_WORSE = 0.02  # an IoU that much below the first: it went astray
_BORDER_STD_PX, _BORDER_STD_ON_TABLE_PX = 0.1, 2.0  # of a constant error of the mask's border
_CORRELATED = 0.03  # share of independent residuals, against which the table's prior counts
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_RIDGE = np.diag([1e-4, 2e-2, 2e-2, 2e-2])


@dataclass(frozen=True, eq=False, slots=True)
class _Prepared:
    """A window, its image blurred to the surfels' spacing, gradients, and where no other object is near."""

    window: ObjectWindow
    blurred: Float[np.ndarray, "h w 3"]
    gradient: Pair  # along x and y
    distance_gradient: Pair
    clear: Bool[np.ndarray, "h w"]


def align(loss: PoseLoss, start: Pose) -> tuple[Pose, float]:
    """Refine one pose.

    Args:
        loss: loss whose windows, surfels and table are used. If the outline fits the mask worse in the end, the initial
            pose is returned.
        start: initial pose, within about a centimetre and ten degrees of the solution.

    Returns:
        The pose and its loss.
    """
    prepared = [_prepare(window, loss.surfels, start) for window in loss.windows]
    pose = start
    for _ in range(_ITERATIONS):
        normal, right = _normal_equations(prepared, loss, pose)
        step = np.linalg.solve(normal + np.diag(_DAMPING * np.diag(normal) + 1e-9), right)
        depth = float(np.linalg.norm((loss.windows[0].T_camera_world @ pose).position))
        shift, turn = step[:3], step[3:]
        shift *= min(1.0, _MOST_SHIFT * depth / max(float(np.linalg.norm(shift)), 1e-12))
        turn *= min(1.0, _MOST_TURN_RAD / max(float(np.linalg.norm(turn)), 1e-12))
        pose = Pose(pose.position + shift, quaternion_multiply(quaternion_exp(turn), pose.quaternion))
        if np.linalg.norm(shift) < _LEAST_SHIFT * depth and np.linalg.norm(turn) < _LEAST_TURN_RAD:
            break
    terms = loss.terms(Pose.stacked([start, pose]))
    kept = int(terms.iou[1] > terms.iou[0] - _WORSE)
    return (pose if kept else start), float(terms.losses[kept])


def align_together(
    losses: Sequence[PoseLoss],
    poses: Sequence[Pose],
    cameras: Sequence[Pose],
    views: Sequence[Sequence[int]],
    free: set[int],
) -> tuple[list[Pose], list[Pose]]:
    """Refine the poses of objects and cameras together, by the same residuals as `align`.

    A camera that is shifted by t and turned by w about c sees an object at p as if that were shifted by
    -t + (p - c) x w and turned by -w, so that each window's normal equations serve for both.

    Args:
        losses: loss of each object, whose windows, surfels and table are used.
        poses: of each object.
        cameras: `T_world_camera` of each photograph.
        views: for each object, which photograph each of its windows shows.
        free: cameras that may move.

    Returns:
        Poses and cameras.
    """
    poses, cameras = list(poses), list(cameras)
    if not poses:
        return poses, cameras
    prepared = [
        [_prepare(w, loss.surfels, pose) for w in loss.windows] for loss, pose in zip(losses, poses, strict=True)
    ]
    place = {camera: np.s_[6 * k : 6 * k + 6] for k, camera in enumerate(sorted(free), len(poses))}
    size = 6 * (len(poses) + len(free))
    for _ in range(_ITERATIONS):
        normal, right, centre = np.zeros((size, size)), np.zeros(size), np.mean([p.position for p in poses], axis=0)
        for number, (loss, pose, parts) in enumerate(zip(losses, poses, prepared, strict=True)):
            own = np.s_[6 * number : 6 * number + 6]
            for part, view in zip(parts, views[number], strict=True):
                window = replace(part.window, T_camera_world=cameras[view].inverse())
                its_normal, its_right = _window_equations(replace(part, window=window), loss, pose)
                jacobian = np.zeros((6, size))
                jacobian[:, own] = np.eye(6)
                if view in free:
                    jacobian[:, place[view]] = -np.eye(6)
                    jacobian[:3, place[view]][:, 3:] = _cross_matrix(pose.position - centre)
                normal += jacobian.T @ its_normal @ jacobian
                right += jacobian.T @ its_right
            if loss.table is not None:
                its_normal, its_right = loss.table.normal_equations(pose)
                normal[own, own] += its_normal
                right[own] += its_right
        steps = np.linalg.solve(normal + np.diag(_DAMPING * np.diag(normal) + 1e-9), right).reshape(-1, 6)
        farthest = _MOST_SHIFT * max(float(np.linalg.norm(camera.position - centre)) for camera in cameras)
        steps[:, :3] *= np.minimum(1, farthest / np.maximum(np.linalg.norm(steps[:, :3], axis=1), 1e-12))[:, None]
        steps[:, 3:] *= np.minimum(1, _MOST_TURN_RAD / np.maximum(np.linalg.norm(steps[:, 3:], axis=1), 1e-12))[:, None]
        turns = quaternion_exp(steps[:, 3:])
        for number, pose in enumerate(poses):
            turned = quaternion_multiply(turns[number], pose.quaternion)
            poses[number] = Pose(pose.position + steps[number, :3], turned)
        for step, camera in enumerate(sorted(free), len(poses)):
            before = cameras[camera]
            position = centre + rotate(turns[step], before.position - centre) + steps[step, :3]
            cameras[camera] = Pose(position, quaternion_multiply(turns[step], before.quaternion))
        shifts, angles = (np.linalg.norm(each, axis=1).max() for each in (steps[:, :3], steps[:, 3:]))
        if shifts < _LEAST_SHIFT * farthest / _MOST_SHIFT and angles < _LEAST_TURN_RAD:
            break
    return poses, cameras


def _cross_matrix(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _prepare(window: ObjectWindow, surfels: Surfels, start: Pose) -> _Prepared:
    depth = (window.T_camera_world @ start).position[2]
    sigma = max(0.5 * surfels.spacing * window.intrinsics[0, 0] / depth, 0.7)
    blurred = gaussian_filter(window.image, (sigma, sigma, 0))
    phi = gaussian_filter(window.signed_distance, 1.0)
    unknown = (~window.known).astype(np.uint8)
    clear = cv2.dilate(unknown, np.ones((5, 5), np.uint8)) == 0
    return _Prepared(window, blurred, _gradient(blurred), _gradient(phi), clear)


def _gradient(image: np.ndarray) -> Pair:
    """Return the derivatives along x and y [per px]."""
    return np.asarray(np.gradient(image, axis=1)), np.asarray(np.gradient(image, axis=0))


def _normal_equations(prepared: list[_Prepared], loss: PoseLoss, pose: Pose) -> Pair:
    parts = [_window_equations(part, loss, pose) for part in prepared]
    normal, right = (np.sum([part[k] for part in parts], axis=0) for k in (0, 1))
    if loss.table is None:
        return normal, right
    more_normal, more_right = loss.table.normal_equations(pose)
    return normal + more_normal, right + more_right


def _window_equations(part: _Prepared, loss: PoseLoss, pose: Pose) -> Pair:
    """Return the normal equations of one photograph."""
    std_px = _BORDER_STD_PX if loss.table is None else _BORDER_STD_ON_TABLE_PX
    index, _ = draw(loss.surfels, part.window, pose[None])
    normal, right = _outline_terms(part, loss.surfels, pose, index[0], std_px)
    if loss.kind == "all":
        more_normal, more_right = _colour_terms(part, loss.surfels, pose, index[0])
        normal, right = normal + more_normal, right + more_right
    return _CORRELATED * normal, _CORRELATED * right


def _colour_terms(part: _Prepared, surfels: Surfels, pose: Pose, index: np.ndarray) -> Pair:
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


def _robust_fit(shades: np.ndarray, observed: np.ndarray) -> Pair:
    """Return residuals of the least-squares light, and their weights over variance by Tukey's biweight."""
    residual, std = _light_residual(shades, observed, np.ones(len(observed)))
    for _ in range(_REWEIGHTINGS):
        residual, std = _light_residual(shades, observed, _tukey(residual, std))
    return residual, _tukey(residual, std) / std**2


def _light_residual(shades: np.ndarray, observed: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return residuals of the light by weighted least squares, and their standard deviation by their median."""
    normal = (shades * weights[:, None]).T @ shades
    normal += _RIDGE * normal[0, 0] + 1e-9 * np.eye(len(normal))
    residual = observed - shades @ np.linalg.solve(normal, (shades * weights[:, None]).T @ observed)
    return residual, max(1.4826 * float(np.median(np.abs(residual))), _LEAST_STD)


def _tukey(residual: np.ndarray, std: float) -> np.ndarray:
    return (1 - np.minimum(np.abs(residual) / (_TUKEY * std), 1) ** 2) ** 2


def _outline_terms(part: _Prepared, surfels: Surfels, pose: Pose, index: np.ndarray, border_std_px: float) -> Pair:
    """Return the normal equations of the outline. A constant offset of the mask's border is marginalised."""
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
    """Project an object's points; also the derivatives by a shift in the world and a turn about its origin."""
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
    """Interpolate bilinearly at pixel coordinates, whose centres are at +0.5."""
    return map_coordinates(image, [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], order=1, mode="nearest")


# Search for an object's pose: over all rotations from the box, around a given pose, and by CMA-ES from the best.


_CENTRING_ROUNDS = 4
_MOST_CHANGE = 0.6  # of depth in one round
_LEAST_SLOPE, _NEAREST_M = 1e-3, 0.05  # of rays toward the table; of what is in front of a camera
_OUTLINED = 350  # surfels that outline an object well enough
_SAMPLED, _COARSELY, _REFINED, _ICP_ROUNDS = 400, 3, 120, 10
_MOST_OFF, _MOTIONS_APART_DEG = 0.035, 14.0
_PSI = 1.533751168755204288118041413  # the positive root of psi^4 = psi + 4
_LATERAL_PX, _DEPTH_SHARE, _TURN_RAD = 2.0, 0.03, 0.15  # CMA's first spread
_GENERATIONS, _POPULATION = 14, 14
_CULLED_AT, _GOING_ON = 5, 8  # the generation after which only so many coarse searches go on
_AROUND_LATERAL_M, _AROUND_DEPTH_SHARE, _AROUND_TURN_RAD = 0.015, 0.04, 0.25


def super_fibonacci(count: int) -> Float[np.ndarray, "count 4"]:
    """Return unit quaternions spread evenly over all rotations (super-Fibonacci spirals; Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / _PSI
    r, big = np.sqrt(t), np.sqrt(1 - t)
    return np.stack([r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)], axis=1)


def poses_from_box(loss: PoseLoss, quaternions: Float[np.ndarray, "K 4"]) -> Pose:
    """Find for each rotation the position at which the object's outline fills its box.

    The photograph with the largest mask decides.

    Args:
        loss: whose windows and surfels are used.
        quaternions: rotations from the object's frame to the world, unit.
    """
    window = _largest(loss)
    camera, K = window.T_camera_world.inverse(), window.intrinsics
    low, high = window.box.reshape(2, 2)
    ray = np.linalg.solve(K, [*(low + high) / 2, 1.0])
    local = np.tile(ray * K[0, 0] * 2 * loss.surfels.radius / (high - low).max(), (len(quaternions), 1))
    for _ in range(_CENTRING_ROUNDS):
        lower, upper = _sides(loss.surfels, window, Pose(camera.apply(local), quaternions))
        share = np.exp(np.log(np.maximum(upper - lower, 1e-3) / (high - low)).mean(axis=1))
        shift = ((low + high) - (lower + upper)) / 2 / K[[0, 1], [0, 1]] * local[:, 2:]
        local = np.concatenate([local[:, :2] + shift, local[:, 2:]], axis=1)
        local *= np.clip(share, _MOST_CHANGE, 1 / _MOST_CHANGE)[:, None]
    return Pose(camera.apply(local), quaternions)


def poses_on_table(loss: PoseLoss, resting: RestingOrientations) -> Pose:
    """Find for each resting orientation the place on the table z = 0 at which the outline is centred in its box.

    Args:
        loss: whose windows and surfels are used; the photograph with the largest mask decides.
        resting: resting orientations of the object.
    """
    window = _largest(loss)
    camera, heights = window.T_camera_world.inverse(), resting.origin_heights
    centre = window.box.reshape(2, 2).mean(axis=0)
    aim, poses = np.tile(centre, (len(heights), 1)), Pose(np.zeros((len(heights), 3)), resting.quaternions)
    for _ in range(_CENTRING_ROUNDS):
        rays = rotate(camera.quaternion, np.linalg.solve(window.intrinsics, np.c_[aim, np.ones(len(aim))].T).T)
        reach = (heights - camera.position[2]) / np.minimum(rays[:, 2], -_LEAST_SLOPE)
        places = camera.position + np.maximum(reach, _NEAREST_M)[:, None] * rays
        poses = Pose(np.c_[places[:, :2], heights], resting.quaternions)
        aim = aim + centre - np.mean(_sides(loss.surfels, window, poses), axis=0)
    return poses


def _largest(loss: PoseLoss) -> ObjectWindow:
    return max(loss.windows, key=lambda window: int(window.mask.sum()))


def _sides(surfels: Surfels, window: ObjectWindow, poses: Pose) -> Pair:
    """Return the least and the greatest coordinates of the outlines of B poses, B x 2 each [px]."""
    points = surfels.points[:: max(1, len(surfels.points) // _OUTLINED)].astype(np.float64)
    points = points[ConvexHull(points).vertices]  # nothing else reaches a side
    local = window.T_camera_world @ poses
    matrices = window.intrinsics @ quaternion_to_matrix(local.quaternion)
    pixels = matrices @ points.T + (local.position @ window.intrinsics.T)[..., None]
    pixels = pixels[:, :2] / np.maximum(pixels[:, 2:], _NEAREST_M)
    return pixels.min(axis=2), pixels.max(axis=2)


def shape_symmetries(surfels: Surfels) -> Pose:
    """Return rigid motions of an object that change hardly anything but its print, the identity first.

    Of rotations about the centroid from all over SO(3), those that bring surfels nearest to others are refined by ICP.
    Those at which surfels end within 3.5 % of the radius from others, in the mean, remain, 14 degrees apart.

    Args:
        surfels: of the object.
    """
    points = surfels.points.astype(np.float64)
    sample = points[:: max(1, len(points) // _SAMPLED)]
    tree, centre, motions = KDTree(points), points.mean(axis=0), [Pose.identity()]
    turned = Pose(np.zeros(3), super_fibonacci(_ROTATIONS))
    moved_ = turned.quaternion, centre - rotate(turned.quaternion, centre)
    few = sample[::_COARSELY]
    offs = np.array([tree.query(rotate(q, few) + t)[0].mean() for q, t in zip(*moved_, strict=True)])
    found: list[tuple[float, Pose]] = []
    for k in np.argsort(offs)[:_REFINED]:
        motion = Pose(moved_[1][k], moved_[0][k])
        for _ in range(_ICP_ROUNDS):
            motion = _rigid(sample, points[tree.query(motion.apply(sample))[1]])
        found.append((tree.query(motion.apply(sample))[0].mean() / surfels.radius, motion))
    for off, motion in sorted(found, key=lambda each: each[0]):
        apart = rotation_angle(np.stack([m.quaternion for m in motions]), motion.quaternion).min()
        if off < _MOST_OFF and apart > np.deg2rad(_MOTIONS_APART_DEG):
            motions.append(motion)
    return Pose.stacked(motions)


def _rigid(points: Float[np.ndarray, "S 3"], targets: Float[np.ndarray, "S 3"]) -> Pose:
    """Return the rigid motion that brings points nearest to targets in the mean square (Kabsch 1976)."""
    matrix, middle, goal = np.eye(4), points.mean(axis=0), targets.mean(axis=0)
    left, _, right = np.linalg.svd((points - middle).T @ (targets - goal))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    matrix[:3, :3] = (left @ flip @ right).T
    matrix[:3, 3] = goal - matrix[:3, :3] @ middle
    return Pose.from_matrix(matrix)


def poses_around(pose: Pose, window: ObjectWindow, count: int, rng: np.random.Generator) -> Pose:
    """Draw poses around a given one, itself first: about 1.5 cm sideways, 4 % nearer or farther, 15 degrees turned.

    Args:
        pose: pose of one object in the world.
        window: window of the photograph whose camera says what is sideways.
        count: number of poses.
        rng: random generator of the draws.
    """
    depth = (window.T_camera_world @ pose).position[2]
    scales = np.array([_AROUND_LATERAL_M, _AROUND_LATERAL_M, _AROUND_DEPTH_SHARE * depth, *[_AROUND_TURN_RAD] * 3])
    steps = rng.standard_normal((count, 6)) * scales
    steps[0] = 0
    return moved(pose, window, steps)


def moved(poses: Pose, window: ObjectWindow, steps: Float[np.ndarray, "B 6"]) -> Pose:
    """Shift poses along a camera's axes [m] and turn them about their origins by rotation vectors in it [rad]."""
    camera = window.T_camera_world.inverse()
    turns = quaternion_exp(rotate(camera.quaternion, steps[:, 3:]))
    quaternions = quaternion_multiply(turns, np.broadcast_to(poses.quaternion, (len(steps), 4)))
    return Pose(poses.position + rotate(camera.quaternion, steps[:, :3]), quaternions)


def distinct(poses: Pose, losses: Losses, count: int, least_deg: float) -> list[int]:
    """Return the numbers of the best poses whose rotations differ from those of better ones by `least_deg` or more."""
    kept: list[int] = []
    for k in np.argsort(losses):
        if not kept or rotation_angle(poses.quaternion[kept], poses.quaternion[k]).min() > np.deg2rad(least_deg):
            kept.append(int(k))
        if len(kept) == count:
            break
    return kept


def cma_search(loss: PoseLoss, starts: Pose, spread: float, rng: Rng, kept: int) -> tuple[Pose, Losses]:
    """Run one CMA-ES from each start; a generation of all is drawn as one batch.

    Args:
        loss: what is minimised.
        starts: K poses.
        spread: first standard deviation, as a multiple of 2 pixels sideways, 3 % of the depth and 0.15 rad.
        rng: random generator of the searches.
        kept: how many searches go on after the fifth generation, the best ones.

    Returns:
        The best pose of each search and its loss.
    """
    window = _largest(loss)
    depths = (window.T_camera_world @ starts).position[:, 2]
    lateral = _LATERAL_PX * depths / window.intrinsics[0, 0]
    turns = [np.full(len(depths), _TURN_RAD)] * 3
    scales = spread * np.stack([lateral, lateral, _DEPTH_SHARE * depths, *turns], axis=1)
    searches = [CMAES(np.ones(6), _POPULATION, rng) for _ in depths]
    position, quaternion = starts.position.copy(), starts.quaternion.copy()
    least, going = loss(starts), list(range(len(searches)))
    for generation in range(_GENERATIONS):
        if generation == _CULLED_AT:
            going = [int(k) for k in np.argsort(least)[:kept]]
        asked = [searches[k].ask() for k in going]
        tried = Pose.joined(*(moved(starts[k], window, a * scales[k]) for k, a in zip(going, asked, strict=True)))
        losses = loss(tried).reshape(len(going), _POPULATION)
        for row, k in enumerate(going):
            searches[k].tell(losses[row])
            best = int(np.argmin(losses[row]))
            if losses[row, best] < least[k]:
                least[k], number = losses[row, best], row * _POPULATION + best
                position[k], quaternion[k] = tried.position[number], tried.quaternion[number]
    return Pose(position, quaternion), least


# The table's plane from the objects: most of them stand in a stable orientation, on one plane.


_AGREE_DEG = 12.0
_AGREE_M = 0.02
_FEWEST_OBJECTS = 2  # one alone does not show which of its sides is down
_DOWNWARD = np.array([0.0, 1.0, 0.5])  # in a camera's frame: it looks ahead and down


@dataclass(frozen=True, eq=False, slots=True)
class TableGuess:
    """A table found from the objects on it.

    Attributes:
        T_world_camera: pose of the camera in a world whose z = 0 is the table, with its origin below the objects' mean.
        spread_deg: spread of the objects' verticals around their mean, root mean square.
        supported: indices of the objects that stand on it.
    """

    T_world_camera: Pose
    spread_deg: float
    supported: tuple[int, ...]


def table_from_objects(priors: Sequence[TablePrior], poses: Sequence[Pose]) -> TableGuess | None:
    """Find the plane that most objects stand on; None if fewer than two agree.

    The vertical is the direction that agrees within 12 degrees with a stable orientation of most objects. The plane
    lies at the median of their lowest points; objects within 2 cm of it count as standing on it.

    Args:
        priors: priors of each object.
        poses: poses of each object in the camera's frame.
    """
    options = [prior.downs(pose) for prior, pose in zip(priors, poses, strict=True)]
    options = [o[o @ _DOWNWARD > 0] for o in options]
    best: tuple[float, list[tuple[int, np.ndarray]]] = 0.0, []
    for candidate in np.concatenate([np.zeros((0, 3)), *options]):
        agreeing = []
        for number, directions in enumerate(options):
            if len(directions) and (directions @ candidate).max() > np.cos(np.deg2rad(_AGREE_DEG)):
                agreeing.append((number, directions[np.argmax(directions @ candidate)]))
        score = len(agreeing) + float(np.mean([d @ candidate for _, d in agreeing]))
        if score > best[0]:
            best = score, agreeing
    down = np.sum([d for _, d in best[1]], axis=0)
    if len(best[1]) < _FEWEST_OBJECTS or np.linalg.norm(down) == 0:
        return None
    down /= np.linalg.norm(down)
    reach = {number: priors[number].extent(poses[number], down) for number, _ in best[1]}
    level = float(np.median(list(reach.values())))
    supported = tuple(number for number, height in reach.items() if abs(height - level) < _AGREE_M)
    if len(supported) < _FEWEST_OBJECTS:
        return None
    level = float(np.mean([reach[number] for number in supported]))
    angles = [np.arccos(np.clip(d @ down, -1, 1)) for number, d in best[1] if number in supported]
    spread = float(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))
    middle = np.mean([poses[number].position for number in supported], axis=0)
    right, _ = orthogonal_basis(-down)
    T_world_camera = _frame(right, np.cross(-down, right), -down, middle + (level - middle @ down) * down)
    return TableGuess(T_world_camera, spread, supported)


def _frame(right: np.ndarray, ahead: np.ndarray, up: np.ndarray, origin: np.ndarray) -> Pose:
    """Return `T_world_camera` of a world whose axes and origin [m] are given in the camera's frame."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([right, ahead, up], axis=1), origin
    return Pose.from_matrix(matrix).inverse()


# An unknown focal length: the one at which objects explain the photograph best and stand on one table.
#
# With a wrong focal length each object still fits its mask nearly as well, at another distance and turned with its
# viewing ray. But objects in different places then disagree on the vertical and the plane. For each focal length f of a
# grid, with the table that the objects agree on, the cost is
#
#     S(f) = sum_k [ L_k(f) + w (height_k^2 / s_h^2 + tilt_k^2 / s_t^2) ],
#
# L_k the loss of `PoseLoss` after alignment, the rest as in `TablePrior`. A parabola in log f through the least cost
# and its neighbours refines it.


_FOCAL_FACTORS = tuple(1.25**k for k in range(-2, 6))  # of the one assumed: 100 to 28 degrees from corner to corner
_ON_TABLE_WEIGHT = 1e-2  # w: alignment may end in another place at each f, so that losses jump by several hundredths
_NOT_ON_TABLE = 10.0  # of an object where no table is found


class _FocalSearch:
    """Tries focal lengths. `photo` has no known table; `found` was found with a guess of its focal length."""

    def __init__(
        self, models: PhotoModels, photo: Photograph, found: Sequence[PhotoObject], config: PhotoConfig
    ) -> None:
        self._models, self._photo, self._found, self._config = models, photo, found, config
        self._costs: dict[float, float] = {}

    def try_out(self, factor: float) -> None:
        """Determine the cost of a focal length that is longer by a factor."""
        poses, losses = [], []
        for one in self._found:
            pose, loss = self._aligned(one, one.best.pose, factor)
            poses.append(pose)
            losses.append(loss)
        priors = [self._models.table_prior(one.name) for one in self._found]
        table = table_from_objects(priors, poses)
        self._costs[factor] = sum(losses) + _NOT_ON_TABLE * len(poses)
        if table is not None:
            placed = [(table.T_world_camera @ pose)[None] for pose in poses]
            off = sum(float(prior.penalties(pose)[0]) for prior, pose in zip(priors, placed, strict=True))
            self._costs[factor] = sum(losses) + _ON_TABLE_WEIGHT * off

    def best(self) -> float | None:
        """Return the factor of least cost; None if it is at an end of the grid, or no table was found."""
        factors = np.array(sorted(self._costs))
        costs = np.array([self._costs[factor] for factor in factors])
        k = int(np.argmin(costs))
        if k in (0, len(costs) - 1) or costs[k] >= _NOT_ON_TABLE * len(self._found):
            return None
        left, middle, right = costs[k - 1 : k + 2]
        shift = 0.5 * (left - right) / max(left - 2 * middle + right, 1e-9)
        return float(factors[k] * (factors[k + 1] / factors[k]) ** np.clip(shift, -0.5, 0.5))

    def moved(self, one: PhotoObject, factor: float) -> PhotoObject:
        """Return an object with its poses for a camera of this focal length."""
        poses = [replace(each, pose=self._aligned(one, each.pose, factor)[0]) for each in (one.best, *one.rivals)]
        return replace(one, best=poses[0], rivals=tuple(poses[1:]))

    def _aligned(self, one: PhotoObject, pose: Pose, factor: float) -> tuple[Pose, float]:
        photo = _with_focal(self._photo, factor)
        windows = object_windows([photo], one.name, _FINE_SIDE)
        loss = PoseLoss(windows, self._models.surfels(one.name, FINE_ACROSS), kind=self._config.loss)
        return align(loss, seen_through(pose, self._photo.intrinsics, photo.intrinsics))


def _with_focal(photo: Photograph, factor: float) -> Photograph:
    K = photo.intrinsics
    return replace(photo, intrinsics=camera_matrix(factor * float(K[0, 0]), float(K[0, 2]), float(K[1, 2])))


def seen_through(pose: Pose, before: Intrinsics, after: Intrinsics) -> Pose:
    """Return the pose at which another lens shows an object at the same size, in the same place and from the same side.

    Args:
        pose: pose in the frame of the camera with the first lens.
        before: K of the first lens [px].
        after: K of the other lens [px].
    """
    ray = pose.position / pose.position[2]
    other = np.linalg.solve(after, before @ ray)
    lengths = np.linalg.norm(ray), np.linalg.norm(other)
    half_turn = np.array([lengths[0] * lengths[1] + ray @ other, *np.cross(ray, other)])
    # Across the ray a length shows as f / z, along the image's radius as f |ray| / z: their geometric mean is kept.
    depth = pose.position[2] * after[0, 0] / before[0, 0] * np.sqrt(lengths[1] / lengths[0])
    return Pose(depth * other, quaternion_multiply(half_turn / np.linalg.norm(half_turn), pose.quaternion))


# The table's plane in a camera's frame, from points on it.


_TRIES = 400
_TOLERANCE_M = 6e-3
_LEAST_SHARE = 0.3  # of the points on the plane
_FEWEST_INLIERS = 50


def table_from_points(points_camera: Float[np.ndarray, "P 3"], rng: np.random.Generator) -> Pose:
    """Return `T_world_camera` such that most points lie at z = 0: RANSAC, then a least-squares plane of its inliers.

    The world's origin is the inliers' mean; z points from the plane to the camera's side.

    Args:
        points_camera: points in the camera's frame, most of them on the table [m].
        rng: random generator of the draws.

    Raises:
        InvalidInput: if there are fewer than 50 points, or less than 30 % lie on one plane.
    """
    if len(points_camera) < _FEWEST_INLIERS:
        raise InvalidInput("number of points on the table", len(points_camera), f"{_FEWEST_INLIERS} or more")
    best = np.zeros(len(points_camera), bool)
    for _ in range(_TRIES):
        a, b, c = points_camera[rng.choice(len(points_camera), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 0:
            near = np.abs((points_camera - a) @ normal) < _TOLERANCE_M * length
            best = near if near.sum() > best.sum() else best
    if best.mean() < _LEAST_SHARE:
        raise InvalidInput("points on one plane", f"{100 * best.mean():.0f} %", f"{100 * _LEAST_SHARE:.0f} % or more")
    inliers = points_camera[best]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    normal = -normal if normal @ centre > 0 else normal
    right, ahead = orthogonal_basis(normal)
    if np.cross(right, ahead) @ normal < 0:
        ahead = -ahead
    return _frame(right, ahead, normal, centre)


# Steps and result of the estimation of a photographed scene.


@dataclass(frozen=True, eq=False, slots=True)
class PhotoPose:
    """One pose of an object, with how well it explains the photographs.

    Attributes:
        pose: `T_world_object`.
        loss: loss of `PoseLoss`.
        iou: intersection over union of drawn outline and mask.
        explained: mean log odds that pixels show the object, per pixel of its box.
        correlation: correlation of the band-passed images.
        match: share of the print that is found again, see `print_match`.
    """

    pose: Pose
    loss: float
    iou: float
    explained: float
    correlation: float
    match: float

    @property
    def score(self) -> float:
        """The loss, less what is found of the print: poses are ranked by it."""
        return self.loss - _PRINT * self.match


@dataclass(frozen=True, eq=False, slots=True)
class PhotoObject:
    """One object that was searched in the photographs.

    Attributes:
        name: name of the object.
        best: the most likely pose.
        rivals: other orientations, the best first, from which a person may choose.
        doubt: why the pose should not be trusted, in one sentence; "" if it can be.
        coarse_s: duration of the search over rotations [s].
        refine_s: duration of the refinement [s].
        masks: pixels that show it in each photograph, proposals corrected by where it was found; None without any.
    """

    name: str
    best: PhotoPose
    rivals: tuple[PhotoPose, ...]
    doubt: str
    coarse_s: float
    refine_s: float
    masks: tuple[Bool[np.ndarray, "h w"] | None, ...] = ()

    @property
    def probabilities(self) -> Float[np.ndarray, "K"]:
        """How probable it is that the object is turned as in the best pose, and in each rival, see `probabilities`."""
        return probabilities((self.best, *self.rivals))


@dataclass(frozen=True, eq=False, slots=True)
class PhotoStep:
    """One step of the estimation.

    Attributes:
        progress: how far the work has come.
        found: objects found so far, in the photographs' world.
        table: table found from the objects if no photograph shows a board; only in the last step.
        photos: the photographs with the masks, cameras and focal length that were found. One of several that does not
            fit the others has no masks; it was not used. Only in the last step.
        focal_factor: by which focal lengths are longer than assumed; None if they were known or could not be found.
    """

    progress: Progress
    found: tuple[PhotoObject, ...]
    table: TableGuess | None = None
    photos: tuple[Photograph, ...] = ()
    focal_factor: float | None = None


def _seen(photo: Photograph, found: Sequence[PhotoObject], number: int = 0) -> Photograph:
    """Return photograph `number` with the masks that were found."""
    masks = dict(photo.masks)
    for each in found:
        mask = each.masks[number] if each.masks else None
        if each.name in masks and mask is not None:
            masks[each.name] = mask
    return replace(photo, masks=masks)


# Reasons not to trust a pose in a photograph, one sentence each; and how probable orientations are.
#
# With scores s_k of the poses that were found, the best first, and the print m that is found of the best,
#
#     p_k = w_k / (w_none + sum_j w_j),    w_k = exp((s_0 - s_k) / T),    w_none = exp(a - b m - c (IoU - 0.9)),
#
# where "none" stands for an orientation that was not found, and IoU is that of the best pose's outline and its mask.
# Where too little print is in view to look for (m = 0), a - b m is another constant d. The constants maximise the
# likelihood of which poses were right on the photographs and drawn tables of development.


_PRINT = 0.6  # weight of the print that is found again
_TEMPERATURE = 0.04  # T
_UNSEEN, _PRINTED, _PLAIN, _FITTING, _USUAL_IOU = 1.7, 6.9, -1.2, 12.6, 0.9  # a, b, d, c
_LEAST_PROBABLE = 0.8  # of a pose that is trusted
_LEAST_IOU = 0.85
_MOST_CUT = 0.1  # of the mask's border lies on the photo's edge


def probabilities(poses: Sequence[PhotoPose]) -> Float[np.ndarray, "K"]:
    """Return how probable it is that an object is turned as in each of its poses, within 10 degrees.

    Args:
        poses: that were found, the best first. What is missing to 1 is the probability of another orientation.
    """
    scores = np.array([pose.score for pose in poses])
    weights = np.exp(np.minimum(scores[0] - scores, 0) / _TEMPERATURE)
    match = poses[0].match
    unseen = (_UNSEEN - _PRINTED * match if match else _PLAIN) - _FITTING * (poses[0].iou - _USUAL_IOU)
    return weights / (weights.sum() + np.exp(unseen))


def fits_outline(best: PhotoPose) -> bool:
    """Return whether the drawn outline fits the mask."""
    return best.iou >= _LEAST_IOU


def doubt_of(name: str, best: PhotoPose, rivals: Sequence[PhotoPose], loss: PoseLoss) -> str:
    """Return the first reason for doubt that applies; "" if none does.

    Args:
        name: name of the object.
        best: its pose.
        rivals: other orientations, the best first.
        loss: loss whose windows the pose was found in.
    """
    if not fits_outline(best):
        share = f"they share {100 * best.iou:.0f} %"
        return f"The outline of {name} does not fit its mask ({share}); check the name, the mask and the camera."
    sure, *others = probabilities((best, *rivals)).tolist()
    if sure < _LEAST_PROBABLE:
        if others and others[0] > 1 - sure - sum(others):
            return f"{name} may lie in another orientation (sure to {int(100 * sure)} %); choose between the pictures."
        return f"{name} is hard to recognise here (sure to {int(100 * sure)} %); check its name, box and pictures."
    if min(window.cut for window in loss.windows) > _MOST_CUT:
        return f"{name} is cut off by the edge of the photo, so that its distance is uncertain."
    return ""


# Masks of an object once the others are found: objects in front of it spoil a mask that was proposed from a box.


_SIDE = 240  # of a mask whose object is drawn [px]


def without_others(
    photos: Sequence[Photograph], name: str, found: Sequence[PhotoObject], surfels: Mapping[str, Surfels]
) -> list[Photograph]:
    """Return photographs in which an object's mask contains no other object.

    The outline of each other object, drawn in its found pose, is added to that object's mask. Pixels of an outline that
    fits its mask are removed from the mask of the object `name`, unless that one is nearer.

    Args:
        photos: photos with masks.
        name: name of the object. Photographs without a mask of it are not changed.
        found: all objects.
        surfels: surfels of each object, by name.
    """
    seen, own = [], [each.best.pose for each in found if each.name == name]
    for photo in photos:
        masks, camera = dict(photo.masks), photo.T_world_camera.position
        for other in found:
            if name not in masks or other.name == name or other.name not in masks:
                continue
            window = object_windows([photo], other.name, _SIDE)[0]
            index, _ = draw(surfels[other.name], window, other.best.pose[None])
            shown = (index[0] >= 0).astype(np.float32)
            drawn = window.frame.placed(shown, masks[name].shape)  # as far as its window reaches
            apart = [float(np.linalg.norm(pose.position - camera)) for pose in (other.best.pose, *own)]
            if fits_outline(other.best) and apart[0] <= apart[-1]:
                masks[name] = masks[name] & ~(drawn & masks[other.name])
            masks[other.name] = masks[other.name] | drawn
        seen.append(replace(photo, masks=masks) if name in masks else photo)
    return seen


# Poses of known objects in photographs: from boxes or masks and fields alone, or from poses that another program gives.
#
# For each object, candidates are ranked in a small window by `PoseLoss`: all rotations in the place of the box; on a
# known table, all resting orientations there; or poses around a given one. CMA-ES refines the best distinct candidates
# in the small window. Those that share an outline with the best (`shape_symmetries`) join them in a finer window. For
# the best of these, the mask is found anew from where the object is drawn, and Gauss-Newton aligns it with that
# (`align`). What is found of the print decides between the last ones. Objects that most others show not to be where
# they were found, or that are in doubt, are looked for again, on the table and behind what hides them. Cameras must be
# given; the light need not be known.


_COARSE_SIDE, _FINE_SIDE, _SHARP_SIDE = 44, 130, 240  # of a box [px]
COARSE_ACROSS, FINE_ACROSS = 36, 110  # surfels along an object's diameter
_LEAST_SPACING_M = 1.2e-3
_ROTATIONS = 3000
_AROUND = 400
_RANKED, _ALIKE_DEG = 24, 12.0
_KEPT, _APART_DEG = 6, 15.0
_NEAR_DEG = 6.0  # between candidates around a given pose
_TURNED, _COMPARED = 2, 5  # poses whose shape's symmetries are tried; poses that are refined in the finer window
_ALIGNED = 3
_MOST_NEARER, _DISTANCES = 0.08, 33  # share of the distance from the camera, and how many are tried
_FEWEST_DRAWN = 60  # pixels of an outline from which a mask can be found
_OFF_TABLE = 0.15  # of loss, by which an object must look better elsewhere than on the table that others stand on


@dataclass(frozen=True, eq=False, slots=True)
class PhotoConfig:
    """Settings of `estimate_photo`.

    Attributes:
        starts: initial poses `T_world_object`, by name of the object; objects without one are searched in all
            rotations.
        loss: "all", or "iou" for the outline alone, as in the paper.
        focal_known: whether the photograph's focal length is known and not a guess.
    """

    starts: Mapping[str, Pose] = field(default_factory=dict)
    loss: LossKind = "all"
    focal_known: bool = True


class PhotoModels:
    """Surfels and stable orientations of fields, computed when they are first needed.

    Args:
        fields: fields of the objects, by name.
    """

    def __init__(self, fields: Mapping[str, KiloOSF]) -> None:
        self._fields = dict(fields)
        self._surfels: dict[tuple[str, int], Surfels] = {}
        self._resting: dict[str, RestingOrientations] = {}
        self._symmetries: dict[str, Pose] = {}

    def check(self, name: str) -> None:
        """Check that an object has a field.

        Raises:
            UnknownName: if it has none.
        """
        if name not in self._fields:
            raise UnknownName("field", name, sorted(self._fields))

    def surfels(self, name: str, across: int) -> Surfels:
        """Return surfels of an object, about `across` of them along its diameter."""
        key = name, across
        if key not in self._surfels:
            self.check(name)
            box = self._fields[name].extent
            diameter = float(np.linalg.norm(box[1] - box[0]))
            self._surfels[key] = surfels_of(self._fields[name], max(diameter / across, _LEAST_SPACING_M))
        return self._surfels[key]

    def resting(self, name: str) -> RestingOrientations:
        """Return the resting orientations of an object."""
        if name not in self._resting:
            self.check(name)
            self._resting[name] = resting_orientations(self._fields[name])
        return self._resting[name]

    def table_prior(self, name: str) -> TablePrior:
        """Return the prior of a table on an object's pose."""
        return TablePrior(self.resting(name))

    def symmetries(self, name: str) -> Pose:
        """Return motions of an object that change hardly anything but its print, see `shape_symmetries`."""
        if name not in self._symmetries:
            self._symmetries[name] = shape_symmetries(self.surfels(name, COARSE_ACROSS))
        return self._symmetries[name]


def estimate_photo(
    models: PhotoModels, photos: Photos, names: Sequence[str], rng: Rng, config: PhotoConfig | None = None
) -> Iterator[PhotoStep]:
    """Find objects in photos, one after the other. The last step has all of them.

    Args:
        models: models of the objects.
        photos: photos of one scene; each object has a mask in at least one.
        names: names of the objects.
        rng: random generator of the searches.
        config: settings.

    Raises:
        UnknownName: if an object has no field.
        InvalidInput: without photographs or masks, or if a photograph without a board shares no object with others.
    """
    config = config or PhotoConfig()
    if not photos:
        raise InvalidInput("number of photos", 0, "1 or more")
    for name in names:
        models.check(name)
        object_windows(photos, name, _COARSE_SIDE)
    on_table = all(photo.on_table for photo in photos)
    check_shared([photo.masks.keys() for photo in photos], [photo.on_table for photo in photos])
    groups = [photos] if on_table else [[photo] for photo in photos]
    asked = [(k, name) for k, group in enumerate(groups) for name in names if any(name in p.masks for p in group)]
    total, alone = len(asked) + len(names) + 1, [list[PhotoObject]() for _ in groups]
    for done, (k, name) in enumerate(asked):
        where = f" in photo {k + 1}" if len(groups) > 1 else ""
        yield PhotoStep(Progress(done, total, f"Looking for {name}{where}"), tuple(alone[0]))
        alone[k].append(find_object(models, groups[k], name, rng, config if k == 0 else replace(config, starts={})))
    found, factor = alone[0], None
    if len(groups) > 1:
        yield PhotoStep(Progress(len(asked), total, "Comparing the photos"), tuple(found))
        before, (photos, factor, tried) = photos[0], _placed(models, photos, alone, config)
        T = photos[0].T_world_camera @ before.T_world_camera.inverse()
        config = replace(config, starts={name: T @ pose for name, pose in config.starts.items()})
        names = [name for name in names if any(name in photo.masks for photo in photos)]
        found = [find_object(models, photos, name, rng, config, tried[name], is_placed=True) for name in names]
    fitting = [one for one in found if fits_outline(one.best)]
    if len(groups) == 1 and not (photos[0].on_table or config.focal_known) and len(fitting) >= _FEWEST_OBJECTS:
        search = _FocalSearch(models, _seen(photos[0], found), fitting, config)
        total = total + len(_FOCAL_FACTORS)
        for done, guess in enumerate(_FOCAL_FACTORS, len(names)):
            focal = guess * photos[0].intrinsics[0, 0]
            yield PhotoStep(Progress(done, total, f"Trying a focal length of {focal:.0f} pixels"), tuple(found))
            search.try_out(guess)
        if (factor := search.best()) is not None:
            found = [search.moved(one, factor) for one in found]
            photos = [_with_focal(photos[0], factor)]
    table, T = None, Pose.identity()
    if not any(photo.on_table for photo in photos):
        table = table_from_objects([models.table_prior(name) for name in names], [o.best.pose for o in found])
    if table is not None:
        T = table.T_world_camera
        photos = [replace(photo, T_world_camera=T @ photo.T_world_camera, on_table=True) for photo in photos]
        found = [_moved(one, T) for one in found]
        config = replace(config, starts={name: T @ pose for name, pose in config.starts.items()})
    for number, name in enumerate(names):
        if len(names) > 1 and (table is not None or found[number].doubt):
            given = tuple(_moved(one, T.inverse()) for one in found)
            yield PhotoStep(Progress(total - len(names) + number - 1, total, f"Looking again for {name}"), given)
            found[number] = _found_again(models, photos, found, number, table, rng, config)
    photos = [
        _seen(
            replace(
                photo, T_world_camera=T.inverse() @ photo.T_world_camera, on_table=photo.on_table and table is None
            ),
            found,
            number,
        )
        for number, photo in enumerate(photos)
    ]
    found = tuple(_moved(one, T.inverse()) for one in found)
    yield PhotoStep(Progress(total, total, "All objects were looked for"), found, table, tuple(photos), factor)


def _placed(
    models: PhotoModels, photos: Photos, alone: Sequence[Sequence[PhotoObject]], config: PhotoConfig
) -> tuple[list[Photograph], float | None, dict[str, Pose]]:
    """Find where photographs were taken from the objects that they share.

    Returns:
        The photographs with their cameras, those that do not fit the others without masks; the factor of an unknown
        focal length; and poses of each object that are worth a closer look.
    """
    sights = []
    for photo, its in zip(photos, alone, strict=True):
        each = {one.name: (one.best, *one.rivals) for one in its}
        T = photo.T_world_camera.inverse()
        sights.append(
            {n: Sight(T @ Pose.stacked(p.pose for p in ps), np.array([p.score for p in ps])) for n, ps in each.items()}
        )
    names = {name for sight in sights for name in sight}
    shapes = {name: Shape(models.surfels(name, COARSE_ACROSS).radius, models.symmetries(name)) for name in names}
    on_table = any(photo.on_table for photo in photos)
    known = [photo.T_world_camera if photo.on_table else None for photo in photos] if on_table else ()
    focal_known = config.focal_known or on_table
    placement = place_cameras(sights, shapes, known, focal_known=focal_known)
    factor = None if focal_known else placement.focal_factor
    placed = []
    for photo, T, its in zip(photos, placement.cameras, alone, strict=True):
        if T is None:
            placed.append(photo.with_masks({}, {}))
            continue
        there = photo if factor is None else _with_focal(photo, factor)
        placed.append(_seen(replace(there, T_world_camera=T, on_table=on_table), its))
    agreed = sorted(placement.poses)
    views = [[k for k in range(len(photos)) if (k, name) in placement.agreeing] for name in agreed]
    losses = [
        PoseLoss(
            object_windows([placed[k] for k in its], name, _SHARP_SIDE),
            models.surfels(name, FINE_ACROSS),
            models.table_prior(name) if on_table else None,
            config.loss,
        )
        for name, its in zip(agreed, views, strict=True)
    ]
    where = [k for k, T in enumerate(placement.cameras) if T is not None]
    free = {k for k in where if not photos[k].on_table} - (set() if on_table else {where[0]})
    start = [Pose.identity() if T is None else T for T in placement.cameras]
    poses, adjusted = align_together(losses, [placement.poses[name] for name in agreed], start, views, free)
    if agreed and not on_table:  # sizes alone show how far away everything is; the world's origin is a camera
        there = [T.inverse() for T in adjusted]
        losses = [
            replace(
                loss, windows=tuple(replace(w, T_camera_world=there[k]) for w, k in zip(loss.windows, its, strict=True))
            )
            for loss, its in zip(losses, views, strict=True)
        ]
        nearness = _nearness(losses, poses)
        poses, adjusted = ([Pose(nearness * T.position, T.quaternion) for T in each] for each in (poses, adjusted))
    cameras = tuple(None if T is None else other for T, other in zip(placement.cameras, adjusted, strict=True))
    tried = {name: [pose[None]] for name, pose in zip(agreed, poses, strict=True)}
    for k, (photo, T, sight) in enumerate(zip(photos, cameras, sights, strict=True)):
        if T is not None:
            placed[k] = replace(placed[k], T_world_camera=T)
            for name, its in sight.items():
                seen = [
                    seen_through(its.poses[j], photo.intrinsics, placed[k].intrinsics) for j in range(len(its.losses))
                ]
                tried.setdefault(name, []).append(T @ Pose.stacked(seen))
    return placed, factor, {name: Pose.joined(*its) for name, its in tried.items()}


def _moved(found: PhotoObject, T: Pose) -> PhotoObject:
    """Return an object in another world."""
    best, *rivals = (replace(each, pose=T @ each.pose) for each in (found.best, *found.rivals))
    return replace(found, best=best, rivals=tuple(rivals))


def _found_again(
    models: PhotoModels,
    photos: Photos,
    found: Sequence[PhotoObject],
    number: int,
    table: TableGuess | None,
    rng: Rng,
    config: PhotoConfig,
) -> PhotoObject:
    """Search an object behind the others, on their table; return it as it was if that explains it better.

    An object that stands there without a doubt is no more than aligned with it.
    """
    before = found[number]
    surfels = {other.name: models.surfels(other.name, FINE_ACROSS) for other in found}
    seen = without_others(photos, before.name, found, surfels)
    tried = Pose.stacked(each.pose for each in (before.best, *before.rivals))
    is_sure = table is not None and number in table.supported and not before.doubt
    try:
        now = find_object(models, seen, before.name, rng, config, tried, is_placed=is_sure)
    except InvalidInput:  # hardly anything is left of its mask
        return before
    worse = now.best.loss - before.best.loss
    taken = now if worse < (0 if table is None else _OFF_TABLE) else before
    times = {"coarse_s": before.coarse_s + now.coarse_s, "refine_s": before.refine_s + now.refine_s}
    return replace(taken, **times)


def _ranked(poses: Sequence[PhotoPose], name: str) -> list[PhotoPose]:
    """Return poses by their scores, without those that look like better ones: an object may be symmetric."""
    symmetry = CATALOGUE[name].symmetry if name in CATALOGUE else Symmetry("none", reason="nothing is known")
    ranked: list[PhotoPose] = []
    for one in sorted(poses, key=lambda pose: pose.score):
        apart = (rotation_error(symmetry, one.pose.quaternion, other.pose.quaternion) for other in ranked)
        if all(angle > np.deg2rad(_APART_DEG) for angle in apart):
            ranked.append(one)
    return ranked


def find_object(
    models: PhotoModels,
    photos: Photos,
    name: str,
    rng: Rng,
    config: PhotoConfig,
    tried: Pose | None = None,
    *,
    is_placed: bool = False,
) -> PhotoObject:
    """Search one object.

    Args:
        models: models of the objects.
        photos: photos of one scene, at least one of them with its box or mask.
        name: name of the object.
        rng: random generator of the search.
        config: settings.
        tried: poses to try besides.
        is_placed: whether one of these is right to a few degrees, so that nothing else has to be tried.
    """
    start, surfels = time.perf_counter(), {a: models.surfels(name, a) for a in (COARSE_ACROSS, FINE_ACROSS)}
    table = models.table_prior(name) if all(photo.on_table for photo in photos) else None
    coarse, fine = (
        PoseLoss(object_windows(photos, name, side), surfels[across], table, config.loss)
        for side, across in ((_COARSE_SIDE, COARSE_ACROSS), (_FINE_SIDE, FINE_ACROSS))
    )
    middle = start
    if tried is None or not is_placed:
        poses = _candidates(models, coarse, name, rng, config, tried)
        middle = time.perf_counter()
        poses, losses = cma_search(fine, poses, 0.35, rng, _ALIGNED)
    else:
        poses, losses = tried, fine(tried)
    poses = poses[distinct(poses, losses, _ALIGNED, _NEAR_DEG)]
    aligned = [_aligned(photos, fine, poses[k], name) for k in range(len(poses.position))]
    best, *rivals = _ranked([pose for pose, _ in aligned], name)
    best, seen = _aligned(photos, fine, best.pose, name)
    doubt = doubt_of(name, best, rivals, replace(fine, windows=object_windows(seen, name, _FINE_SIDE)))
    masks = tuple(photo.masks.get(name) for photo in seen)
    return PhotoObject(name, best, tuple(rivals), doubt, middle - start, time.perf_counter() - middle, masks)


def _candidates(
    models: PhotoModels, coarse: PoseLoss, name: str, rng: Rng, config: PhotoConfig, tried: Pose | None
) -> Pose:
    """Return the poses that are worth a closer look, from a small window."""
    given = config.starts.get(name)
    if given is not None:
        candidates, alike, apart = poses_around(given, coarse.windows[0], _AROUND, rng), _NEAR_DEG, _NEAR_DEG
        ranked = candidates[distinct(candidates, coarse(candidates), _KEPT, alike)]
    else:
        spread = super_fibonacci(_ROTATIONS if coarse.table is None else _ROTATIONS // 3)
        candidates, apart = poses_from_box(coarse, spread), _APART_DEG
        if coarse.table is not None:
            candidates = Pose.joined(candidates, poses_on_table(coarse, models.resting(name)))
        if tried is not None:
            candidates = Pose.joined(candidates, tried)
        ranked = candidates[distinct(candidates, coarse(candidates), _RANKED, _ALIKE_DEG)]
    poses, losses = cma_search(coarse, ranked, 1.0, rng, _GOING_ON)
    poses = poses[distinct(poses, losses, _KEPT, apart)]
    if given is None:
        symmetries = models.symmetries(name)
        turned = [poses[k] @ symmetries for k in range(min(_TURNED, len(poses.position)))]
        poses = Pose.joined(*turned, poses[_TURNED:])
        fine = PoseLoss(coarse.windows, models.surfels(name, COARSE_ACROSS), coarse.table, coarse.kind)
        poses = poses[distinct(poses, fine(poses), _COMPARED, _ALIKE_DEG)]
    return poses


def _aligned(photos: Photos, fine: PoseLoss, pose: Pose, name: str) -> tuple[PhotoPose, Photos]:
    """Align a pose with masks that are found anew where boxes were drawn; return it and the photographs with these."""
    seen = [_masked(photo, name, fine.surfels, pose) for photo in photos]
    sharp = replace(fine, windows=object_windows(seen, name, _SHARP_SIDE))
    pose = align(sharp, pose)[0]
    if fine.table is None and len(sharp.windows) == 1 and any(name in photo.boxes for photo in photos):
        camera = sharp.windows[0].T_camera_world.inverse().position
        pose = Pose(camera + _nearness([sharp], [pose]) * (pose.position - camera), pose.quaternion)
    terms = replace(fine, windows=object_windows(seen, name, _FINE_SIDE)).terms(pose[None])
    loss, iou, explained, correlation = (
        float(v[0]) for v in (terms.losses, terms.iou, terms.explained, terms.correlation)
    )
    return PhotoPose(pose, loss, iou, explained, correlation, print_match(sharp, pose)), seen


def _nearness(losses: Sequence[PoseLoss], poses: Sequence[Pose]) -> float:
    """Return the factor of all distances from the cameras at which the losses are least.

    A mask that was found from a box and lacks parts of an object makes it look farther away. The loss sees that these
    look like the object.
    """
    factors, total = 1 + np.linspace(-_MOST_NEARER, _MOST_NEARER, _DISTANCES), np.zeros(_DISTANCES)
    for loss, pose in zip(losses, poses, strict=True):
        for window in loss.windows:
            camera = window.T_camera_world.inverse().position
            moved_ = camera + factors[:, None] * (pose.position - camera)
            one = replace(loss, windows=(window,), table=None)
            total += one(Pose(moved_, np.tile(pose.quaternion, (_DISTANCES, 1))))
    k = int(np.clip(np.argmin(total), 1, _DISTANCES - 2))
    left, middle, right = total[k - 1 : k + 2]
    shift = float(np.clip(0.5 * (left - right) / max(left - 2 * middle + right, 1e-9), -1, 1))
    return float(factors[k] + shift * (factors[1] - factors[0]))


def _masked(photo: Photograph, name: str, surfels: Surfels, pose: Pose) -> Photograph:
    """Return a photograph in which a proposed mask is replaced by one that is found where the object is drawn."""
    if name not in photo.boxes:
        return photo
    window = object_windows([photo], name, _SHARP_SIDE)[0]
    others = np.any([np.zeros_like(photo.masks[name]), *(m for n, m in photo.masks.items() if n != name)], axis=0)
    drawn = window.frame.placed((draw(surfels, window, pose[None])[0][0] >= 0).astype(np.float32), others.shape)
    drawn &= ~(others & ~photo.masks[name])
    if drawn.sum() < _FEWEST_DRAWN:
        return photo
    frame, mask = window.frame, np.zeros_like(drawn)
    part = np.s_[max(frame.top, 0) : frame.bottom, max(frame.left, 0) : frame.right]  # a photo may be large
    mask[part] = mask_near(to_uint8(srgb_of_linear(photo.image[part])), drawn[part])
    return photo.with_masks({**{n: m & ~mask for n, m in photo.masks.items()}, name: mask})
