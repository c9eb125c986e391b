"""One camera that fits the board's corners in several photographs: nonlinear least squares over camera and poses.

The camera has square pixels and one coefficient of radial distortion, as `osfcore.photo.lens` has it. Its parameters
are theta = (log f, cx, cy, k1); each photograph adds the board's pose in the camera's frame, a rotation vector and a
translation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares

from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.geometry.poses import Pose, quaternion_from_matrix, quaternion_log
from osfcore.photo.board import ACCURACY_PX
from osfcore.photo.calibration.sighting import Sighting
from osfcore.photo.lens import FINE_PX, Lens
from osfcore.photo.planar_pose import calibrated, planar_pose

INTRINSICS, POSE = 4, 6  # numbers of parameters
# Corners are off by 0.05 px, but alike in all of a photograph: on the table that counts as much as independent 0.1 px.
LEAST_NOISE_PX = 0.1
_USUAL_SIDE = 1920  # [px]; in larger photographs corners scatter by more pixels
_TOLD = 0.2  # relative deviation of a focal length to begin with
_MOST_STEPS = 200
_FARTHEST = 3.0  # of log f from where it began
_SAME_POSE = 0.01  # [rad, m]
_LOOSE = (1.0, 0.5, 0.5, 1.0)  # deviations of log f, of the principal point in longer sides, of k1; see `_descend`

Theta = Float[np.ndarray, "4"]
PoseVector = Float[np.ndarray, "6"]


@dataclass(frozen=True, eq=False, slots=True)
class CameraFit:
    """A camera and where it saw the board.

    Attributes:
        theta: log f, cx, cy [px] and k1.
        poses: of the board in the camera's frame, view by view: rotation vector [rad] and translation [m].
        rms_px: root mean square distance of the corners from where they should appear, view by view [px].
        scatter_px: standard deviation of a corner along each axis, from the residuals' variance [px].
        noise_px: the same, but at least what is to be expected of real lenses, sheets and edges [px].
    """

    theta: Theta
    poses: Float[np.ndarray, "V 6"]
    rms_px: Float[np.ndarray, "V"]
    scatter_px: float
    noise_px: float

    @property
    def lens(self) -> Lens:
        """The camera as photographs take it."""
        return Lens(matrix(self.theta), float(self.theta[3]))


def px_scale(size: tuple[int, int]) -> float:
    """How many times more pixels errors may have in a photograph of this size than in a small one."""
    return max(1.0, max(size) / _USUAL_SIDE)


def matrix(theta: Theta) -> Float[np.ndarray, "3 3"]:
    """K [px]."""
    f = np.exp(theta[0])
    return np.array([[f, 0, theta[1]], [0, f, theta[2]], [0, 0, 1]])


def seen(
    theta: Theta, pose: PoseVector, points: Float[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 10"]]:
    """Where points appear [px], and the derivative by theta and pose."""
    bend = np.array([theta[3], 0.0, 0.0, 0.0])
    pixels, by = cv2.projectPoints(points, pose[:3], pose[3:], matrix(theta), bend)
    by_log_f = np.exp(theta[0]) * (by[:, 6] + by[:, 7])
    return pixels.reshape(-1, 2), np.column_stack([by_log_f, by[:, 8:11], by[:, :6]]).reshape(-1, 2, INTRINSICS + POSE)


def on_board(points_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Points of the board's plane in its frame [m]."""
    return np.pad(points_m, ((0, 0), (0, 1)))


def pose_of(vector: PoseVector) -> Pose:
    """`T_camera_board` of a rotation vector and a translation."""
    return Pose(vector[3:].copy(), quaternion_from_matrix(cv2.Rodrigues(vector[:3])[0]))


def vector_of(T_camera_board: Pose) -> PoseVector:
    """The inverse of `pose_of`."""
    return np.concatenate([quaternion_log(T_camera_board.quaternion), T_camera_board.position])


def fit_camera(views: Sequence[Sighting]) -> CameraFit:
    """The camera that minimises the squared distances of all corners from where they should appear.

    A plane seen from afar fits two poses almost equally well, and which is right may turn out only once the focal
    length is known: poses are begun anew from the first solution, and the better of the two solutions is taken.

    Args:
        views: of the board by one camera with one zoom, at least one.

    Raises:
        CorruptFile: naming a photograph that shows the board's back.
    """
    size = views[0].size
    focal = _first_focal(views)
    theta = np.array([np.log(focal), size[0] / 2, size[1] / 2, 0.0])
    first = _descend(views, theta, _poses(views, theta))
    theta, poses = _split(first.x)
    others, best = _poses(views, theta), first
    if not np.allclose(others, poses, atol=_SAME_POSE):
        best = min(first, _descend(views, theta, others), key=lambda fit: fit.cost)
    theta, poses = _split(best.x)
    ends = np.cumsum([len(view.points_m) for view in views])
    squares = np.square(best.fun[:-INTRINSICS].reshape(-1, 2)).sum(axis=1)
    rms = np.array([np.sqrt(part.mean()) for part in np.split(squares, ends[:-1])])
    variance = squares.sum() / max(2 * len(squares) - best.x.size, 1)
    scatter = float(np.sqrt(variance))
    return CameraFit(theta, poses, rms, scatter, max(scatter, LEAST_NOISE_PX * px_scale(size)))


def _first_focal(views: Sequence[Sighting]) -> float:
    """The median of those that single photographs tell; else the photograph's longer side."""
    size = views[0].size
    fits = [calibrated(view.points_m, view.points_px, size, ACCURACY_PX * px_scale(size)) for view in views]
    told = [fit.focal for fit in fits if fit is not None and fit.focal_std < _TOLD * fit.focal]
    return float(np.median(told)) if told else float(max(size))


def _poses(views: Sequence[Sighting], theta: Theta) -> Float[np.ndarray, "V 6"]:
    """The board's pose in each photograph, given the camera."""
    K, poses = matrix(theta), []
    for view in views:
        straight = cv2.undistortPoints(view.points_px[:, None], K, np.array([theta[3], 0, 0, 0]), P=K)[:, 0]
        if not np.all(np.isfinite(straight)):  # OpenCV's iteration diverges for distortions that no lens has
            straight = view.points_px
        try:
            poses.append(vector_of(planar_pose(view.points_m, straight, K)[0].inverse()))
        except InvalidInput as error:
            raise CorruptFile(shown(view.name), str(error).rstrip(".")) from None
    return np.array(poses)


def _split(x: Float[np.ndarray, "P"]) -> tuple[Theta, Float[np.ndarray, "V 6"]]:
    return x[:INTRINSICS], x[INTRINSICS:].reshape(-1, POSE)


def _descend(views: Sequence[Sighting], theta: Theta, poses: Float[np.ndarray, "V 6"]) -> OptimizeResult:
    """Levenberg and Marquardt's method.

    What the corners do not tell stays near where it began: each parameter of the camera has a prior so loose that it
    moves none that they do tell (by less than 1e-6 of its value), and is not counted as information.
    """
    points, centre, count = [on_board(view.points_m) for view in views], theta[0], len(poses) * POSE + INTRINSICS
    side = max(views[0].size)
    pull = FINE_PX / np.multiply(_LOOSE, (1.0, side, side, 1.0))

    def at(x: Float[np.ndarray, "P"]) -> list[tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 10"]]]:
        theta, poses = _split(x)
        bounded = np.append(np.clip(theta[0], centre - _FARTHEST, centre + _FARTHEST), theta[1:])
        return [seen(bounded, pose, its) for pose, its in zip(poses, points, strict=True)]

    def residuals(x: Float[np.ndarray, "P"]) -> Float[np.ndarray, "M"]:
        pairs = zip(at(x), views, strict=True)
        off = [(pixels - view.points_px).ravel() for (pixels, _), view in pairs]
        return np.concatenate([*off, pull * (x[:INTRINSICS] - theta)])

    def jacobian(x: Float[np.ndarray, "P"]) -> Float[np.ndarray, "M P"]:
        blocks = [by.reshape(-1, INTRINSICS + POSE) for _, by in at(x)]
        whole, row = np.zeros((sum(map(len, blocks)) + INTRINSICS, count)), 0
        for number, block in enumerate(blocks):
            rows, first = slice(row, row + len(block)), INTRINSICS + POSE * number
            whole[rows, :INTRINSICS], whole[rows, first : first + POSE] = block[:, :INTRINSICS], block[:, INTRINSICS:]
            row += len(block)
        whole[row:, :INTRINSICS] = np.diag(pull)
        return whole

    start = np.concatenate([theta, poses.ravel()])
    how = {"method": "lm", "x_scale": "jac", "max_nfev": _MOST_STEPS}
    return least_squares(residuals, start, jacobian, **how)  # pyright: ignore[reportArgumentType]
