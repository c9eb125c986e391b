"""Where to begin: positions from the masks, and every way an object can lie, ranked by the masked loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.masked_loss import RenderedObject, masked_loss, render_poses
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObjectView
from osfcore.estimation.objective.resting_orientations import RestingOrientations
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import rotate, rotation_angle
from osfcore.geometry.workspace import TABLE_SIDE_M

OVERHEAD = np.array([0.0, 0.0, 1.0])
_CENTRING_ROUNDS = 2
_MAX_STEP_M = 0.05
_HEIGHT_WEIGHT = 4.0  # how firmly an object lies on the table, against one view's line of sight
_MIN_PIXELS = 3.0
_DISTINCT_RAD = np.deg2rad(25.0)


@dataclass(frozen=True, eq=False, slots=True)
class RankedPoses:
    """Poses of one object from which a search may start, the best first.

    Attributes:
        positions: of the object's origin [m].
        quaternions: unit.
        losses: `masked_loss` of each.
    """

    positions: Float[np.ndarray, "K 3"]
    quaternions: Float[np.ndarray, "K 4"]
    losses: Float[np.ndarray, "K"]

    def best(self, count: int) -> RankedPoses:
        """The best `count`."""
        return RankedPoses(self.positions[:count], self.quaternions[:count], self.losses[:count])

    def distinct(self, count: int) -> RankedPoses:
        """The best `count` whose orientations differ by more than 25 degrees from better ones."""
        kept: list[int] = []
        for k in range(len(self.losses)):
            if all(rotation_angle(self.quaternions[k], self.quaternions[other]) > _DISTINCT_RAD for other in kept):
                kept.append(k)
            if len(kept) == count:
                break
        return RankedPoses(self.positions[kept], self.quaternions[kept], self.losses[kept])


def initial_poses(models: ObjectModels, name: str, part: ObjectView) -> RankedPoses:
    """Every way the object can lie, put where the masks are, ranked by the masked loss.

    Rendered under a light from overhead of unknown brightness, since the true one is not known yet.

    Args:
        models: fields.
        name: of the object.
        part: windows around its masks.
    """
    resting = models.resting(name)
    positions = _positions_along_rays(part, resting)
    for _ in range(_CENTRING_ROUNDS):
        look = render_poses(models, name, part, positions, resting.quaternions, OVERHEAD)
        positions = _centre_on_mask(look, part, positions)
    return rank_poses(models, name, part, positions, resting.quaternions, OVERHEAD, any_brightness=True)


def rank_poses(
    models: ObjectModels,
    name: str,
    part: ObjectView,
    positions: Float[np.ndarray, "K 3"],
    quaternions: Float[np.ndarray, "K 4"],
    light: Float[np.ndarray, "3"],
    *,
    any_brightness: bool = False,
) -> RankedPoses:
    """Poses in the order of their masked loss, the best first.

    Args:
        models: fields.
        name: of the object.
        part: windows around its masks.
        positions: of the object's origin [m].
        quaternions: rotations from the object's frame to the world, unit.
        light: unit vector toward the light.
        any_brightness: compare colours up to a factor, see `masked_loss`.
    """
    look = render_poses(models, name, part, positions, quaternions, light)
    losses = masked_loss(look, part, any_brightness=any_brightness)
    order = np.argsort(losses)
    return RankedPoses(positions[order], quaternions[order], losses[order])


def _positions_along_rays(part: ObjectView, resting: RestingOrientations) -> Float[np.ndarray, "K 3"]:
    """Positions at which the centre of mass is closest to the lines of sight through the masks' centroids.

    Its height over the table is nearly given by how the object lies, so one view is enough.
    """
    normal, target = np.zeros((3, 3)), np.zeros(3)
    for camera, mask, weight in zip(part.cameras, part.mask, np.sqrt(part.area / part.area.max()), strict=True):
        rows, columns = np.nonzero(mask > 0.5)
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        direction = camera.ray_directions(pixel)
        across = weight * (np.eye(3) - np.outer(direction, direction))
        normal += across
        target += across @ camera.T_world_camera.position
    up = np.diag([0.0, 0.0, _HEIGHT_WEIGHT])
    heights = np.outer(resting.heights, (0.0, 0.0, _HEIGHT_WEIGHT))
    centres = np.linalg.solve(normal + up, (target + heights).T).T
    centres[:, :2] = np.clip(centres[:, :2], -TABLE_SIDE_M / 2, TABLE_SIDE_M / 2)
    return centres - rotate(resting.quaternions, resting.centre)


def _centre_on_mask(
    look: RenderedObject, part: ObjectView, positions: Float[np.ndarray, "B 3"]
) -> Float[np.ndarray, "B 3"]:
    """Positions moved, by least squares over the views, so that silhouettes have the centroids of the masks."""
    wanted, _ = _centroids(part.mask * part.valid)
    found, sizes = _centroids(look.opacity * part.valid)
    normal = np.tile(np.diag([1e-3, 1e-3, 1e-3]), (len(positions), 1, 1))
    target = np.zeros((len(positions), 3))
    for view, camera in enumerate(part.cameras):
        slope = _projection_slope(camera, positions)
        slope = slope * (sizes[:, view] > _MIN_PIXELS)[:, None, None]
        normal += np.swapaxes(slope, 1, 2) @ slope
        target += np.einsum("bij,bi->bj", slope, wanted[view] - found[:, view])
    if len(part.cameras) == 1:  # one view cannot tell distance from size; the object lies on the table
        normal[:, 2, 2] += 1e9
    step = np.linalg.solve(normal, target[..., None])[..., 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return positions + step * np.minimum(1, _MAX_STEP_M / np.maximum(length, 1e-9))


def _centroids(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids (x, y) of images [px], and the sums of their pixels."""
    rows, columns = np.mgrid[: weights.shape[-2], : weights.shape[-1]] + 0.5
    total = weights.sum(axis=(-2, -1))
    moments = np.stack([(weights * columns).sum(axis=(-2, -1)), (weights * rows).sum(axis=(-2, -1))], axis=-1)
    return moments / np.maximum(total, 1e-6)[..., None], total


def _projection_slope(camera: Camera, points: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B 2 3"]:
    """How pixel coordinates change with a point in the world [px / m]."""
    inverse = camera.T_world_camera.inverse().matrix()
    x, y, z = (points @ inverse[:3, :3].T + inverse[:3, 3]).T
    z = np.maximum(z, 1e-3)
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    zero = np.zeros_like(x)
    slope = np.stack([np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1)
    return slope @ inverse[:3, :3]
