"""Poses of objects in photographs, from masks: search, alignment of surfels, doubts, and the objects' table."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, map_coordinates

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import resting_orientations
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
from osfcore.photo.board import Intrinsics, camera_matrix
from osfcore.photo.photograph import Photograph
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
        loss: loss whose windows, surfels and table are used. If the result is clearly worse by it than the best pose on
            the way, that pose is returned.
        start: initial pose, within about a centimetre and ten degrees of the solution.

    Returns:
        The pose and its loss.
    """
    prepared = [_prepare(window, loss.surfels, start) for window in loss.windows]
    first = float(loss(start[None])[0])
    pose, best, least, value = start, start, first, first
    for _ in range(_ITERATIONS):
        normal, right = _normal_equations(prepared, loss, pose)
        step = np.linalg.solve(normal + np.diag(_DAMPING * np.diag(normal) + 1e-9), right)
        depth = float(np.linalg.norm((loss.windows[0].T_camera_world @ pose).position))
        shift, turn = step[:3], step[3:]
        shift *= min(1.0, _MOST_SHIFT * depth / max(float(np.linalg.norm(shift)), 1e-12))
        turn *= min(1.0, _MOST_TURN_RAD / max(float(np.linalg.norm(turn)), 1e-12))
        pose = Pose(pose.position + shift, quaternion_multiply(quaternion_exp(turn), pose.quaternion))
        value = float(loss(pose[None])[0])
        if value < least:
            best, least = pose, value
        if np.linalg.norm(shift) < _LEAST_SHIFT * depth and np.linalg.norm(turn) < _LEAST_TURN_RAD:
            break
    return (pose, value) if value < first + _WORSE else (best, least)


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
    terms, std_px = [], _BORDER_STD_PX if loss.table is None else _BORDER_STD_ON_TABLE_PX
    for part in prepared:
        index, _ = draw(loss.surfels, part.window, pose[None])
        terms.append(_outline_terms(part, loss.surfels, pose, index[0], std_px))
        if loss.kind == "all":
            terms.append(_colour_terms(part, loss.surfels, pose, index[0]))
    normal, right = (np.sum([_CORRELATED * term[k] for term in terms], axis=0) for k in (0, 1))
    if loss.table is None:
        return normal, right
    more_normal, more_right = loss.table.normal_equations(pose)
    return normal + more_normal, right + more_right


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


# Search for an object's pose: over all rotations from the mask, around a given pose, and by CMA-ES from the best.


_CENTRING_ROUNDS = 3
_MOST_CHANGE = 0.6  # of depth in one round
_PSI = 1.533751168755204288118041413  # the positive root of psi^4 = psi + 4
_LATERAL_PX, _DEPTH_SHARE, _TURN_RAD = 2.0, 0.03, 0.15  # CMA's first spread
_GENERATIONS, _POPULATION = 14, 14
_AROUND_LATERAL_M, _AROUND_DEPTH_SHARE, _AROUND_TURN_RAD = 0.015, 0.04, 0.25


def super_fibonacci(count: int) -> Float[np.ndarray, "count 4"]:
    """Return unit quaternions spread evenly over all rotations (super-Fibonacci spirals; Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / _PSI
    r, big = np.sqrt(t), np.sqrt(1 - t)
    return np.stack([r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)], axis=1)


def poses_from_mask(loss: PoseLoss, quaternions: Float[np.ndarray, "K 4"]) -> Pose:
    """Find for each rotation the position at which the drawn outline has the centroid and the area of the mask.

    The photograph with the largest mask decides.

    Args:
        loss: whose windows and surfels are used.
        quaternions: rotations from the object's frame to the world, unit.
    """
    window = max(loss.windows, key=lambda w: int(w.mask.sum()))
    K, centroid, area = window.intrinsics, window.centroid, float(window.mask.sum())
    ray = np.linalg.solve(K, [*centroid, 1.0])
    depth = K[0, 0] * loss.surfels.radius / np.sqrt(area / np.pi)
    local = np.tile(ray * depth, (len(quaternions), 1))
    camera = window.T_camera_world.inverse()
    rows, columns = (np.arange(side) + 0.5 for side in window.size)
    for _ in range(_CENTRING_ROUNDS):
        index, _ = draw(loss.surfels, window, Pose(camera.apply(local), quaternions))
        shown = index >= 0
        per_row, per_column = shown.sum(axis=2), shown.sum(axis=1)
        found = np.maximum(per_row.sum(axis=1), 1)
        x, y = per_column @ columns / found, per_row @ rows / found
        shift = (centroid - np.stack([x, y], axis=1)) / K[[0, 1], [0, 1]] * local[:, 2:]
        share = np.clip(np.sqrt(found / area), _MOST_CHANGE, 1 / _MOST_CHANGE)
        shift[found <= 1] = 0
        local = np.concatenate([local[:, :2] + shift, local[:, 2:]], axis=1) * share[:, None]
    return Pose(camera.apply(local), quaternions)


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


def cma_search(loss: PoseLoss, starts: Pose, spread: float, rng: np.random.Generator) -> tuple[Pose, Losses]:
    """Run one CMA-ES from each start; a generation of all is drawn as one batch.

    Args:
        loss: what is minimised.
        starts: K poses.
        spread: first standard deviation, as a multiple of 2 pixels sideways, 3 % of the depth and 0.15 rad.
        rng: random generator of the searches.

    Returns:
        The best pose of each search and its loss.
    """
    window = max(loss.windows, key=lambda w: int(w.mask.sum()))
    depths = (window.T_camera_world @ starts).position[:, 2]
    lateral = _LATERAL_PX * depths / window.intrinsics[0, 0]
    turns = [np.full(len(depths), _TURN_RAD)] * 3
    scales = spread * np.stack([lateral, lateral, _DEPTH_SHARE * depths, *turns], axis=1)
    searches = [CMAES(np.ones(6), _POPULATION, rng) for _ in depths]
    position, quaternion = starts.position.copy(), starts.quaternion.copy()
    least = loss(starts)
    for _ in range(_GENERATIONS):
        asked = [search.ask() for search in searches]
        tried = Pose.joined(*(moved(starts[k], window, a * scales[k]) for k, a in enumerate(asked)))
        losses = loss(tried).reshape(len(searches), _POPULATION)
        for k, search in enumerate(searches):
            search.tell(losses[k])
            best = int(np.argmin(losses[k]))
            if losses[k, best] < least[k]:
                least[k], number = losses[k, best], k * _POPULATION + best
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

    def try_out(self, focal: float) -> None:
        """Return the cost of a focal length [px]."""
        poses, losses = [], []
        for one in self._found:
            pose, loss = self._aligned(one, one.best.pose, focal)
            poses.append(pose)
            losses.append(loss)
        priors = [self._models.table_prior(one.name) for one in self._found]
        table = table_from_objects(priors, poses)
        self._costs[focal] = sum(losses) + _NOT_ON_TABLE * len(poses)
        if table is not None:
            placed = [(table.T_world_camera @ pose)[None] for pose in poses]
            off = sum(float(prior.penalties(pose)[0]) for prior, pose in zip(priors, placed, strict=True))
            self._costs[focal] = sum(losses) + _ON_TABLE_WEIGHT * off

    def best(self) -> float | None:
        """Return the focal length of least cost [px]; None if it is at an end of the grid, or no table was found."""
        focals = np.array(sorted(self._costs))
        costs = np.array([self._costs[focal] for focal in focals])
        k = int(np.argmin(costs))
        if k in (0, len(costs) - 1) or costs[k] >= _NOT_ON_TABLE * len(self._found):
            return None
        left, middle, right = costs[k - 1 : k + 2]
        shift = 0.5 * (left - right) / max(left - 2 * middle + right, 1e-9)
        return float(focals[k] * (focals[k + 1] / focals[k]) ** np.clip(shift, -0.5, 0.5))

    def moved(self, one: PhotoObject, focal: float) -> PhotoObject:
        """Return an object with its poses for a camera of this focal length, the best first."""
        loss, sharp = (self._loss(one, focal, side) for side in (_FINE_SIDE, _SHARP_SIDE))
        poses = Pose.stacked(self._aligned(one, each.pose, focal)[0] for each in (one.best, *one.rivals))
        best, *rivals = _ranked(poses, _photo_poses(poses, loss, sharp))
        return replace(one, best=best, rivals=tuple(rivals), doubt=doubt_of(one.name, best, rivals, loss))

    def _aligned(self, one: PhotoObject, pose: Pose, focal: float) -> tuple[Pose, float]:
        K = self._photo.intrinsics
        return align(self._loss(one, focal, _FINE_SIDE), seen_through(pose, K, _with_focal(K, focal)))

    def _loss(self, one: PhotoObject, focal: float, side: int) -> PoseLoss:
        photo = replace(self._photo, intrinsics=_with_focal(self._photo.intrinsics, focal))
        windows = object_windows([photo], one.name, side)
        return PoseLoss(windows, self._models.surfels(one.name, FINE_ACROSS), kind=self._config.loss)


def _with_focal(K: Intrinsics, focal: float) -> Intrinsics:
    return camera_matrix(focal, float(K[0, 2]), float(K[1, 2]))


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
        residual: relative error of the colours.
        correlation: correlation of the band-passed images.
        match: share of the print that is found again, see `print_match`.
    """

    pose: Pose
    loss: float
    iou: float
    residual: float
    correlation: float
    match: float


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
    """

    name: str
    best: PhotoPose
    rivals: tuple[PhotoPose, ...]
    doubt: str
    coarse_s: float
    refine_s: float


@dataclass(frozen=True, eq=False, slots=True)
class PhotoStep:
    """One step of the estimation.

    Attributes:
        progress: how far the work has come.
        found: objects found so far, in the photographs' world.
        table: table found from the objects if no photograph shows a board; only in the last step.
        intrinsics: K with the focal length found from the objects, if it was unknown [px]; only in the last step.
    """

    progress: Progress
    found: tuple[PhotoObject, ...]
    table: TableGuess | None = None
    intrinsics: Intrinsics | None = None

    def as_seen(self, photo: Photograph) -> Photograph:
        """Return the photograph with the focal length that was found, if there is one."""
        return photo if self.intrinsics is None else replace(photo, intrinsics=self.intrinsics)


# Reasons not to trust a pose in a photograph, one sentence each.


LEAST_RATIO = 1.15  # loss of another orientation over that of the best
_FOUND_PRINT, _MORE_PRINT = 0.6, 0.15  # match of a pose that its print makes sure, and by how much more than others'
_LEAST_IOU = 0.85
_MOST_RESIDUAL = 0.55
_MOST_CUT = 0.1  # of the mask's border lies on the photo's edge


def fits_outline(best: PhotoPose) -> bool:
    """Return whether the drawn outline fits the mask."""
    return best.iou >= _LEAST_IOU


def has_its_print(best: PhotoPose, others: Sequence[PhotoPose]) -> bool:
    """Return whether the print of a pose is found again, and that of other orientations clearly less."""
    return best.match >= max([_FOUND_PRINT, *(other.match + _MORE_PRINT for other in others)])


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
    if best.residual > _MOST_RESIDUAL:
        return f"{name} does not look like what the photo shows there; check the name and the mask."
    if rivals and rivals[0].loss < LEAST_RATIO * best.loss and not has_its_print(best, rivals):
        return f"{name} looks nearly the same in another orientation; choose between the two pictures."
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
    fits its mask are removed from the mask of the object `name`.

    Args:
        photos: photos with masks.
        name: name of the object. Photographs without a mask of it are not changed.
        found: all objects.
        surfels: surfels of each object, by name.
    """
    seen = []
    for photo in photos:
        masks = dict(photo.masks)
        for other in found:
            if name not in masks or other.name == name or other.name not in masks:
                continue
            window = object_windows([photo], other.name, _SIDE)[0]
            index, _ = draw(surfels[other.name], window, other.best.pose[None])
            shown = (index[0] >= 0).astype(np.float32)
            drawn = window.frame.placed(shown, masks[name].shape)  # as far as its window reaches
            if fits_outline(other.best):
                masks[name] = masks[name] & ~(drawn & masks[other.name])
            masks[other.name] = masks[other.name] | drawn
        seen.append(replace(photo, masks=masks) if name in masks else photo)
    return seen


# Poses of known objects in photographs: from masks and fields alone, or from poses that another program gives.
#
# For each object, candidates are ranked in a small window by outline, shading and texture (`PoseLoss`). Candidates are
# all rotations at the place of the mask, or poses around a given one. CMA-ES refines the best distinct candidates in
# the small window and then in a finer one. Gauss-Newton aligns the best of these (`align`). Cameras and masks must be
# given; the light need not be known.


_COARSE_SIDE, _FINE_SIDE, _SHARP_SIDE = 44, 130, 240  # of a mask [px]
COARSE_ACROSS, FINE_ACROSS = 36, 110  # surfels along an object's diameter
_LEAST_SPACING_M = 1.2e-3
_ROTATIONS = 3000
_AROUND = 400
_RANKED, _ALIKE_DEG = 40, 12.0
_KEPT, _APART_DEG = 8, 15.0
_NEAR_DEG = 6.0  # between candidates around a given pose
_ALIGNED = 4


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
        self._priors: dict[str, TablePrior] = {}

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

    def table_prior(self, name: str) -> TablePrior:
        """Return the prior of a table on an object's pose."""
        if name not in self._priors:
            self.check(name)
            self._priors[name] = TablePrior(resting_orientations(self._fields[name]))
        return self._priors[name]


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
        InvalidInput: without photographs or masks, or with several photographs that do not share a table.
    """
    config = config or PhotoConfig()
    on_table = [photo.on_table for photo in photos]
    if not photos or not (all(on_table) or len(photos) == 1):
        given = f"{len(photos)}, {sum(on_table)} of them with a known table"
        raise InvalidInput("number of photos", given, "1, or more that all show the board on the table")
    for name in names:
        models.check(name)
        object_windows(photos, name, _COARSE_SIDE)
    found: list[PhotoObject] = []
    for number, name in enumerate(names):
        yield PhotoStep(Progress(number, len(names) + 1, f"Looking for {name}"), tuple(found))
        found.append(find_object(models, photos, name, rng, config))
    again = [number for number, one in enumerate(found) if not fits_outline(one.best)] if len(found) > 1 else []
    total, seen = len(names) + len(again) + 1, {name: photos for name in names}
    for done, number in enumerate(again, len(names)):
        yield PhotoStep(Progress(done, total, f"Looking for {names[number]} behind the others"), tuple(found))
        found[number], seen[names[number]] = _found_behind(models, photos, found, number, rng, config)
    intrinsics = None
    fitting = [one for one in found if fits_outline(one.best)]
    if not (on_table[0] or config.focal_known) and len(fitting) >= _FEWEST_OBJECTS:
        search, total = _FocalSearch(models, photos[0], fitting, config), total + len(_FOCAL_FACTORS)
        for done, factor in enumerate(_FOCAL_FACTORS, len(names) + len(again)):
            focal = factor * photos[0].intrinsics[0, 0]
            yield PhotoStep(Progress(done, total, f"Trying a focal length of {focal:.0f} pixels"), tuple(found))
            search.try_out(focal)
        if (focal := search.best()) is not None:
            intrinsics = _with_focal(photos[0].intrinsics, focal)
            found = [search.moved(one, focal) for one in found]
            photos = [replace(photos[0], intrinsics=intrinsics)]
            seen = {name: [replace(its[0], intrinsics=intrinsics)] for name, its in seen.items()}
    yield PhotoStep(Progress(total - 1, total, "The table that they lie on"), tuple(found))
    table = None
    if not on_table[0]:
        table = table_from_objects([models.table_prior(name) for name in names], [o.best.pose for o in found])
        if table is not None:
            for k in table.supported:
                found[k] = _on_table(models, seen[found[k].name][0], found[k], table, config)
    yield PhotoStep(Progress(total, total, "All objects were looked for"), tuple(found), table, intrinsics)


def _found_behind(
    models: PhotoModels, photos: Photos, found: Sequence[PhotoObject], number: int, rng: Rng, config: PhotoConfig
) -> tuple[PhotoObject, Photos]:
    """Search an object in masks without the others; return both, or the old ones if it fits no better."""
    before = found[number]
    surfels = {other.name: models.surfels(other.name, FINE_ACROSS) for other in found}
    without = without_others(photos, before.name, found, surfels)
    try:
        now = find_object(models, without, before.name, rng, config)
    except InvalidInput:  # hardly anything is left of its mask
        return before, photos
    return (now, without) if now.best.iou > before.best.iou else (before, photos)


def _on_table(
    models: PhotoModels, photo: Photograph, found: PhotoObject, table: TableGuess, config: PhotoConfig
) -> PhotoObject:
    """Align an object again with a known table. Its pose stays in the camera's frame."""
    start, surfels = time.perf_counter(), models.surfels(found.name, FINE_ACROSS)
    seen = object_windows([replace(photo, T_world_camera=table.T_world_camera, on_table=True)], found.name, _SHARP_SIDE)
    sharp = PoseLoss(seen, surfels, models.table_prior(found.name), config.loss)
    plain, sharp_plain = (
        PoseLoss(object_windows([photo], found.name, side), surfels, kind=config.loss)
        for side in (_FINE_SIDE, _SHARP_SIDE)
    )
    pose = table.T_world_camera.inverse() @ align(sharp, table.T_world_camera @ found.best.pose)[0]
    best = _photo_poses(pose[None], plain, sharp_plain)[0]
    doubt = doubt_of(found.name, best, found.rivals, plain)
    return replace(found, best=best, doubt=doubt, refine_s=found.refine_s + time.perf_counter() - start)


def _photo_poses(poses: Pose, loss: PoseLoss, sharp: PoseLoss) -> list[PhotoPose]:
    """Return poses with the parts of each one's loss, and what is found of their print in sharp windows."""
    terms = loss.terms(poses)
    matches = [print_match(sharp, poses[k]) for k in range(len(terms.losses))]
    parts = zip(terms.losses, terms.iou, terms.residual, terms.correlation, matches, strict=True)
    return [PhotoPose(poses[k], *(float(v) for v in values)) for k, values in enumerate(parts)]


def _ranked(poses: Pose, ready: Sequence[PhotoPose]) -> list[PhotoPose]:
    """Return the best pose, then its rivals; the one whose print alone is found again comes first."""
    order = distinct(poses, np.array([pose.loss for pose in ready]), _ALIGNED, _APART_DEG)
    ranked = [ready[k] for k in order]
    first = max(ranked, key=lambda pose: pose.match)
    others = [pose for pose in ranked if pose is not first]
    return [first, *others] if has_its_print(first, others) else ranked


def find_object(models: PhotoModels, photos: Photos, name: str, rng: Rng, config: PhotoConfig) -> PhotoObject:
    """Search one object in its masks. Arguments are as in `estimate_photo`."""
    on_table = all(photo.on_table for photo in photos)
    table = models.table_prior(name) if on_table else None
    coarse, fine, sharp = (
        PoseLoss(object_windows(photos, name, side), models.surfels(name, across), table, config.loss)
        for side, across in ((_COARSE_SIDE, COARSE_ACROSS), (_FINE_SIDE, FINE_ACROSS), (_SHARP_SIDE, FINE_ACROSS))
    )
    start = time.perf_counter()
    given = config.starts.get(name)
    if given is None:
        candidates, alike = poses_from_mask(coarse, super_fibonacci(_ROTATIONS)), _ALIKE_DEG
    else:
        candidates, alike = poses_around(given, coarse.windows[0], _AROUND, rng), _NEAR_DEG
    ranked = candidates[distinct(candidates, coarse(candidates), _RANKED if given is None else _KEPT, alike)]
    poses, losses = cma_search(coarse, ranked, 1.0, rng)
    poses = poses[distinct(poses, losses, _KEPT, _APART_DEG if given is None else _NEAR_DEG)]
    middle = time.perf_counter()
    poses, losses = cma_search(fine, poses[:_ALIGNED], 0.35, rng)
    poses = Pose.stacked(align(sharp, poses[k])[0] for k in distinct(poses, losses, _ALIGNED, _NEAR_DEG))
    best, *rivals = _ranked(poses, _photo_poses(poses, fine, sharp))
    doubt = doubt_of(name, best, rivals, fine)
    return PhotoObject(name, best, tuple(rivals), doubt, middle - start, time.perf_counter() - middle)
