"""Calibration of a camera from photographs of the board: the fit, its predicted errors, the next view, and the file."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares

from osfcore.errors import CorruptFile, InvalidInput, OsfError, check_ranges, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_from_matrix, quaternion_log
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, encode
from osfcore.photo.board import (
    ACCURACY_PX,
    FINE_PX,
    Board,
    Points,
    board_points_through_lens,
    camera_matrix,
    fit_focal,
    on_plane,
    planar_pose,
    px_scale,
)
from osfcore.photo.lens import Lens
from osfcore.photo.read_photograph import RawPhotograph

Points3 = Float[np.ndarray, "N 3"]
Theta = Float[np.ndarray, "4"]  # log f, cx, cy [px] and k1
Size = tuple[int, int]  # width and height [px]
PoseVector = Float[np.ndarray, "6"]  # rotation vector [rad] and translation [m]
ThetaMatrix = Float[np.ndarray, "4 4"]
JointMatrix = Float[np.ndarray, "10 10"]  # over theta and a pose

# The board in one photograph, as the calibration of a camera takes it.


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """Corners of the board's squares in a photograph.

    Attributes:
        name: of the photograph, for people.
        size: width and height of the photograph as it was sent [px].
        points_m: on the board, whose centre is the origin [m].
        points_px: where they were found, in pixels of the photograph as it was sent, distortion included.
        board: that was looked for.
    """

    name: str
    size: Size
    points_m: Points
    points_px: Points
    board: Board = field(default_factory=Board)


def sight(raw: RawPhotograph, name: str, board: Board) -> Sighting:
    """Find the board's corners in a photograph.

    Args:
        raw: the decoded photograph.
        name: of the photograph, for people.
        board: that it shows.

    Raises:
        CorruptFile: naming the photograph, if no board or too little of it is found, and why.
    """
    try:
        found, lens = board_points_through_lens(raw.eight_bit, board)
    except InvalidInput as error:
        raise CorruptFile(shown(name), str(error).rstrip(".")) from None
    points = found.points_px if lens is None else lens.bent(found.points_px)
    scale = np.divide(raw.sent_size, raw.encoded.shape[1::-1])
    return Sighting(name, raw.sent_size, found.points_m, points * scale, board)


# One camera that fits the board's corners in several photographs: nonlinear least squares over camera and poses.
#
# The camera has square pixels and one coefficient of radial distortion, as `osfcore.photo.board` has it. Its
# parameters are theta = (log f, cx, cy, k1); each photograph adds the board's pose in the camera's frame, a
# rotation vector and a translation.


INTRINSICS, POSE = 4, 6  # numbers of parameters
# Corners are off by 0.05 px, but alike in all of a photograph: on the table that counts as much as independent 0.1 px.
LEAST_NOISE_PX = 0.1
_MOST_FIRST_STD = 0.2  # relative, of a focal length to begin with
_MOST_STEPS = 200
_FARTHEST = 3.0  # of log f from where it began
_SAME_POSE = 0.01  # [rad, m]
_LOOSE = (1.0, 0.5, 0.5, 1.0)  # deviations of log f, of the principal point in longer sides, of k1; see `_descend`


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
        """The same camera as a lens."""
        return Lens(matrix(self.theta), (float(self.theta[3]),))


def matrix(theta: Theta) -> Float[np.ndarray, "3 3"]:
    """Return K [px]."""
    return camera_matrix(np.exp(theta[0]), theta[1], theta[2])


def seen(theta: Theta, pose: PoseVector, points: Points3) -> tuple[Points, Float[np.ndarray, "N 2 10"]]:
    """Project points of the board's frame [px], with the derivatives by theta and pose."""
    bend = np.array([theta[3], 0.0, 0.0, 0.0])
    pixels, by = cv2.projectPoints(points, pose[:3], pose[3:], matrix(theta), bend)
    by_log_f = np.exp(theta[0]) * (by[:, 6] + by[:, 7])
    return pixels.reshape(-1, 2), np.column_stack([by_log_f, by[:, 8:11], by[:, :6]]).reshape(-1, 2, INTRINSICS + POSE)


def pose_of(vector: PoseVector) -> Pose:
    """Return `T_camera_board` of a rotation vector and a translation."""
    return Pose(vector[3:].copy(), quaternion_from_matrix(cv2.Rodrigues(vector[:3])[0]))


def vector_of(T_camera_board: Pose) -> PoseVector:
    """Return the rotation vector and the translation of a pose: the inverse of `pose_of`."""
    return np.concatenate([quaternion_log(T_camera_board.quaternion), T_camera_board.position])


def fit_camera(views: Sequence[Sighting]) -> CameraFit:
    """Find the camera that minimises the squared distances of all corners from where they should appear.

    A plane seen from afar fits two poses almost equally well, and which is right may turn out only once the focal
    length is known: poses are begun anew from the first solution, and the better of the two solutions is taken.

    Args:
        views: of the board by one camera with one zoom, at least one.

    Raises:
        CorruptFile: naming a photograph that shows the board's back.
    """
    size = views[0].size
    fits = [fit_focal(view.points_m, view.points_px, size, ACCURACY_PX * px_scale(size)) for view in views]
    focals = [fit.focal for fit in fits if fit is not None and fit.focal_std < _MOST_FIRST_STD * fit.focal]
    focal = float(np.median(focals)) if focals else float(max(size))
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


def _poses(views: Sequence[Sighting], theta: Theta) -> Float[np.ndarray, "V 6"]:
    """Find the board's pose in each photograph, given the camera."""
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
    """Refine camera and poses by Levenberg and Marquardt's method.

    What the corners do not determine stays near where it began: each parameter of the camera has a prior so loose that
    it hardly moves one that they do determine (by less than 1e-6 of its value), and is not counted as information.
    """
    points, centre = [on_plane(view.points_m) for view in views], theta[0]
    side = max(views[0].size)
    pull = FINE_PX / np.multiply(_LOOSE, (1.0, side, side, 1.0))

    def at(x: Float[np.ndarray, "P"]) -> list[tuple[Points, Float[np.ndarray, "N 2 10"]]]:
        theta, poses = _split(x)
        bounded = np.append(np.clip(theta[0], centre - _FARTHEST, centre + _FARTHEST), theta[1:])
        return [seen(bounded, pose, its) for pose, its in zip(poses, points, strict=True)]

    def residuals(x: Float[np.ndarray, "P"]) -> Float[np.ndarray, "M"]:
        pairs = zip(at(x), views, strict=True)
        off = [(pixels - view.points_px).ravel() for (pixels, _), view in pairs]
        return np.concatenate([*off, pull * (x[:INTRINSICS] - theta)])

    def jacobian(x: Float[np.ndarray, "P"]) -> Float[np.ndarray, "M P"]:
        blocks = [by.reshape(-1, INTRINSICS + POSE) for _, by in at(x)]
        shared = np.concatenate([*(block[:, :INTRINSICS] for block in blocks), np.diag(pull)])
        own = block_diag(*(block[:, INTRINSICS:] for block in blocks), np.zeros((INTRINSICS, 0)))
        return np.hstack([shared, np.asarray(own)])

    start = np.concatenate([theta, poses.ravel()])
    how = {"method": "lm", "x_scale": "jac", "max_nfev": _MOST_STEPS}
    return least_squares(residuals, start, jacobian, **how)  # pyright: ignore[reportArgumentType]


# How well photographs of the board determine a camera, and what that means in millimetres on the table.
#
# The normal matrix J^T J of a photograph is over (theta, pose); with corners that scatter by s, J^T J / s^2 is the
# information that it brings. Poses of other photographs are eliminated (Schur complement), so that any number of
# them adds a 4 x 4 matrix over theta.


GRID_SIDE = 9  # points
_SINGULAR = 1e-13  # of the normal matrix with a diagonal of 1: below, rounding decides


@dataclass(frozen=True, slots=True)
class TableError:
    """How far from its place a table point may be located by its pixel: sqrt(E |error|^2), over the workspace's grid.

    Attributes:
        mean_m: of the points that the camera sees [m].
        worst_m: of these [m].
        seen_share: of the grid's points that the camera sees.
    """

    mean_m: float
    worst_m: float
    seen_share: float


def normal_matrix(theta: Theta, pose: PoseVector, points_m: Points) -> JointMatrix:
    """Return J^T J of one photograph, over theta and the pose."""
    rows = seen(theta, pose, on_plane(points_m))[1].reshape(-1, INTRINSICS + POSE)
    return rows.T @ rows


def about_camera(normal: JointMatrix) -> ThetaMatrix:
    """Return a photograph's information on theta, whatever the board's pose: the Schur complement of its block."""
    across = normal[:INTRINSICS, INTRINSICS:]
    return normal[:INTRINSICS, :INTRINSICS] - across @ np.linalg.solve(normal[INTRINSICS:, INTRINSICS:], across.T)


def covariance(information: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Return the inverse; very large, but finite, along what is unknown."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    return (vectors / np.maximum(values, _SINGULAR)) @ vectors.T / np.outer(scale, scale)


def workspace_grid() -> Points3:
    """Return a grid of points over the workspace [m]."""
    line = np.linspace(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, GRID_SIDE)
    return np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)


def in_picture(theta: Theta, pose: PoseVector, points: Points3, size: Size) -> Bool[np.ndarray, "G"]:
    """Return which points of the board's frame a camera sees."""
    pixels = seen(theta, pose, points)[0]
    is_before = pose_of(pose).apply(points)[:, 2] > 0
    return is_before & np.all((pixels > 0) & (pixels < size), axis=1)


def table_error(theta: Theta, pose: PoseVector, spread: JointMatrix, points: Points3, size: Size) -> TableError:
    """Predict the errors of table points that are located by their pixels u = pi(theta, pose, X), to first order.

        d X = -(d pi / d X)^-1 (d pi / d (theta, pose)) d (theta, pose),   X in the table's plane

    Args:
        theta: of the camera.
        pose: of the board on the table, in the camera's frame.
        spread: covariance of theta and pose.
        points: of the table, in the board's frame [m].
        size: width and height of the picture [px].

    Returns:
        The errors of the points in the picture; infinite if there are none.
    """
    inside = in_picture(theta, pose, points, size)
    if not inside.any():
        return TableError(float("inf"), float("inf"), 0.0)
    by = seen(theta, pose, points[inside])[1]
    by_place = by[:, :, INTRINSICS + 3 :] @ cv2.Rodrigues(pose[:3])[0][:, :2]
    moves = np.linalg.solve(by_place, by)
    errors = np.sqrt(np.einsum("gip,pq,giq->g", moves, spread, moves))
    return TableError(float(errors.mean()), float(errors.max()), float(inside.mean()))


def with_later_pose(spread: ThetaMatrix, normal: JointMatrix, noise_px: float) -> JointMatrix:
    """Return the covariance of theta and of a pose that is found with theta fixed, in a photograph taken afterwards.

        d pose = -A_pp^-1 A_pt d theta + e,   Cov e = noise^2 A_pp^-1

    Args:
        spread: covariance of theta.
        normal: A, J^T J of that photograph.
        noise_px: of its corners along each axis [px].
    """
    own = np.linalg.inv(normal[INTRINSICS:, INTRINSICS:])
    follows = np.vstack([np.eye(INTRINSICS), -own @ normal[INTRINSICS:, :INTRINSICS]])
    whole = follows @ spread @ follows.T
    whole[INTRINSICS:, INTRINSICS:] += noise_px**2 * own
    return whole


# Which photograph would help a calibration most: hypothetical views of the board, compared by the error that is left.


_TILT_RAD = np.deg2rad(40.0)
_CORNER = 0.55  # of the way from the picture's middle to its corner
_NEAR = 0.6  # of the usual distance
_FACING = Pose(np.zeros(3), quaternion_exp(np.array([np.pi, 0.0, 0.0])))  # the board seen from straight above
_TABLE_ELEVATION_RAD = np.deg2rad(50.0)
_LEAST_TABLE_M, _MOST_TABLE_M = 0.3, 30.0
_LEAST_CORNERS = 6


@dataclass(frozen=True, slots=True)
class Advice:
    """What to photograph next.

    Attributes:
        words: what to do, as the end of a sentence.
        mean_m: error to expect on the table after that [m].
    """

    words: str
    mean_m: float


_TILT = "tilted by 30 to 45 degrees"
_IDEAS = (  # words; the board's tilt [rad]; place of its middle in the picture, -1 to 1; factor on the usual distance
    (f"show the board {_TILT} to the left or right", (0.0, _TILT_RAD, 0.0), (0.0, 0.0), 1.0),
    (f"show the board {_TILT} towards you or away", (_TILT_RAD, 0.0, 0.0), (0.0, 0.0), 1.0),
    (f"come nearer, with the board {_TILT}", (_TILT_RAD, 0.0, 0.0), (0.0, 0.0), _NEAR),
    *(
        (f"show the board, {_TILT}, in the {name} corner of the picture", (_TILT_RAD * x, _TILT_RAD * y, 0.0), at, 1.0)
        for name, at, (x, y) in (
            ("upper left", (-_CORNER, -_CORNER), (0.7, -0.7)),
            ("upper right", (_CORNER, -_CORNER), (0.7, 0.7)),
            ("lower left", (-_CORNER, _CORNER), (-0.7, -0.7)),
            ("lower right", (_CORNER, _CORNER), (-0.7, 0.7)),
        )
    ),
)


def best_next(
    theta: Theta, size: Size, corners: Points, distance_m: float, expected_m: Callable[[ThetaMatrix], float]
) -> Advice | None:
    """Return the idea after which the least error is to be expected; None if the board fits in the picture in none.

    Args:
        theta: of the camera.
        size: width and height of the picture [px].
        corners: of the board's squares [m].
        distance_m: from which photographs have been taken [m].
        expected_m: error on the table if the camera's normal matrix had this added [m].
    """
    found = []
    for words, tilt, middle, nearness in _IDEAS:
        pixel = np.array([*(np.array(size) / 2 * (1 + np.array(middle))), 1.0])
        place = nearness * distance_m * np.linalg.solve(matrix(theta), pixel)
        pose = vector_of(Pose(place, quaternion_exp(np.array(tilt))) @ _FACING)
        shown = corners[in_picture(theta, pose, on_plane(corners), size)]
        if len(shown) >= _LEAST_CORNERS and (nearness == 1 or len(shown) == len(corners)):
            found.append(Advice(words, expected_m(about_camera(normal_matrix(theta, pose, shown)))))
    return min((each for each in found if np.isfinite(each.mean_m)), key=lambda each: each.mean_m, default=None)


def usual_table_view(theta: Theta, size: Size) -> PoseVector:
    """Return the table's pose 50 degrees below a camera, where the workspace just fills the picture."""
    direction, corners = np.array([0.0, -np.cos(_TABLE_ELEVATION_RAD), np.sin(_TABLE_ELEVATION_RAD)]), workspace_grid()
    pose, distance = np.zeros(6), _LEAST_TABLE_M
    while distance < _MOST_TABLE_M:
        pose = vector_of(Camera.look_at("table", distance * direction, np.zeros(3)).T_world_camera.inverse())
        if in_picture(theta, pose, corners, size).all():
            break
        distance *= 1.05
    return pose


# From sightings of the board to a camera, the error to expect on the table, and whether they suffice.
#
# Whether photographs separate focal length from distance is decided by the standard deviation of the focal length,
# which J^T J and the residuals' variance give, not by the angles at which they were taken.


LEAST_PHOTOS, MOST_PHOTOS = 3, 30
MOST_FOCAL_STD = 0.01  # of the focal length
MOST_RMS_PX = 1.0  # of the corners, in photographs of usual size
_ODD_RMS_PX = 0.1  # below which photographs agree
_ODD_GAIN = 2.0  # factor on the residuals' variance that one photograph is to blame for
_ODD_RATIO = 1.4  # of its distances to the usual ones; from noise alone they hardly reach it
_SUSPECTS = 3  # photographs that may be to blame: those with the largest distances
_SAME_PX = 1e-3
AT_ORIGIN = Pose.identity()


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """A camera that was calibrated from photographs of the board.

    Attributes:
        size: width and height of its photographs [px].
        lens: K and distortion.
        focal_std_px: standard deviation of the focal length [px].
        noise_px: standard deviation of a corner along each axis [px].
        rms_px: distance of the corners from where they should appear, by name of the photograph [px].
        T_world_camera: where the camera stands; None without a photograph of the board on the table.
        table: error to expect on the table; without such a photograph in one that shows the whole workspace from 50 deg
            above the table, with the board in its middle.
        advice: what to photograph next; None if nothing helps.
        missing: why the photographs do not suffice, a sentence; empty where they do.
    """

    size: Size
    lens: Lens
    focal_std_px: float
    noise_px: float
    rms_px: dict[str, float]
    T_world_camera: Pose | None
    table: TableError
    advice: Advice | None
    missing: str


def board_place(x_m: float, y_m: float, turn_deg: float) -> Pose:
    """Return `T_world_board` of a board that lies on the table.

    Args:
        x_m: of its centre [m].
        y_m: of its centre [m].
        turn_deg: of its top edge from the x axis, counter-clockwise seen from above [deg].

    Raises:
        InvalidInput: if it does not lie on the table.
    """
    half = TABLE_SIDE_M / 2
    check_ranges(
        ("x of the board [m]", x_m, -half, half), ("y of the board [m]", y_m, -half, half),
        ("turn of the board [deg]", turn_deg, -360.0, 360.0),
    )  # fmt: skip
    return Pose(np.array([x_m, y_m, 0.0]), quaternion_exp(np.array([0.0, 0.0, np.deg2rad(turn_deg)])))


def calibrated_camera(
    views: Sequence[Sighting], table: Sighting | None = None, T_world_board: Pose = AT_ORIGIN
) -> Calibration:
    """Calibrate a camera; arguments and errors are those of `assess`.

    Raises:
        OsfError: also if the photographs do not suffice.
    """
    found = assess(views, table, T_world_board)
    if found.missing:
        raise OsfError(found.missing)
    return found


def assess(views: Sequence[Sighting], table: Sighting | None = None, T_world_board: Pose = AT_ORIGIN) -> Calibration:
    """Calibrate a camera as far as photographs determine it, whether or not they suffice.

    Args:
        views: of the board by one camera, from various sides.
        table: the board lying on the table, by that camera in the place where it stays.
        T_world_board: where the board lies then.

    Raises:
        InvalidInput: if there are no photographs or too many, or they contradict each other altogether.
        CorruptFile: naming one that has another size, is there twice, or contradicts the others.
    """
    every = [*views, *([] if table is None else [table])]
    _check_photos(every)
    fit, size = fit_camera(every), every[0].size
    _check_agreement(every, fit)
    normals = [normal_matrix(fit.theta, pose, v.points_m) for v, pose in zip(every, fit.poses, strict=True)]
    corners = every[0].board.corners_m()
    error_with = _error_on_table(fit, size, normals, corners, None if table is None else T_world_board)
    error = error_with(np.zeros((INTRINSICS, INTRINSICS)))
    distance = float(np.median(np.linalg.norm(fit.poses[:, 3:], axis=1)))
    advice = best_next(fit.theta, size, corners, distance, lambda more: error_with(more).mean_m)
    spread = fit.noise_px**2 * covariance(np.sum([about_camera(normal) for normal in normals], axis=0))
    focal_std = float(np.sqrt(spread[0, 0]))
    names = [view.name for view in every]  # many phones call each photograph image.jpg
    names = [f"{name} ({names[:k].count(name) + 1})" if name in names[:k] else name for k, name in enumerate(names)]
    rms_px = dict(zip(names, fit.rms_px.tolist(), strict=True))
    pose = None if table is None else T_world_board @ pose_of(fit.poses[-1]).inverse()
    missing, focal_std_px = _missing(len(every), focal_std, error, advice), focal_std * float(np.exp(fit.theta[0]))
    return Calibration(size, fit.lens, focal_std_px, fit.noise_px, rms_px, pose, error, advice, missing)


def _error_on_table(
    fit: CameraFit, size: Size, normals: Sequence[JointMatrix], corners: Points, place: Pose | None
) -> Callable[[ThetaMatrix], TableError]:
    """Return a function from further information on theta to the error to be expected on the table.

    Args:
        fit: the camera.
        size: of its picture [px].
        normals: matrices of its photographs.
        corners: of the board's squares [m].
        place: of the board on the table in the last of them; without, the error is that of a later photograph from a
            usual place, whose pose alone follows from it.
    """
    parts = [about_camera(normal) for normal in normals]
    if place is None:
        known, grid, pose = np.sum(parts, axis=0), workspace_grid(), usual_table_view(fit.theta, size)
        last = normal_matrix(fit.theta, pose, corners)
    else:
        known, grid, pose = np.sum(parts[:-1], axis=0), place.inverse().apply(workspace_grid()), fit.poses[-1]
        last = normals[-1]

    def error_with(more: ThetaMatrix) -> TableError:
        if place is None:
            spread = with_later_pose(fit.noise_px**2 * covariance(known + more), last, fit.noise_px)
        else:
            spread = fit.noise_px**2 * covariance(last + np.pad(known + more, (0, POSE)))
        return table_error(fit.theta, pose, spread, grid, size)

    return error_with


def _missing(count: int, focal_share: float, table: TableError, advice: Advice | None) -> str:
    """Return why photographs do not suffice, a sentence; empty where they do."""
    following = "" if advice is None else f"; in the next, {advice.words}"
    if count < LEAST_PHOTOS:
        what, allowed = "number of photos of the board", f"{LEAST_PHOTOS} or more, from different sides{following}"
        return str(InvalidInput(what, count, allowed))
    if focal_share > MOST_FOCAL_STD:
        most = f"at most {100 * MOST_FOCAL_STD:g}: these photos do not tell focal length from distance"
        percent = f"{100 * focal_share:.1f}" if focal_share < 1 else "more than 100"
        return str(InvalidInput("standard deviation of the focal length [%]", percent, f"{most}{following}"))
    if not table.seen_share:
        what, allowed = "part of the workspace in the photo of the table", "larger: check the place of the board"
        return str(InvalidInput(what, "none", allowed))
    return ""


def _check_photos(every: Sequence[Sighting]) -> None:
    if not 1 <= len(every) <= MOST_PHOTOS:
        raise InvalidInput("number of photos of the board", len(every), f"{LEAST_PHOTOS} to {MOST_PHOTOS}")
    width, height = every[0].size
    for view in every[1:]:
        if view.size != (width, height):
            given = f"it has {view.size[0]} x {view.size[1]} pixels and {shown(every[0].name)} has {width} x {height}"
            raise CorruptFile(shown(view.name), f"{given}; take all with one camera held the same way up, uncropped")
        if view.board != every[0].board:
            raise CorruptFile(shown(view.name), f"another board was looked for in it than in {shown(every[0].name)}")
    for one, other in itertools.combinations(every, 2):
        if len(one.points_px) == len(other.points_px) and np.abs(one.points_px - other.points_px).max() < _SAME_PX:
            reason = f"it shows the same as {shown(one.name)}; move the board or the camera"
            raise CorruptFile(shown(other.name), reason)


def _check_agreement(every: Sequence[Sighting], fit: CameraFit) -> None:
    """Refuse the photograph without which the others agree, or all of them if nobody is to blame."""
    scale = px_scale(every[0].size)
    rms = float(np.sqrt(2) * fit.scatter_px)
    if rms < _ODD_RMS_PX * scale:
        return
    if len(every) > LEAST_PHOTOS and fit.rms_px.max() > _ODD_RATIO * np.median(fit.rms_px):
        suspects = np.argsort(-fit.rms_px)[:_SUSPECTS].tolist()
        without = {k: fit_camera([view for n, view in enumerate(every) if n != k]).scatter_px for k in suspects}
        best = min(suspects, key=without.__getitem__)
        if _ODD_GAIN * without[best] ** 2 < fit.scatter_px**2:
            off = f"the board's corners in it lie {fit.rms_px[best]:.2g} px from where the other photos put them"
            what_to_do = "take it anew with the same zoom and a flat sheet, or leave it out"
            raise CorruptFile(shown(every[best].name), f"{off}; {what_to_do}")
    if rms > MOST_RMS_PX * scale:
        what = "mean distance of the board's corners from where one camera shows them [px]"
        allowed = f"at most {MOST_RMS_PX * scale:.1f}: take all photos with one camera and one zoom, and the sheet flat"
        raise InvalidInput(what, round(rms, 1), allowed)


# camera.json: a calibrated camera as a file.
#
#     {"name", "T_world_camera": 4x4 | null, "K": 3x3, "width", "height", "radial", "focal_std_px", "corner_std_px",
#      "expected_error_mm": {"mean", "worst"}, "reprojection_px": {photo: rms}}
#
# A camera as in scene.json, of photographs without distortion; `radial` is k1 of `osfcore.photo.lens.Lens`, which
# straightens them. Pixels are those of the photographs as they were sent.


class ExpectedError(Entry):
    """How far from its place a point of the table's workspace may be located."""

    mean: FiniteFloat = Field(description="[mm]")
    worst: FiniteFloat = Field(description="[mm]")


class CalibrationJson(Entry):
    """A calibrated camera."""

    name: Text
    T_world_camera: Matrix4 | None = Field(None, description="Maps camera coordinates to world coordinates [m].")
    K: Matrix3 = Field(description="Intrinsics [px], of photos without distortion.")
    width: int = Field(ge=1, description="[px]")
    height: int = Field(ge=1, description="[px]")
    radial: FiniteFloat = Field(0.0, description="k1 of the lens.")
    focal_std_px: FiniteFloat | None = Field(None, description="Standard deviation of the focal length.")
    corner_std_px: FiniteFloat | None = Field(None, description="By which corners of the board scatter.")
    expected_error_mm: ExpectedError | None = None
    reprojection_px: dict[Text, FiniteFloat] = Field({}, description="By photo, root mean square.")


def calibration_to_json(found: Calibration, name: str) -> dict[str, Any]:
    """Return a calibration as plain lists and numbers."""
    pose = None if found.T_world_camera is None else found.T_world_camera.matrix().tolist()
    is_seen = found.table.seen_share > 0
    error = ExpectedError(mean=1e3 * found.table.mean_m, worst=1e3 * found.table.worst_m) if is_seen else None
    return encode(
        CalibrationJson(
            name=name,
            T_world_camera=pose,
            K=found.lens.intrinsics.tolist(),
            width=found.size[0],
            height=found.size[1],
            radial=found.lens.radial,
            focal_std_px=found.focal_std_px,
            corner_std_px=found.noise_px,
            expected_error_mm=error,
            reprojection_px=dict(found.rms_px),
        )
    )
