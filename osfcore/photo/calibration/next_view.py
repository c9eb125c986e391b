"""Which photograph would help a calibration most: hypothetical views of the board, each by what it would tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.photo.board import Board
from osfcore.photo.calibration.camera_fit import PoseVector, Theta, matrix, on_board, vector_of
from osfcore.photo.calibration.information import about_camera, in_picture, normal_matrix, workspace_grid

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


@dataclass(frozen=True, slots=True)
class _Idea:
    """A view of the board.

    Attributes:
        words: what to do.
        tilt: of the board, a rotation vector in the camera's frame [rad].
        place: of its middle in the picture, -1 to 1 along both axes.
        nearness: factor on the usual distance.
    """

    words: str
    tilt: tuple[float, float, float]
    place: tuple[float, float] = (0.0, 0.0)
    nearness: float = 1.0


_TILT = "tilted by 30 to 45 degrees"
_IDEAS = (
    _Idea(f"show the board {_TILT} to the left or right", (0.0, _TILT_RAD, 0.0)),
    _Idea(f"show the board {_TILT} towards you or away", (_TILT_RAD, 0.0, 0.0)),
    _Idea(f"come nearer, with the board {_TILT}", (_TILT_RAD, 0.0, 0.0), (0.0, 0.0), _NEAR),
    *(
        _Idea(
            f"show the board, {_TILT}, in the {name} corner of the picture", (_TILT_RAD * x, _TILT_RAD * y, 0.0), place
        )
        for name, place, (x, y) in (
            ("upper left", (-_CORNER, -_CORNER), (0.7, -0.7)),
            ("upper right", (_CORNER, -_CORNER), (0.7, 0.7)),
            ("lower left", (-_CORNER, _CORNER), (-0.7, -0.7)),
            ("lower right", (_CORNER, _CORNER), (-0.7, 0.7)),
        )
    ),
)


def best_next(
    theta: Theta,
    size: tuple[int, int],
    distance_m: float,
    board: Board,
    expected_m: Callable[[Float[np.ndarray, "4 4"]], float],
) -> Advice | None:
    """The idea after which the least error is to be expected; None if the board fits in the picture in none.

    Args:
        theta: of the camera.
        size: width and height of the picture [px].
        distance_m: from which photographs have been taken [m].
        board: that is photographed.
        expected_m: error on the table if the camera's normal matrix had this added [m].
    """
    told = []
    for idea in _IDEAS:
        pose = _view(idea, theta, size, distance_m)
        corners = board.corners_m()
        shown = corners[in_picture(theta, pose, on_board(corners), size)]
        if len(shown) >= _LEAST_CORNERS and (idea.nearness == 1 or len(shown) == len(corners)):
            told.append(Advice(idea.words, expected_m(about_camera(normal_matrix(theta, pose, shown)))))
    return min((each for each in told if np.isfinite(each.mean_m)), key=lambda each: each.mean_m, default=None)


def _view(idea: _Idea, theta: Theta, size: tuple[int, int], distance_m: float) -> PoseVector:
    """The board's pose in the camera's frame."""
    pixel = np.array([*(np.array(size) / 2 * (1 + np.array(idea.place))), 1.0])
    place = idea.nearness * distance_m * np.linalg.solve(matrix(theta), pixel)
    return vector_of(Pose(place, quaternion_exp(np.array(idea.tilt))) @ _FACING)


def usual_table_view(theta: Theta, size: tuple[int, int]) -> PoseVector:
    """The table 50 degrees below a camera, from where the workspace just fills the picture; in the camera's frame."""
    direction, corners = np.array([0.0, -np.cos(_TABLE_ELEVATION_RAD), np.sin(_TABLE_ELEVATION_RAD)]), workspace_grid()
    pose, distance = np.zeros(6), _LEAST_TABLE_M
    while distance < _MOST_TABLE_M:
        pose = vector_of(Camera.look_at("table", distance * direction, np.zeros(3)).T_world_camera.inverse())
        if in_picture(theta, pose, corners, size).all():
            break
        distance *= 1.05
    return pose
