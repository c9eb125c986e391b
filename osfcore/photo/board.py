"""The printed calibration board, which gives the camera of one photograph of a table; single markers do it too.

The table frame: the print lies flat on the table, its centre is the origin, x runs along its top edge to the right, y
towards its top, z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.errors import InvalidInput, check_ranges
from osfcore.geometry.poses import Pose
from osfcore.photo.markers import Marker, find_markers, marker_dictionary
from osfcore.photo.pattern import NOTHING, PATCH_CORNERS, FoundPoints, Pattern, find_points, transform
from osfcore.photo.planar_pose import focal_length, planar_pose

PAGE_M = (0.297, 0.21)  # A4, landscape
TAG_DICTIONARY = "DICT_APRILTAG_36h11"
SQUARE_PIXELS = 384  # of a square of the board, when drawn
_MIN_MARGIN_M = 0.008
_MIN_CORNERS = 6
_CELL_PIXELS = 32  # of a cell of a tag, when drawn
_GUESS_PX = 2.0  # by which corners of markers may be off
_PLACE_PX = 3.0  # from where a marker should be
_STRAY_MARKERS = 2  # that are read by mistake in other things
_ALIKE = 0.15  # of a marker's side, and of a square's
_MIN_SIDE = 64
_TAG_POINTS = 4
_WORKING_SIDES = (1920, 3840)  # [px]; photographs are reduced to the first, or the second if the print is small in them
ACCURACY_PX = 0.05  # of points in a real photograph; lenses are not perfect
_MAX_RMS_PX = 2.0
_MAX_BLUR_PX = 1.6  # sharp photographs have 0.6 to 1.3, and markers of 15 px are lost above


@dataclass(frozen=True, slots=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares, on a landscape A4 page.

    The default was chosen by measurement: with smaller squares, or markers of 5 x 5 bits, the board is lost more often
    in 640 x 480 pixels from 1 m and 25 degrees above the table.

    Attributes:
        columns: of squares.
        rows: of squares.
        square_m: side of a square [m].
        marker_m: side of a marker with its black border [m].
        dictionary: of the markers, one of OpenCV's.
    """

    columns: int = 6
    rows: int = 4
    square_m: float = 0.044
    marker_m: float = 0.033
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        """Check that the board can be made and fits on the page."""
        if self.columns < 3 or self.rows < 3:
            raise InvalidInput("squares of the board", f"{self.columns} x {self.rows}", "at least 3 x 3")
        if not 0.3 * self.square_m <= self.marker_m <= 0.9 * self.square_m:
            raise InvalidInput("marker_m of the board", self.marker_m, "0.3 to 0.9 times square_m")
        for side, page in zip(self.size_m, PAGE_M, strict=True):
            if not 0 < side <= page - 2 * _MIN_MARGIN_M:
                allowed = f"at most {page - 2 * _MIN_MARGIN_M:.3f}, so that it fits on landscape A4 with a margin"
                raise InvalidInput("side of the board [m]", round(side, 4), allowed)
        known = len(marker_dictionary(self.dictionary).bytesList)
        if self.columns * self.rows // 2 > known:
            raise InvalidInput("squares of the board", f"{self.columns} x {self.rows}", f"at most {2 * known} in all")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    def corners_m(self) -> Float[np.ndarray, "N 2"]:
        """Where four squares meet, in the table frame [m]."""
        return self._in_table_frame(np.asarray(self._charuco().getChessboardCorners()))

    def markers_m(self) -> Float[np.ndarray, "M 4 2"]:
        """Corners of the markers by number, clockwise from the top left, in the table frame [m]."""
        return self._in_table_frame(np.asarray(self._charuco().getObjPoints()))

    def image(self) -> Bool[np.ndarray, "h w"]:
        """What is paper, not ink; 384 pixels a square."""
        size = self.columns * SQUARE_PIXELS, self.rows * SQUARE_PIXELS
        return np.asarray(self._charuco().generateImage(size, marginSize=0)) > 0

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        dictionary = marker_dictionary(self.dictionary)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)

    def _in_table_frame(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """From OpenCV's frame, whose origin is the board's top left and whose y points down."""
        return (points[..., :2] - np.array(self.size_m) / 2) * (1.0, -1.0)


@dataclass(frozen=True, eq=False, slots=True)
class BoardView:
    """What a photograph of a printed board or tag tells of its camera.

    Attributes:
        T_world_camera: pose of the camera in the table frame, whose origin is the print's centre.
        intrinsics: of the camera, 3 x 3 [px]; pixel centres at +0.5.
        is_focal_estimated: whether the focal length was found from this photograph.
        focal_std_px: its standard deviation [px]; 0 if it was given.
        reprojection_rms_px: root mean square distance of the points from where they should appear [px].
        points_m: that were found, on the table [m].
        points_px: where they were found in the photograph [px].
    """

    T_world_camera: Pose
    intrinsics: Float[np.ndarray, "3 3"]
    is_focal_estimated: bool
    focal_std_px: float
    reprojection_rms_px: float
    points_m: Float[np.ndarray, "N 2"]
    points_px: Float[np.ndarray, "N 2"]

    @property
    def corner_count(self) -> int:
        """How many points were found."""
        return len(self.points_m)


def locate_board(
    image: UInt8[np.ndarray, "h w *channels"], board: Board, intrinsics: Float[np.ndarray, "3 3"] | None = None
) -> BoardView:
    """The camera of a photograph that shows a board.

    Args:
        image: RGB or grey, as encoded by the camera, free of lens distortion.
        board: that was printed.
        intrinsics: of the camera [px]. If not given, the focal length is estimated, with the principal point in the
            image's middle.

    Raises:
        InvalidInput: if the image is no photograph, no board or too little of it is found, the view is too steep to
            tell the focal length, or the points do not fit the camera.
    """
    found = board_points(image, board)
    return board_view(found, (image.shape[1], image.shape[0]), intrinsics)


def board_points(image: UInt8[np.ndarray, "h w *channels"], board: Board) -> FoundPoints:
    """Corners of the board's squares in a photograph.

    Raises:
        InvalidInput: if the image is no photograph, or no board or too little of it is found.
    """
    grey = _grey(image)
    found = _search_scales(grey, lambda small: _board_points(small, board), _MIN_CORNERS)
    if len(found.points_m) < _MIN_CORNERS:
        raise _not_found(grey, "board", len(found.points_m))
    return found


def board_view(
    found: FoundPoints, size: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"] | None = None
) -> BoardView:
    """The camera that fits points best, in a photograph of this width and height [px]; see `locate_board`."""
    return _view(found, size, None if intrinsics is None else _checked_intrinsics(intrinsics))


def locate_tag(
    image: UInt8[np.ndarray, "h w *channels"],
    side_m: float,
    intrinsics: Float[np.ndarray, "3 3"],
    dictionary: str = TAG_DICTIONARY,
) -> BoardView:
    """The camera of a photograph that shows one AprilTag or ArUco marker, which lies flat on the table.

    Its four points are the centres of the tag's quarters, the white around it included.

    Args:
        image: RGB or grey, as encoded by the camera, free of lens distortion.
        side_m: of the tag's black border, without the white around it [m].
        intrinsics: of the camera [px].
        dictionary: which the tag comes from, one of OpenCV's.

    Raises:
        InvalidInput: if the image is no photograph, there is no such tag or more than one, or it does not fit the
            camera.
        UnknownName: if there is no such dictionary.
    """
    grey, given = _grey(image), _checked_intrinsics(intrinsics)
    check_ranges(("side of the tag [m]", side_m, 0.005, 1.0))
    known = marker_dictionary(dictionary)
    found = _search_scales(grey, lambda small: _tag_points(small, known, side_m), _TAG_POINTS)
    if len(found.points_m) < _TAG_POINTS:
        raise _not_found(grey, "tag", 0)
    return _view(found, grey.shape[::-1], given)


def _grey(image: UInt8[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w"]:
    image = np.asarray(image)
    is_image = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not is_image or min(image.shape[:2]) < _MIN_SIDE:
        given = f"an array of {image.dtype} of shape {image.shape}"
        raise InvalidInput("photograph", given, f"8 bit, RGB or grey, and at least {_MIN_SIDE} pixels high and wide")
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def _reduced(grey: UInt8[np.ndarray, "H W"], side: int) -> UInt8[np.ndarray, "h w"]:
    """A copy whose longer side is at most this long [px]."""
    scale = side / max(grey.shape)
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey


def _search_scales(
    grey: UInt8[np.ndarray, "h w"], search: Callable[[UInt8[np.ndarray, "h w"]], FoundPoints], enough: int
) -> FoundPoints:
    """The most that is found in reduced copies of a photograph, in its own pixels; the first that is enough serves."""
    best = NOTHING
    for side in _WORKING_SIDES:
        small = _reduced(grey, side)
        found = search(small)
        if len(found.points_m) > len(best.points_m):
            best = FoundPoints(found.points_m, found.points_px * np.divide(grey.shape[::-1], small.shape[::-1]))
        if len(best.points_m) >= enough or max(grey.shape) <= side:
            break
    return best


def _board_points(grey: UInt8[np.ndarray, "h w"], board: Board) -> FoundPoints:
    """Corners of a board; the patch around each is as large as a square."""
    markers_m = board.markers_m()
    markers = find_markers(grey, marker_dictionary(board.dictionary))
    read = [marker for marker in markers if marker.number < len(markers_m)]
    if not read:
        return NOTHING
    plane = np.concatenate([markers_m[marker.number] for marker in read])
    guess, _ = cv2.findHomography(plane, np.concatenate([m.corners_px for m in read]), cv2.RANSAC, _GUESS_PX)
    if guess is None:
        return NOTHING
    pattern = Pattern(board.image().astype(np.float32), board.size_m, board.corners_m(), board.square_m)
    found = find_points(grey, pattern, guess)
    if len(found.points_m):
        _check_layout(board, read, found)
        _check_extent(board, [marker for marker in markers if marker.number >= len(markers_m)], found)
    return found


def _check_extent(board: Board, others: list[Marker], found: FoundPoints) -> None:
    """Refuse a board with more rows: markers that this one lacks continue its squares."""
    homography, _ = cv2.findHomography(found.points_px, found.points_m)
    corners = transform(homography, np.reshape([marker.corners_px for marker in others], (-1, 4, 2)))
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    squares = (corners.mean(axis=1) + np.array(board.size_m) / 2) / board.square_m - 0.5  # whole in a square's middle
    continue_it = np.all(np.abs(sides / board.marker_m - 1) < _ALIKE, axis=1)
    continue_it &= np.all(np.abs(squares - np.round(squares)) < _ALIKE, axis=1)
    if continue_it.sum() >= _STRAY_MARKERS:
        raise _another_board(board)


def _another_board(board: Board) -> InvalidInput:
    told = f"{board.columns} x {board.rows} squares with markers of {board.dictionary}"
    return InvalidInput("board in the photograph", "another one", f"the one that was told, which has {told}")


def _check_layout(board: Board, markers: list[Marker], found: FoundPoints) -> None:
    """Refuse a board of another layout: its first squares look alike, and the scale would be wrong."""
    homography, _ = cv2.findHomography(found.points_m, found.points_px)
    expected = transform(homography, board.markers_m()[[marker.number for marker in markers]])
    distances = np.abs(expected - [marker.corners_px for marker in markers]).max(axis=(1, 2))
    in_place = int((distances < _PLACE_PX).sum())
    if len(markers) - in_place > max(_STRAY_MARKERS, in_place / 3):
        raise _another_board(board)


def _tag_points(grey: UInt8[np.ndarray, "h w"], dictionary: cv2.aruco.Dictionary, side_m: float) -> FoundPoints:
    """The centres of the quarters of the only tag."""
    corners = (side_m * PATCH_CORNERS).astype(np.float32)
    tags = []
    for marker in find_markers(grey, dictionary):
        guess = cv2.getPerspectiveTransform(corners, marker.corners_px.astype(np.float32))
        found = find_points(grey, _tag_pattern(dictionary, marker.number, side_m), guess)
        if len(found.points_m) == _TAG_POINTS:
            tags.append(found)
    if len(tags) > 1:
        raise InvalidInput("number of tags in the photograph", len(tags), "1: cover the others")
    return tags[0] if tags else NOTHING


def _tag_pattern(dictionary: cv2.aruco.Dictionary, number: int, side_m: float) -> Pattern:
    """A tag with the white around it, which is as wide as its border, and its quarters as patches."""
    cells = dictionary.markerSize + 2
    tag = cv2.aruco.generateImageMarker(dictionary, number, cells * _CELL_PIXELS)
    image = np.pad(tag, _CELL_PIXELS, constant_values=255).astype(np.float32) / 255
    whole_m = side_m * (cells + 2) / cells
    return Pattern(image, (whole_m, whole_m), whole_m / 2 * PATCH_CORNERS, whole_m / 2)


def _view(found: FoundPoints, size: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"] | None) -> BoardView:
    """The camera that fits points best, in a photograph of this width and height [px]."""
    scale = max(1.0, max(size) / _WORKING_SIDES[0])
    matrix, deviation = intrinsics, 0.0
    if matrix is None:
        focal, deviation = focal_length(found.points_m, found.points_px, size, ACCURACY_PX * scale)
        matrix = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    pose, rms = planar_pose(found.points_m, found.points_px, matrix)
    if rms > _MAX_RMS_PX * scale:
        raise InvalidInput(
            "mean distance of the print's points from where this camera would show them [px]", round(rms, 1),
            f"at most {_MAX_RMS_PX * scale:.1f}: check the intrinsics, and that the sheet lies flat",
        )  # fmt: skip
    return BoardView(pose, matrix, intrinsics is None, deviation, rms, found.points_m, found.points_px)


def _checked_intrinsics(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    K = np.array(intrinsics, float)
    if K.shape != (3, 3) or not np.all(np.isfinite(K)) or not min(K[0, 0], K[1, 1]) > 0 or np.any(K[2] != (0, 0, 1)):
        raise InvalidInput("intrinsics", K.tolist(), "a 3 x 3 matrix with positive focal lengths and last row 0, 0, 1")
    return K


def _not_found(grey: UInt8[np.ndarray, "h w"], what: str, corners: int) -> InvalidInput:
    """Why a print was not found, as far as the photograph tells."""
    if corners:
        allowed = f"at least {_MIN_CORNERS}: show all of it, with nothing lying on it"
        return InvalidInput(f"number of corners of the {what} that were found", corners, allowed)
    blur = _blur_px(_reduced(grey, _WORKING_SIDES[0]))
    if blur > _MAX_BLUR_PX:
        allowed = f"at most {_MAX_BLUR_PX:g} for the {what} to be found: let the camera focus, and hold it still"
        return InvalidInput("blur of the photograph's sharpest edges [px]", math.ceil(10 * blur) / 10, allowed)
    allowed = "whole in the picture, flat, evenly lit, within 1 m and seen from 25 degrees above the table or more"
    return InvalidInput(f"{what} in the photograph", "not to be found", allowed)


def _blur_px(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Standard deviation of the blur at the sharpest edges [px].

    An edge of height H that is blurred by s has the slope H / (sqrt(2 pi) s). The photograph is smoothed by 1 px first,
    so that noise makes no edges.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    slopes = [cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1))]
    steepest = max(float(np.percentile(np.hypot(*slopes), 99.9)), 1e-3)
    low, high = np.percentile(smooth, (1, 99))
    return float(np.sqrt(max(((high - low) / steepest) ** 2 / (2 * np.pi) - 1, 0)))
