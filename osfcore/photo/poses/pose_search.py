"""Search for an object's pose: over all rotations from the mask, around a given pose, and by CMA-ES from the best."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.estimation.search.cma_es import CMAES
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.photo.poses.object_window import ObjectWindow
from osfcore.photo.poses.pose_loss import PoseLoss, draw

_CENTRING_ROUNDS = 3
_MOST_CHANGE = 0.6  # of depth in one round
_PSI = 1.533751168755204288118041413  # the positive root of psi^4 = psi + 4
_LATERAL_PX, _DEPTH_SHARE, _TURN_RAD = 2.0, 0.03, 0.15  # CMA's first spread
_AROUND_LATERAL_M, _AROUND_DEPTH_SHARE, _AROUND_TURN_RAD = 0.015, 0.04, 0.25


def super_fibonacci(count: int) -> Float[np.ndarray, "count 4"]:
    """Unit quaternions spread evenly over all rotations (super-Fibonacci spirals; Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / _PSI
    r, big = np.sqrt(t), np.sqrt(1 - t)
    return np.stack([r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)], axis=1)


def poses_from_mask(loss: PoseLoss, quaternions: Float[np.ndarray, "K 4"]) -> Pose:
    """For each rotation the position at which the drawn outline has the centroid and the area of the mask.

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
    rows, columns = np.mgrid[: window.size[0], : window.size[1]] + 0.5
    for _ in range(_CENTRING_ROUNDS):
        index, _ = draw(loss.surfels, window, Pose(camera.apply(local), quaternions))
        shown = index >= 0
        found = np.maximum(shown.sum(axis=(1, 2)), 1)
        x, y = (shown * columns).sum(axis=(1, 2)) / found, (shown * rows).sum(axis=(1, 2)) / found
        shift = (centroid - np.stack([x, y], axis=1)) / K[[0, 1], [0, 1]] * local[:, 2:]
        share = np.clip(np.sqrt(found / area), _MOST_CHANGE, 1 / _MOST_CHANGE)
        shift[found <= 1] = 0
        local = np.concatenate([local[:, :2] + shift, local[:, 2:]], axis=1) * share[:, None]
    return Pose(camera.apply(local), quaternions)


def poses_around(pose: Pose, window: ObjectWindow, count: int, rng: np.random.Generator) -> Pose:
    """The given pose and random ones around it: about 1.5 cm sideways, 4 % nearer or farther, 15 degrees turned.

    Args:
        pose: of one object in the world.
        window: of a photograph: it tells what is sideways.
        count: of poses.
        rng: of the draws.
    """
    depth = (window.T_camera_world @ pose).position[2]
    scales = np.array([_AROUND_LATERAL_M, _AROUND_LATERAL_M, _AROUND_DEPTH_SHARE * depth, *[_AROUND_TURN_RAD] * 3])
    steps = rng.standard_normal((count, 6)) * scales
    steps[0] = 0
    return moved(pose, window, steps)


def moved(poses: Pose, window: ObjectWindow, steps: Float[np.ndarray, "B 6"]) -> Pose:
    """Poses shifted along a camera's axes [m] and turned about their origins by rotation vectors in its frame [rad]."""
    camera = window.T_camera_world.inverse()
    turns = quaternion_exp(rotate(camera.quaternion, steps[:, 3:]))
    quaternions = quaternion_multiply(turns, np.broadcast_to(poses.quaternion, (len(steps), 4)))
    return Pose(poses.position + rotate(camera.quaternion, steps[:, :3]), quaternions)


def distinct(poses: Pose, losses: Float[np.ndarray, "K"], count: int, least_deg: float) -> list[int]:
    """Numbers of the best poses whose rotations differ from those of better ones by `least_deg` or more."""
    kept: list[int] = []
    for k in np.argsort(losses):
        if not kept or rotation_angle(poses.quaternion[kept], poses.quaternion[k]).min() > np.deg2rad(least_deg):
            kept.append(int(k))
        if len(kept) == count:
            break
    return kept


def cma_search(
    loss: PoseLoss, starts: Pose, *, generations: int, population: int, spread: float, rng: np.random.Generator
) -> tuple[Pose, Float[np.ndarray, "K"]]:
    """One CMA-ES from each start; a generation of all is drawn as one batch.

    Args:
        loss: what is minimised.
        starts: K poses.
        generations: of each search.
        population: of each search.
        spread: first standard deviation, as a multiple of 2 pixels sideways, 3 % of the depth and 0.15 rad.
        rng: of the searches.

    Returns:
        The best pose of each search and its loss.
    """
    window = max(loss.windows, key=lambda w: int(w.mask.sum()))
    depths = (window.T_camera_world @ starts).position[:, 2]
    lateral = _LATERAL_PX * depths / window.intrinsics[0, 0]
    scales = spread * np.stack(
        [lateral, lateral, _DEPTH_SHARE * depths, *[np.full(len(depths), _TURN_RAD)] * 3], axis=1
    )
    searches = [CMAES(np.ones(6), population, rng) for _ in depths]
    position, quaternion = starts.position.copy(), starts.quaternion.copy()
    least = loss(starts)
    for _ in range(generations):
        asked = [search.ask() for search in searches]
        tried = Pose.joined(*(moved(starts[k], window, a * scales[k]) for k, a in enumerate(asked)))
        losses = loss(tried).reshape(len(searches), population)
        for k, search in enumerate(searches):
            search.tell(losses[k])
            best = int(np.argmin(losses[k]))
            if losses[k, best] < least[k]:
                least[k], number = losses[k, best], k * population + best
                position[k], quaternion[k] = tried.position[number], tried.quaternion[number]
    return Pose(position, quaternion), least
