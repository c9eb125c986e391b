"""How well an object in a pose explains photographs: outline, shading and texture.

    L = (1 - IoU) + w_r * residual + w_c * (1 - correlation) [+ w_p * penalty of the table]

IoU compares the drawn outline with the mask, where that is known (the paper's loss for real photographs). Residual is
the relative error sqrt(sum (I - I')^2 / sum I^2) on the mask where I' = albedo * (a + b . n): ambient light and
first-order harmonics for each colour and view, by least squares, so that exposure, white balance and the lamp need
not be known. Correlation is that of both images after a band pass: it sees labels and edges, and no shading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int32

from osfcore.fields.ray_marching import ONE_AT_A_TIME
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.photo.poses.object_window import ObjectWindow
from osfcore.photo.poses.pose_kernels import TERMS, compare_poses, draw_poses
from osfcore.photo.poses.surfels import Surfels
from osfcore.photo.poses.table_prior import TablePrior

LossKind = Literal["all", "iou"]
_RESIDUAL, _CORRELATION, _TABLE = 1.0, 0.5, 1e-3  # weights
_LEAST_COMPARED = 0.3  # of the mask's plain pixels must be drawn for colours to count
_HALF_SIDE = 0.7  # of a surfel, in spacings


@dataclass(frozen=True, eq=False, slots=True)
class PoseTerms:
    """Parts of the loss of B poses, means over the photographs.

    Attributes:
        iou: intersection over union of drawn outline and mask.
        residual: relative error of the colours.
        correlation: of the band-passed images.
        losses: the whole.
    """

    iou: Float[np.ndarray, "B"]
    residual: Float[np.ndarray, "B"]
    correlation: Float[np.ndarray, "B"]
    losses: Float[np.ndarray, "B"]


class PoseLoss:
    """The loss of one object's poses in the world.

    Args:
        windows: of the photographs.
        surfels: of the object.
        table: what a known table tells; None where it is not known.
        kind: "all", or "iou" for the outline alone, as in the paper.
    """

    def __init__(
        self,
        windows: Sequence[ObjectWindow],
        surfels: Surfels,
        *,
        table: TablePrior | None = None,
        kind: LossKind = "all",
    ) -> None:
        self.windows, self.surfels, self.table, self.kind = tuple(windows), surfels, table, kind

    def __call__(self, poses: Pose) -> Float[np.ndarray, "B"]:
        """Losses of B poses."""
        return self.terms(poses).losses

    def terms(self, poses: Pose) -> PoseTerms:
        """Losses of B poses and what they consist of."""
        found = np.mean([_compare(self.surfels, window, poses) for window in self.windows], axis=0)
        few = found[:, 3] < _LEAST_COMPARED
        residual, correlation = np.where(few, 1.0, found[:, 1]), np.where(few, 0.0, found[:, 2])
        losses = 1 - found[:, 0]
        if self.kind == "all":
            losses = losses + _RESIDUAL * residual + _CORRELATION * (1 - correlation)
        if self.table is not None:
            losses = losses + _TABLE * self.table.penalties(poses)
        return PoseTerms(found[:, 0], residual, correlation, losses)


def draw(
    surfels: Surfels, window: ObjectWindow, poses: Pose
) -> tuple[Int32[np.ndarray, "B h w"], Float32[np.ndarray, "B h w"]]:
    """The number of the surfel that each pixel of a window shows, -1 where none, and its depth along z [m]."""
    local = window.T_camera_world @ poses
    index = np.empty((len(poses.position), *window.size), np.int32)
    depth = np.empty(index.shape, np.float32)
    with ONE_AT_A_TIME:
        draw_poses(
            surfels.points, surfels.normals, _half(surfels), *_numbers(local), lens(window.intrinsics), depth, index
        )
    return index, depth


def lens(intrinsics: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "4"]:
    """Focal lengths and principal point for compiled code."""
    return intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)


def _compare(surfels: Surfels, window: ObjectWindow, poses: Pose) -> Float[np.ndarray, "B 4"]:
    terms = np.empty((len(poses.position), TERMS))
    mask, known, plain = (np.ascontiguousarray(a).view(np.uint8) for a in (window.mask, window.known, window.plain))
    rotations, positions = _numbers(window.T_camera_world @ poses)
    with ONE_AT_A_TIME:
        compare_poses(surfels.points, surfels.normals, surfels.albedo, _half(surfels), rotations, positions,
                      lens(window.intrinsics), window.image, window.luminance, mask, known, plain, terms)  # fmt: skip
    return terms


def _numbers(local: Pose) -> tuple[np.ndarray, np.ndarray]:
    rotations = np.ascontiguousarray(quaternion_to_matrix(local.quaternion), np.float32)
    return rotations, np.ascontiguousarray(local.position, np.float32)


def _half(surfels: Surfels) -> np.float32:
    return np.float32(_HALF_SIDE * surfels.spacing)
