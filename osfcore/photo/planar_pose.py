"""Where a camera stands that sees known points of the table plane, and its focal length."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, quaternion_from_matrix

_FOCAL_FLAGS = (
    cv2.CALIB_USE_INTRINSIC_GUESS
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)
UNTOLD = "focal length"  # of the error for a view that does not tell it
_MAX_FOCAL_STD = 0.03  # of the focal length
_FOCAL_RANGE = (0.3, 10.0)  # focal lengths of cameras, in longer sides of the image


def planar_pose(
    points_m: Float[np.ndarray, "N 2"], points_px: Float[np.ndarray, "N 2"], intrinsics: Float[np.ndarray, "3 3"]
) -> tuple[Pose, float]:
    """The pose of a camera that sees at least 4 points of the table plane.

    A plane seen from afar fits two poses almost equally well (Collins and Bartoli 2014); both are refined, and the
    one with the smaller reprojection error above the table is taken.

    Args:
        points_m: x, y of the points on the table, z = 0 [m].
        points_px: where they appear [px].
        intrinsics: of the camera [px].

    Returns:
        `T_world_camera`, and the root mean square distance of the points from where they should appear [px].

    Raises:
        InvalidInput: if the camera would have to be below the table.
    """
    points, pixels = np.pad(points_m, ((0, 0), (0, 1))), np.ascontiguousarray(points_px, float)
    _, rotations, translations, _ = cv2.solvePnPGeneric(points, pixels, intrinsics, None, flags=cv2.SOLVEPNP_IPPE)
    best: tuple[Pose, float] | None = None
    for start in zip(rotations, translations, strict=True):
        rotation, translation = cv2.solvePnPRefineLM(points, pixels, intrinsics, None, *start)
        seen, _ = cv2.projectPoints(points, rotation, translation, intrinsics, None)
        rms = float(np.sqrt(np.square(seen.reshape(-1, 2) - pixels).sum(axis=1).mean()))
        T_camera_world = Pose(translation.ravel(), quaternion_from_matrix(cv2.Rodrigues(rotation)[0]))
        T_world_camera = T_camera_world.inverse()
        if T_world_camera.position[2] > 0 and translation[2] > 0 and (best is None or rms < best[1]):
            best = T_world_camera, rms
    if best is None:
        raise InvalidInput(
            "side of the print that the photograph shows", "its back", "its front: mirror the photograph"
        )
    return best


def focal_length(
    points_m: Float[np.ndarray, "N 2"], points_px: Float[np.ndarray, "N 2"], size: tuple[int, int], accuracy_px: float
) -> tuple[float, float]:
    """The focal length from one view of a plane, for square pixels, no distortion and a centred principal point.

    Args:
        points_m: x, y of the points on the table [m].
        points_px: where they appear [px].
        size: width and height of the image [px].
        accuracy_px: the least error that is expected of the points, whatever their scatter [px].

    Returns:
        The focal length and its standard deviation [px].

    Raises:
        InvalidInput: if the standard deviation is above 3 %: seen from straight above, a plane looks the same through a
            long lens from afar as through a short one from near by.
    """
    fit = calibrated(points_m, points_px, size, accuracy_px)
    if fit is None or fit.focal_std > _MAX_FOCAL_STD * fit.focal:
        raise InvalidInput(
            UNTOLD, "unknown, and the print is too small in this view, or seen too steeply, to tell it",
            "given, or the photograph taken from near by and at a slant, 30 to 60 degrees above the table",
        )  # fmt: skip
    return fit.focal, fit.focal_std


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """A camera with square pixels and a centred principal point that fits one view of a plane.

    Attributes:
        focal: length [px].
        focal_std: its standard deviation [px].
        rotation: of the table in the camera's frame, a rotation vector [rad].
        translation: of the table's origin in it [m].
    """

    focal: float
    focal_std: float
    rotation: Float[np.ndarray, "3"]
    translation: Float[np.ndarray, "3"]


def calibrated(
    points_m: Float[np.ndarray, "N 2"], points_px: Float[np.ndarray, "N 2"], size: tuple[int, int], accuracy_px: float
) -> Calibration | None:
    """The camera whose focal length fits best; None if no usual focal length fits. Arguments as of `focal_length`."""
    points = [np.pad(points_m, ((0, 0), (0, 1))).astype(np.float32)]
    pixels = [np.ascontiguousarray(points_px, np.float32)]
    guess = cv2.initCameraMatrix2D(points, pixels, size)[0, 0]
    low, high = np.multiply(_FOCAL_RANGE, max(size))
    start = float(guess) if low < guess < high else float(max(size))
    matrix = np.array([[start, 0, size[0] / 2], [0, start, size[1] / 2], [0, 0, 1]])
    _, matrix, _, rotations, translations = cv2.calibrateCamera(
        points, pixels, size, matrix, np.zeros(5), flags=_FOCAL_FLAGS
    )
    seen, jacobian = cv2.projectPoints(points[0], rotations[0], translations[0], matrix, None)
    # The last pivot says how far the points move with the focal length in ways that no motion of the camera explains.
    columns = np.column_stack([jacobian[:, :6], jacobian[:, 6] + jacobian[:, 7]])
    pivot = abs(np.linalg.qr(columns).R[-1, -1])
    scatter_px = np.linalg.norm(seen.reshape(-1, 2) - pixels[0]) / np.sqrt(max(columns.shape[0] - columns.shape[1], 1))
    focal = float(matrix[0, 0])
    if not low < focal < high:
        return None
    deviation = float(max(scatter_px, accuracy_px) / max(pivot, 1e-12))
    return Calibration(focal, deviation, rotations[0].ravel(), translations[0].ravel())
