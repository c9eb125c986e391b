"""From sightings of the board to a camera, the error to expect on the table, and whether they tell enough.

Whether photographs tell focal length from distance is decided by the standard deviation of the focal length, which
J^T J and the residuals' variance give, not by the angles at which they were taken.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import CorruptFile, InvalidInput, OsfError, check_ranges, shown
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.photo.board import Board
from osfcore.photo.calibration.camera_fit import CameraFit, PoseVector, fit_camera, pose_of, px_scale
from osfcore.photo.calibration.information import (
    TableError,
    about_camera,
    covariance,
    normal_matrix,
    padded,
    table_error,
    total,
    with_later_pose,
    workspace_grid,
)
from osfcore.photo.calibration.next_view import Advice, best_next, usual_table_view
from osfcore.photo.calibration.sighting import Sighting
from osfcore.photo.lens import Lens

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
    """A camera as photographs of the board tell it.

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

    size: tuple[int, int]
    lens: Lens
    focal_std_px: float
    noise_px: float
    rms_px: dict[str, float]
    T_world_camera: Pose | None
    table: TableError
    advice: Advice | None
    missing: str


def board_place(x_m: float, y_m: float, turn_deg: float) -> Pose:
    """`T_world_board` of a board that lies on the table.

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


class TooLittleSeen(OsfError):
    """Photographs of the board that do not suffice to calibrate a camera."""


def calibrated_camera(
    views: Sequence[Sighting],
    table: Sighting | None = None,
    T_world_board: Pose = AT_ORIGIN,
    board: Board | None = None,
) -> Calibration:
    """The camera; arguments and errors as of `assess`.

    Raises:
        TooLittleSeen: also if the photographs do not suffice.
    """
    found = assess(views, table, T_world_board, board)
    if found.missing:
        raise TooLittleSeen(found.missing)
    return found


def assess(
    views: Sequence[Sighting],
    table: Sighting | None = None,
    T_world_board: Pose = AT_ORIGIN,
    board: Board | None = None,
) -> Calibration:
    """What photographs tell so far, whether or not they suffice.

    Args:
        views: of the board by one camera, from various sides.
        table: the board lying on the table, by that camera in the place where it stays.
        T_world_board: where the board lies then.
        board: that was printed; the default one if not given.

    Raises:
        InvalidInput: if there are no photographs or too many, or they contradict each other altogether.
        CorruptFile: naming one that has another size, is there twice, or contradicts the others.
    """
    every = [*views, *([] if table is None else [table])]
    _check_photos(every)
    fit = fit_camera(every)
    _check_agreement(every, fit)
    known = [normal_matrix(fit.theta, pose, v.points_m) for v, pose in zip(every, fit.poses, strict=True)]
    board, place = board or Board(), None if table is None else T_world_board
    on_table = _OnTable.of(fit, every[0].size, known, place, board)
    told = on_table.error()
    distance = float(np.median(np.linalg.norm(fit.poses[:, 3:], axis=1)))
    advice = best_next(fit.theta, every[0].size, distance, board, lambda more: on_table.error(more).mean_m)
    spread = fit.noise_px**2 * covariance(total(about_camera(normal) for normal in known))
    focal_std = float(np.sqrt(spread[0, 0]))
    return Calibration(
        every[0].size,
        fit.lens,
        focal_std * float(np.exp(fit.theta[0])),
        fit.noise_px,
        dict(zip(_different([view.name for view in every]), fit.rms_px.tolist(), strict=True)),
        None if table is None else T_world_board @ pose_of(fit.poses[-1]).inverse(),
        told,
        advice,
        _missing(len(every), focal_std, told, advice),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _OnTable:
    """What is known of a camera over the table.

    Attributes:
        fit: the camera.
        size: of its picture [px].
        about_camera: normal matrix over theta, of all photographs but that of the table.
        about_table: of the photograph of the table, over theta and pose.
        pose: of the board in that photograph.
        grid: the workspace in the board's frame [m].
        is_later: whether that photograph is not one of the calibration's, so that its pose alone follows from it.
    """

    fit: CameraFit
    size: tuple[int, int]
    about_camera: Float[np.ndarray, "4 4"]
    about_table: Float[np.ndarray, "10 10"]
    pose: PoseVector
    grid: Float[np.ndarray, "G 3"]
    is_later: bool

    @staticmethod
    def of(
        fit: CameraFit,
        size: tuple[int, int],
        normals: Sequence[Float[np.ndarray, "10 10"]],
        place: Pose | None,
        board: Board,
    ) -> _OnTable:
        """The last photograph shows the board on the table in its place; a usual one will if there is no place."""
        if place is not None:
            known, there = total(map(about_camera, normals[:-1])), place.inverse().apply(workspace_grid())
            return _OnTable(fit, size, known, normals[-1], fit.poses[-1], there, False)
        pose = usual_table_view(fit.theta, size)
        seen = normal_matrix(fit.theta, pose, board.corners_m())
        return _OnTable(fit, size, total(map(about_camera, normals)), seen, pose, workspace_grid(), True)

    def error(self, more: Float[np.ndarray, "4 4"] | float = 0.0) -> TableError:
        """To expect if `more` is known of the camera."""
        noise, known = self.fit.noise_px, self.about_camera + more
        if self.is_later:
            spread = with_later_pose(noise**2 * covariance(known), self.about_table, noise)
        else:
            spread = noise**2 * covariance(self.about_table + padded(known))
        return table_error(self.fit.theta, self.pose, spread, self.grid, self.size)


def _missing(count: int, focal_share: float, table: TableError, advice: Advice | None) -> str:
    """Why photographs do not suffice, a sentence; empty where they do.

    Args:
        count: of photographs.
        focal_share: standard deviation of the focal length, as a share of it.
        table: error to expect.
        advice: what to photograph next.
    """
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


def _different(names: Sequence[str]) -> list[str]:
    """Names with a number behind those that were there before: many phones call each photograph image.jpg."""
    return [f"{name} ({names[:k].count(name) + 1})" if name in names[:k] else name for k, name in enumerate(names)]


def _check_photos(every: Sequence[Sighting]) -> None:
    if not 1 <= len(every) <= MOST_PHOTOS:
        raise InvalidInput("number of photos of the board", len(every), f"{LEAST_PHOTOS} to {MOST_PHOTOS}")
    width, height = every[0].size
    for view in every[1:]:
        if view.size != (width, height):
            given = f"it has {view.size[0]} x {view.size[1]} pixels and {shown(every[0].name)} has {width} x {height}"
            raise CorruptFile(shown(view.name), f"{given}; take all with one camera held the same way up, uncropped")
    for one, other in itertools.combinations(every, 2):
        if len(one.points_px) == len(other.points_px) and np.abs(one.points_px - other.points_px).max() < _SAME_PX:
            raise CorruptFile(
                shown(other.name), f"it shows the same as {shown(one.name)}; move the board or the camera"
            )


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
            reason = (
                f"the board's corners in it lie {fit.rms_px[best]:.2g} px from where the other photos put them; "
                "take it anew with the same zoom and a flat sheet, or leave it out"
            )
            raise CorruptFile(shown(every[best].name), reason)
    if rms > MOST_RMS_PX * scale:
        allowed = f"at most {MOST_RMS_PX * scale:.1f}: take all photos with one camera and one zoom, and the sheet flat"
        raise InvalidInput(
            "mean distance of the board's corners from where one camera shows them [px]", round(rms, 1), allowed
        )
