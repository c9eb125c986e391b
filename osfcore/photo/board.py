"""The printed board: its pattern, its page, its markers, and camera and lens of a photograph that shows it."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.optimize import least_squares

from osfcore.errors import InvalidInput, UnknownName, check_ranges
from osfcore.geometry.poses import Pose, quaternion_from_matrix
from osfcore.photo.lens import Lens

Grey = UInt8[np.ndarray, "h w"]
Image8 = UInt8[np.ndarray, "h w *channels"]
Intrinsics = Float[np.ndarray, "3 3"]
Homography = Float[np.ndarray, "3 3"]
Reflectance = Float[np.ndarray, "h w"]
Points = Float[np.ndarray, "N 2"]
Pixel = Int[np.ndarray, "2"]
Quads = Float[np.ndarray, "M 4 2"]  # corners of markers


def camera_matrix(focal: float, x: float, y: float) -> Intrinsics:
    """Return K of a camera with square pixels, from its focal length and principal point [px]."""
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def checked_intrinsics(K: np.ndarray, what: str) -> Intrinsics:
    """Return K of a camera as floating-point numbers.

    Raises:
        InvalidInput: if K, whose name is `what`, cannot be that of a camera.
    """
    K = np.array(K, float)
    if K.shape != (3, 3) or not np.all(np.isfinite(K)) or not min(K[0, 0], K[1, 1]) > 0 or np.any(K[2] != (0, 0, 1)):
        raise InvalidInput(what, K.tolist(), "a 3 x 3 matrix with positive focal lengths and last row 0, 0, 1")
    return K


def px_scale(size: tuple[int, int]) -> float:
    """Return how many times more pixels errors may have in a photograph of this size than in a small one."""
    return max(1.0, max(size) / _WORKING_SIDES[0])


def on_plane(points_m: Points) -> Float[np.ndarray, "N 3"]:
    """Return points of the print's plane z = 0 in its frame [m]."""
    return np.pad(points_m, ((0, 0), (0, 1)))


# ArUco markers: which dictionaries there are, and roughly where markers lie in a photograph.


_DETECTION_SIDE = 1920  # smaller photographs are enlarged towards it: markers of 10 px are read far more often
_MAX_MARKER_ENLARGEMENT = 3.0


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a predefined dictionary of OpenCV, such as "DICT_4X4_50".

    Raises:
        UnknownName: if OpenCV has none of that name.
    """
    known = {key: number for key, number in vars(cv2.aruco).items() if key.startswith("DICT_")}
    if name not in known:
        raise UnknownName("dictionary of markers", name, sorted(known))
    return cv2.aruco.getPredefinedDictionary(known[name])


def find_markers(grey: Grey, dictionary: cv2.aruco.Dictionary) -> tuple[Int[np.ndarray, "M"], Quads]:
    """Find the markers of a dictionary, about one pixel exact.

    Bits are read leniently, which finds twice as many markers of 10 px as OpenCV's defaults, and wrong ones: whoever
    asks has to check them against what was printed.

    Returns:
        Their numbers in the dictionary, and the corners of their black borders: top left, top right, bottom right,
        bottom left of the print [px].
    """
    scale = min(max(_DETECTION_SIDE / max(grey.shape), 1.0), _MAX_MARKER_ENLARGEMENT)
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else grey
    lenient = cv2.aruco.DetectorParameters()
    lenient.adaptiveThreshWinSizeMin = 5
    lenient.adaptiveThreshWinSizeMax = 45
    lenient.adaptiveThreshWinSizeStep = 8
    lenient.minMarkerPerimeterRate = 0.01
    lenient.perspectiveRemovePixelPerCell = 8
    lenient.perspectiveRemoveIgnoredMarginPerCell = 0.25
    lenient.maxErroneousBitsInBorderRate = 0.5
    lenient.errorCorrectionRate = 1.0
    quads, numbers, _ = cv2.aruco.ArucoDetector(dictionary, lenient).detectMarkers(large)
    if numbers is None:
        return np.zeros(0, int), np.zeros((0, 4, 2))
    corners = np.reshape(quads, (-1, 4, 2)).astype(float)
    return np.ravel(numbers), (corners + 0.5) * np.divide(grey.shape[::-1], large.shape[::-1])


# A flat printed pattern in a photograph, aligned patch by patch to hundredths of a pixel.
#
# Corner detectors see a few pixels around a corner, and what else is printed there pulls them off by a tenth of a
# pixel. Here the known print is drawn as the camera would see it, and each patch of it is shifted until it lies on
# the photograph, so that every edge in the patch counts and the marks near a corner help instead of disturbing.


_BLUR_PX = 0.8  # of a sharp photograph; half or twice as much hardly moves the result
_INK = 0.06  # reflectance of black, where white is 1
_GAMMA = 1 / 2.2  # of the photograph's values; edges look shifted where light is mixed before it is encoded
_ROUNDS = 8
_SETTLED_PX = 0.005
_MAX_SHIFT_PX = 3.0
_MIN_CORRELATION = 0.5  # between a patch and the photograph: below, something lies on it or it is not there
_MIN_PIXELS = 30
_UNLIKE = 0.02  # more than three times the usual lack of correlation, and a patch is left out
_LEAST = 4  # points make a homography
_OUTLIER_PX, _LEAST_OUTLIER_PX = 2.0, 0.1
_RIDGE = 1e-7
_FINE_PATCH_PX = 150  # a patch is drawn at least so large, if that is at most three times larger than it is seen
_MAX_ENLARGEMENT = 3
_MARGIN_PX = 2
_FAR_PX = 1e6  # no print reaches so far
_PIXEL_CENTRE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # from indices to coordinates [px]
_PATCH_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """A print and the patches by which it is aligned.

    Attributes:
        image: reflectance, from 0 (black) to 1 (paper); its centre is the origin, its top lies along +y.
        size_m: width and height of the image [m].
        centres_m: of the square patches [m].
        patch_m: side of a patch [m].
    """

    image: Reflectance
    size_m: tuple[float, float]
    centres_m: Float[np.ndarray, "P 2"]
    patch_m: float


@dataclass(frozen=True, eq=False, slots=True)
class FoundPoints:
    """Centres of those patches that were found.

    Attributes:
        points_m: in the pattern's plane [m].
        points_px: in the photograph [px].
    """

    points_m: Points
    points_px: Points


NOTHING = FoundPoints(np.empty((0, 2)), np.empty((0, 2)))


def transform(homography: Homography, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Apply a homography to points of the plane."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def find_points(grey: Grey, pattern: Pattern, guess: Homography) -> FoundPoints:
    """Align a pattern with a photograph.

    In turn each patch's shift d is found, for which the photograph is closest to a R(x - d) + b with the print R drawn
    as the camera sees it and any contrast a and brightness b, and the homography is fitted anew to the shifted centres.
    Patches that look different from the print, or moved otherwise than the others, are left out: something lies on
    them, or a shadow's edge.

    Args:
        grey: the photograph, as encoded by the camera.
        pattern: that is looked for.
        guess: homography from the pattern's plane [m] to the photograph [px], right within 1 to 2 px.

    Returns:
        The patches that agree; none, if fewer than 4 do.
    """
    homography, outlier_px, found = guess, _OUTLIER_PX, NOTHING
    for _ in range(_ROUNDS):
        seen = _seen_patches(grey, pattern, homography)
        if len(seen.points_m) < _LEAST:
            return NOTHING
        fit, inliers = cv2.findHomography(seen.points_m, seen.points_px, cv2.RANSAC, outlier_px)
        if fit is None:
            return NOTHING
        fits = inliers.ravel() > 0
        found = FoundPoints(seen.points_m[fits], seen.points_px[fits])
        moved = transform(fit, found.points_m) - transform(homography, found.points_m)
        residuals = np.linalg.norm(transform(fit, seen.points_m) - seen.points_px, axis=1)
        outlier_px = float(np.clip(3 * np.median(residuals), _LEAST_OUTLIER_PX, _OUTLIER_PX))
        homography = fit
        if np.abs(moved).max() < _SETTLED_PX:
            break
    return found


def _seen_patches(grey: Grey, pattern: Pattern, homography: Homography) -> FoundPoints:
    """Find the patches near where the homography puts them, without those that are less like the print than most."""
    fine, enlargement = _resampled(pattern, homography)
    seen = np.array([_patch_shift(grey, fine, homography, centre, enlargement) for centre in pattern.centres_m])
    there = np.isfinite(seen[:, 2])
    if not there.any():
        return NOTHING
    unlike = 1 - seen[:, 2]
    there &= unlike <= 3 * np.median(unlike[there]) + _UNLIKE
    centres = pattern.centres_m[there]
    return FoundPoints(centres, transform(homography, centres) + seen[there, :2])


def _resampled(pattern: Pattern, homography: Homography) -> tuple[Pattern, int]:
    """Return the pattern about as fine as it is drawn, and how many times finer than the photograph that is."""
    quads = transform(homography, pattern.centres_m[:, None] + pattern.patch_m * _PATCH_CORNERS)
    side_px = float(np.median(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).max(axis=1)))
    enlargement = int(np.clip(np.ceil(_FINE_PATCH_PX / max(side_px, 1.0)), 1, _MAX_ENLARGEMENT))
    pixels = enlargement * side_px / pattern.patch_m * np.array(pattern.size_m)
    if not np.all(pixels < pattern.image.shape[::-1]):
        return pattern, enlargement
    image = cv2.resize(pattern.image, np.maximum(pixels, 8).astype(int).tolist(), interpolation=cv2.INTER_AREA)
    return replace(pattern, image=image), enlargement


def _patch_shift(
    grey: Grey, pattern: Pattern, homography: Homography, centre_m: Float[np.ndarray, "2"], enlargement: int
) -> Float[np.ndarray, "3"]:
    """Return a patch's shift from where the homography puts it [px] and the correlation; NaN if it is not there."""
    missing = np.full(3, np.nan)
    quad = transform(homography, centre_m + pattern.patch_m * _PATCH_CORNERS)
    size = np.array(grey.shape[::-1])
    if not np.all(np.abs(quad) < _FAR_PX) or not np.all((quad.mean(axis=0) > 0) & (quad.mean(axis=0) < size)):
        return missing
    low = np.maximum(np.floor(quad.min(axis=0)) - _MARGIN_PX, 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0)) + _MARGIN_PX, size).astype(int)
    drawn = _drawn(pattern, homography, low, high, enlargement)
    mask = cv2.fillConvexPoly(np.zeros(drawn.shape, np.uint8), np.round(quad - low - 0.5).astype(np.int32), 1) > 0
    if mask.sum() < _MIN_PIXELS:
        return missing
    slopes = [cv2.Scharr(drawn, cv2.CV_32F, *order, scale=1 / 32)[mask] for order in ((1, 0), (0, 1))]
    design = np.stack([*slopes, drawn[mask], np.ones(mask.sum(), np.float32)], axis=1).astype(float)
    seen = grey[low[1] : high[1], low[0] : high[0]][mask] / 255.0
    correlation = np.corrcoef(design[:, 2], seen)[0, 1] if np.ptp(seen) > 0 else 0.0
    if not correlation > _MIN_CORRELATION:
        return missing
    # a R(x - d) + b is a R - a d . grad R + b for small d
    *moved, contrast, _ = np.linalg.solve(design.T @ design + _RIDGE * len(seen) * np.eye(4), design.T @ seen)
    shift = -np.array(moved) / contrast
    return np.append(shift, correlation) if contrast > 0 and np.linalg.norm(shift) < _MAX_SHIFT_PX else missing


def _drawn(pattern: Pattern, homography: Homography, low: Pixel, high: Pixel, enlargement: int) -> Reflectance:
    """Draw what a camera shows of a pattern between two corners of its image, with values from 0 to 1."""
    (height, width), (wide_m, high_m) = pattern.image.shape, pattern.size_m
    from_pixels = np.array([[wide_m / width, 0, -wide_m / 2], [0, -high_m / height, high_m / 2], [0, 0, 1]])
    shrink = np.array([[enlargement, 0, -enlargement * low[0]], [0, enlargement, -enlargement * low[1]], [0, 0, 1]])
    warp = np.linalg.inv(_PIXEL_CENTRE) @ shrink @ homography @ from_pixels @ _PIXEL_CENTRE
    columns, rows = (high - low).tolist()
    light = cv2.warpPerspective(pattern.image, warp, (columns * enlargement, rows * enlargement), borderValue=(1.0,))
    light = cv2.GaussianBlur(cv2.resize(light, (columns, rows), interpolation=cv2.INTER_AREA), (0, 0), _BLUR_PX)
    return (_INK + (1 - _INK) * light) ** _GAMMA


# The pose and the focal length of a camera that sees known points of the table plane.


_FOCAL_FLAGS = (
    cv2.CALIB_USE_INTRINSIC_GUESS
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)
UNKNOWN_FOCAL = "focal length"  # `InvalidInput.what` of a view that does not determine it
_MAX_FOCAL_STD = 0.03  # of the focal length
_FOCAL_RANGE = (0.3, 10.0)  # focal lengths of cameras, in longer sides of the image


def planar_pose(points_m: Points, points_px: Points, intrinsics: Intrinsics) -> tuple[Pose, float]:
    """Return the pose of a camera that sees at least 4 points of the table plane.

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
    points, pixels = on_plane(points_m), np.ascontiguousarray(points_px, float)
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
        what = "side of the print that the photograph shows"
        raise InvalidInput(what, "its back", "its front: mirror the photograph")
    return best


def focal_length(points_m: Points, points_px: Points, size: tuple[int, int], accuracy_px: float) -> tuple[float, float]:
    """Estimate the focal length from a view of a plane, for square pixels, no distortion, a centred principal point.

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
    fit = fit_focal(points_m, points_px, size, accuracy_px)
    if fit is None or fit.focal_std > _MAX_FOCAL_STD * fit.focal:
        raise InvalidInput(
            UNKNOWN_FOCAL, "unknown, and the print is too small in this view, or seen too steeply, to tell it",
            "given, or the photograph taken from near by and at a slant, 30 to 60 degrees above the table",
        )  # fmt: skip
    return fit.focal, fit.focal_std


@dataclass(frozen=True, eq=False, slots=True)
class FocalFit:
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


def fit_focal(points_m: Points, points_px: Points, size: tuple[int, int], accuracy_px: float) -> FocalFit | None:
    """Fit pose and focal length; None if no usual focal length fits. Arguments as of `focal_length`."""
    points = [on_plane(points_m).astype(np.float32)]
    pixels = [np.ascontiguousarray(points_px, np.float32)]
    guess = cv2.initCameraMatrix2D(points, pixels, size)[0, 0]
    low, high = np.multiply(_FOCAL_RANGE, max(size))
    start = float(guess) if low < guess < high else float(max(size))
    matrix = camera_matrix(start, size[0] / 2, size[1] / 2)
    found = cv2.calibrateCamera(points, pixels, size, matrix, np.zeros(5), flags=_FOCAL_FLAGS)
    _, matrix, _, rotations, translations = found
    seen, jacobian = cv2.projectPoints(points[0], rotations[0], translations[0], matrix, None)
    # The last pivot says how far the points move with the focal length in ways that no motion of the camera explains.
    columns = np.column_stack([jacobian[:, :6], jacobian[:, 6] + jacobian[:, 7]])
    pivot = abs(np.linalg.qr(columns).R[-1, -1])
    scatter_px = np.linalg.norm(seen.reshape(-1, 2) - pixels[0]) / np.sqrt(max(columns.shape[0] - columns.shape[1], 1))
    focal = float(matrix[0, 0])
    if not low < focal < high:
        return None
    deviation = float(max(scatter_px, accuracy_px) / max(pivot, 1e-12))
    return FocalFit(focal, deviation, rotations[0].ravel(), translations[0].ravel())


# The printed calibration board, which gives the camera of one photograph of a table.
#
# The table frame: the print lies flat on the table, its centre is the origin, x runs along its top edge to the
# right, y towards its top, z up.


PAGE_M = (0.297, 0.21)  # A4, landscape
SQUARE_PIXELS = 384  # of a square of the board, when drawn
_MIN_MARGIN_M = 0.008
_MOST_SQUARES, _SQUARE_RANGE_M = 20, (0.002, 1.0)
_MIN_CORNERS = 6
_GUESS_PX = 2.0  # by which corners of markers may be off
_PLACE_PX = 3.0  # from where a marker should be
_STRAY_MARKERS = 2  # that are read by mistake in other things
_ALIKE = 0.15  # of a marker's side, and of a square's
_MIN_SIDE = 64
_WORKING_SIDES = (1920, 3840)  # [px]; photographs are reduced to the first, or the second if the print is small in them
ACCURACY_PX = 0.05  # of points in a real photograph; lenses are not perfect
_MAX_RMS_PX = 2.0
_MAX_BLUR_PX = 1.6  # sharp photographs have 0.6 to 1.3, and markers of 15 px are lost above


@dataclass(frozen=True, slots=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares.

    The default, which is printed on a landscape A4 page, was chosen by measurement: with smaller squares, or markers of
    5 x 5 bits, the board is lost more often in 640 x 480 pixels from 1 m and 25 degrees above the table.

    Attributes:
        columns: of squares.
        rows: of squares.
        square_m: side of a square [m].
        marker_m: side of a marker with its black border [m].
        dictionary: of the markers, one of OpenCV's.
        legacy: whether the top left square is white where the number of rows is even, as in OpenCV before 4.6.
    """

    columns: int = 6
    rows: int = 4
    square_m: float = 0.044
    marker_m: float = 0.033
    dictionary: str = "DICT_4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        """Check that there can be such a board."""
        if not (3 <= self.columns <= _MOST_SQUARES and 3 <= self.rows <= _MOST_SQUARES):
            raise InvalidInput("squares of the board", f"{self.columns} x {self.rows}", f"3 to {_MOST_SQUARES} a side")
        check_ranges(("square_m of the board", self.square_m, *_SQUARE_RANGE_M))
        if not 0.3 * self.square_m <= self.marker_m <= 0.9 * self.square_m:
            raise InvalidInput("marker_m of the board", self.marker_m, "0.3 to 0.9 times square_m")
        known = len(marker_dictionary(self.dictionary).bytesList)
        if self.columns * self.rows // 2 > known:
            raise InvalidInput("squares of the board", f"{self.columns} x {self.rows}", f"at most {2 * known} in all")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def sheet_m(self) -> tuple[float, float]:
        """Width and height that its sheet may hide: landscape A4, or more if the board with a margin needs it [m]."""
        across, down = (max(side + 2 * _MIN_MARGIN_M, page) for side, page in zip(self.size_m, PAGE_M, strict=True))
        return across, down

    def corners_m(self) -> Points:
        """Return where four squares meet, in the table frame [m]."""
        return self._in_table_frame(np.asarray(self._charuco().getChessboardCorners()))

    def markers_m(self) -> Quads:
        """Return the corners of the markers by number, clockwise from the top left, in the table frame [m]."""
        return self._in_table_frame(np.asarray(self._charuco().getObjPoints()))

    def image(self) -> Bool[np.ndarray, "h w"]:
        """Draw the board: what is paper, not ink; 384 pixels a square."""
        size = self.columns * SQUARE_PIXELS, self.rows * SQUARE_PIXELS
        return np.asarray(self._charuco().generateImage(size, marginSize=0)) > 0

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        dictionary = marker_dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    def _in_table_frame(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """From OpenCV's frame, whose origin is the board's top left and whose y points down."""
        return (points[..., :2] - np.array(self.size_m) / 2) * (1.0, -1.0)


BOARD_FORM = "COLUMNSxROWS,SQUARE,MARKER,DICTIONARY, such as 5x7,0.04,0.03,DICT_5X5_100, with sides in metres"


def board_of(text: str) -> Board:
    """Return the board that a text describes: "5x7,0.04,0.03,DICT_5X5_100", and ",legacy" for the older pattern.

    An empty text stands for the board to print.

    Raises:
        InvalidInput: if it describes none, or there can be no such board.
        UnknownName: if there is no such dictionary.
    """
    if not text:
        return Board()
    squares, *rest = text.replace(" ", "").split(",")
    try:
        columns, rows = (int(count) for count in squares.lower().split("x"))
        square, marker = (float(side) for side in rest[:2])
        dictionary, *legacy = rest[2:]
    except ValueError:
        raise InvalidInput("board", text, f"{BOARD_FORM}; add ,legacy for patterns of OpenCV before 4.6") from None
    if legacy not in ([], ["legacy"]):
        raise InvalidInput("end of the board's description", ",".join(legacy), '"legacy" or left out')
    return Board(columns, rows, square, marker, dictionary, bool(legacy))


@dataclass(frozen=True, eq=False, slots=True)
class BoardView:
    """The camera of a photograph of a printed board.

    Attributes:
        T_world_camera: pose of the camera in the table frame, whose origin is the print's centre.
        intrinsics: of the camera, 3 x 3 [px]; pixel centres at +0.5.
        focal_std_px: standard deviation of a focal length found from this photograph [px]; 0 if it was given.
        reprojection_rms_px: root mean square distance of the points from where they should appear [px].
        points_m: that were found, on the table [m].
        points_px: where they were found in the photograph [px].
    """

    T_world_camera: Pose
    intrinsics: Intrinsics
    focal_std_px: float
    reprojection_rms_px: float
    points_m: Points
    points_px: Points

    @property
    def corner_count(self) -> int:
        """Number of points that were found."""
        return len(self.points_m)


def locate_board(image: Image8, board: Board, intrinsics: Intrinsics | None = None) -> BoardView:
    """Find the camera of a photograph that shows a board.

    Args:
        image: RGB or grey, as encoded by the camera, free of lens distortion.
        board: that was printed.
        intrinsics: of the camera [px]. If not given, the focal length is estimated, with the principal point in the
            image's middle.

    Raises:
        InvalidInput: if the image is no photograph, no board or too little of it is found, the view is too steep for
            the focal length, or the points do not fit the camera.
    """
    found = board_points(image, board)
    return board_view(found, (image.shape[1], image.shape[0]), intrinsics)


def board_points(image: Image8, board: Board) -> FoundPoints:
    """Find the corners of the board's squares in a photograph.

    Raises:
        InvalidInput: if the image is no photograph, or no board or too little of it is found.
    """
    grey, best = _grey(image), NOTHING
    for side in _WORKING_SIDES:
        small = _reduced(grey, side)
        found = _board_points(small, board)
        if len(found.points_m) > len(best.points_m):
            best = FoundPoints(found.points_m, found.points_px * np.divide(grey.shape[::-1], small.shape[::-1]))
        if len(best.points_m) >= _MIN_CORNERS or max(grey.shape) <= side:
            break
    if len(best.points_m) < _MIN_CORNERS:
        raise _not_found(grey, board, len(best.points_m))
    return best


def board_view(found: FoundPoints, size: tuple[int, int], intrinsics: Intrinsics | None = None) -> BoardView:
    """Fit the camera to points in a photograph of this width and height [px]; see `locate_board`."""
    scale = px_scale(size)
    if intrinsics is None:
        focal, deviation = focal_length(found.points_m, found.points_px, size, ACCURACY_PX * scale)
        K = camera_matrix(focal, size[0] / 2, size[1] / 2)
    else:
        K, deviation = checked_intrinsics(intrinsics, "intrinsics"), 0.0
    pose, rms = planar_pose(found.points_m, found.points_px, K)
    if rms > _MAX_RMS_PX * scale:
        raise InvalidInput(
            "mean distance of the print's points from where this camera would show them [px]", round(rms, 1),
            f"at most {_MAX_RMS_PX * scale:.1f}: check the intrinsics, and that the sheet lies flat",
        )  # fmt: skip
    return BoardView(pose, K, deviation, rms, found.points_m, found.points_px)


def _grey(image: Image8) -> Grey:
    image = np.asarray(image)
    is_image = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not is_image or min(image.shape[:2]) < _MIN_SIDE:
        given = f"an array of {image.dtype} of shape {image.shape}"
        raise InvalidInput("photograph", given, f"8 bit, RGB or grey, and at least {_MIN_SIDE} pixels high and wide")
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def _reduced(grey: Grey, side: int) -> UInt8[np.ndarray, "reduced_h reduced_w"]:
    """Return a copy whose longer side is at most this long [px]."""
    scale = side / max(grey.shape)
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey


def _board_points(grey: Grey, board: Board) -> FoundPoints:
    """Find corners of a board; the patch around each is as large as a square."""
    markers_m = board.markers_m()
    numbers, corners = find_markers(grey, marker_dictionary(board.dictionary))
    own = numbers < len(markers_m)
    if not own.any():
        return NOTHING
    plane = markers_m[numbers[own]]
    guess, _ = cv2.findHomography(plane.reshape(-1, 2), corners[own].reshape(-1, 2), cv2.RANSAC, _GUESS_PX)
    if guess is None:
        return NOTHING
    pattern = Pattern(board.image().astype(np.float32), board.size_m, board.corners_m(), board.square_m)
    found = find_points(grey, pattern, guess)
    if len(found.points_m) and (_moved(plane, corners[own], found) or _continued(board, corners[~own], found)):
        seen = print_in(grey)
        raise _another(board, None if seen is None or seen.is_of(board) else seen)
    return found


def _moved(plane: Quads, corners: Quads, found: FoundPoints) -> bool:
    """Return whether markers lie elsewhere on the board: another layout's first squares look alike at a wrong scale."""
    homography, _ = cv2.findHomography(found.points_m, found.points_px)
    distances = np.abs(transform(homography, plane) - corners).max(axis=(1, 2))
    in_place = int((distances < _PLACE_PX).sum())
    return len(corners) - in_place > max(_STRAY_MARKERS, in_place / 3)


def _continued(board: Board, corners: Quads, found: FoundPoints) -> bool:
    """Return whether markers that this board lacks continue its squares: it has more rows."""
    homography, _ = cv2.findHomography(found.points_px, found.points_m)
    corners = transform(homography, corners)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    squares = (corners.mean(axis=1) + np.array(board.size_m) / 2) / board.square_m - 0.5  # whole in a square's middle
    continue_it = np.all(np.abs(sides / board.marker_m - 1) < _ALIKE, axis=1)
    continue_it &= np.all(np.abs(squares - np.round(squares)) < _ALIKE, axis=1)
    return bool(continue_it.sum() >= _STRAY_MARKERS)


def _another(board: Board, seen: SeenPrint | None) -> InvalidInput:
    """Return the error of a photograph that shows another board than the expected one."""
    legacy = " in the legacy pattern" if board.legacy else ""
    expected = f"the expected one, {board.columns} x {board.rows} squares with markers of {board.dictionary}{legacy}"
    if seen is None:
        return InvalidInput("board in the photograph", "another one", f"{expected}, or described: {BOARD_FORM}")
    given = f"another one, {seen.words()}"
    if not seen.is_charuco:
        return InvalidInput("board in the photograph", given, f"a ChArUco board, chessboard and markers: {expected}")
    described = f"described as {seen.form()}, with the sides in metres; its markers have {seen.marker:.2f} of a square"
    return InvalidInput("board in the photograph", given, f"{expected}, or {described}")


def _not_found(grey: Grey, board: Board, corners: int) -> InvalidInput:
    """Return why a print was probably not found."""
    seen = print_in(_reduced(grey, _WORKING_SIDES[0]))
    if seen is not None and not seen.is_of(board):
        return _another(board, seen)
    if corners:
        allowed = f"at least {_MIN_CORNERS}: show all of it, with nothing lying on it"
        return InvalidInput("number of corners of the board that were found", corners, allowed)
    blur = _blur_px(_reduced(grey, _WORKING_SIDES[0]))
    if blur > _MAX_BLUR_PX:
        allowed = f"at most {_MAX_BLUR_PX:g} for the board to be found: let the camera focus, and hold it still"
        return InvalidInput("blur of the photograph's sharpest edges [px]", math.ceil(10 * blur) / 10, allowed)
    allowed = "whole in the picture, flat, evenly lit, within 1 m and seen from 25 degrees above the table or more"
    return InvalidInput("board in the photograph", "not to be found", allowed)


def _blur_px(grey: Grey) -> float:
    """Estimate the standard deviation of the blur at the sharpest edges [px].

    An edge of height H that is blurred by s has the slope H / (sqrt(2 pi) s). The photograph is smoothed by 1 px first,
    so that noise makes no edges.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    slopes = [cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1))]
    steepest = max(float(np.percentile(np.hypot(*slopes), 99.9)), 1e-3)
    low, high = np.percentile(smooth, (1, 99))
    return float(np.sqrt(max(((high - low) / steepest) ** 2 / (2 * np.pi) - 1, 0)))


# Which print of markers a photograph shows, where it is not the expected board.
#
# Markers of every dictionary are looked for. Their numbers run along the rows, so that the number of columns says in
# which square each marker lies: in every second one of a chessboard, in every one of a grid. Of all numbers of columns
# that is the right one with which a homography puts most markers upright into the middles of their squares.


_DICTIONARIES = (  # the largest of each kind; smaller ones are their beginnings
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11",
    "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5", "DICT_APRILTAG_36h10", "DICT_ARUCO_MIP_36h12",
)  # fmt: skip
_SIZES = (50, 100, 250, 1000)
_FEWEST_MARKERS = 4
_PLACED = 0.12  # of a square: by which corners of markers may lie elsewhere
_LEAST_PLACED = 0.7  # of the markers
_MARKER_SHARES = (0.25, 0.95)  # of a square's side
_UNIT = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_Layout = Literal["charuco", "legacy", "grid", "rising grid"]


@dataclass(frozen=True, slots=True)
class SeenPrint:
    """A print of markers.

    Attributes:
        columns: of squares.
        rows: of squares that were seen.
        dictionary: the smallest of OpenCV's that holds the markers.
        layout: markers in every second square, from the second one on ("charuco") or the first ("legacy"); or in all,
            with rows that follow each other downwards ("grid") or upwards, as Kalibr's.
        marker: side of a marker in sides of a square.
    """

    columns: int
    rows: int
    dictionary: str
    layout: _Layout
    marker: float

    @property
    def is_charuco(self) -> bool:
        """Whether it is a chessboard."""
        return self.layout in ("charuco", "legacy")

    def words(self) -> str:
        """Return what it is."""
        if not self.is_charuco:
            return f"a grid of {self.columns} x {self.rows} markers of {self.dictionary} without a chessboard"
        legacy = " in the legacy pattern" if self.layout == "legacy" else ""
        return f"{self.columns} x {self.rows} squares with markers of {self.dictionary}{legacy}"

    def form(self) -> str:
        """Return how to describe it, but for its size."""
        return f"{self.columns}x{self.rows},SQUARE,MARKER,{self.dictionary}{',legacy' * (self.layout == 'legacy')}"

    def is_of(self, board: Board) -> bool:
        """Return whether it may be a part of a board."""
        is_legacy = board.legacy and board.rows % 2 == 0
        alike = self.columns == board.columns and self.rows <= board.rows and self.is_charuco
        same_kind = _kind(self.dictionary) == _kind(board.dictionary)
        return alike and same_kind and (self.layout == "legacy") == is_legacy


def print_in(grey: Grey) -> SeenPrint | None:
    """Find out which print of markers a photograph shows; None if there are too few that lie in rows."""
    for name in _DICTIONARIES:
        best: tuple[int, SeenPrint] | None = None
        quads, numbers, _ = cv2.aruco.ArucoDetector(marker_dictionary(name)).detectMarkers(grey)
        if numbers is None or len(numbers) < _FEWEST_MARKERS:
            continue
        numbers, corners = np.ravel(numbers), np.reshape(quads, (-1, 4, 2)).astype(float)
        for layout in get_args(_Layout):
            for columns in range(2, _MOST_SQUARES + 1):
                found = _placed(numbers, corners, columns, layout)
                if found is not None and (best is None or found[0] > best[0]):
                    count, rows, share = found
                    best = count, SeenPrint(columns, rows, _smallest(name, int(numbers.max())), layout, share)
        if best is not None:
            return best[1]
    return None


def _placed(numbers: np.ndarray, corners: Quads, columns: int, layout: _Layout) -> tuple[int, int, float] | None:
    """Return how many markers lie where a print has them, its rows, and the markers' side; None if too few do."""
    squares = _squares(numbers, columns, layout)
    if np.ptp(squares, axis=0).min() == 0:  # one row or column fits anything
        return None
    homography, _ = cv2.findHomography(squares + 0.5, corners.mean(axis=1), cv2.RANSAC, _GUESS_PX * 2)
    if homography is None or abs(np.linalg.det(homography)) < 1e-12:
        return None
    offsets = transform(np.linalg.inv(homography), corners) - (squares + 0.5)[:, None]
    share = float(np.median(np.abs(offsets))) * 2
    there = np.all(np.abs(offsets - share * _UNIT) < _PLACED, axis=(1, 2))
    count = int(there.sum())
    if count < max(_FEWEST_MARKERS, _LEAST_PLACED * len(numbers)) or not _MARKER_SHARES[0] < share < _MARKER_SHARES[1]:
        return None
    rows = int(np.abs(squares[there, 1]).max()) + 1
    return count, rows + (rows % 2 if layout == "legacy" else 0), share


def _squares(numbers: np.ndarray, columns: int, layout: _Layout) -> Float[np.ndarray, "M 2"]:
    """Return in which square (column, row) of a print each marker lies."""
    if "grid" in layout:
        row = numbers // columns * (1 if layout == "grid" else -1)
        return np.stack([numbers % columns, row], axis=1).astype(float)
    first = int(layout == "charuco")  # column of the first marker
    in_first_row = (columns + 1 - first) // 2
    pair, place = numbers // columns, numbers % columns
    is_second = place >= in_first_row
    column = np.where(is_second, 2 * (place - in_first_row) + 1 - first, 2 * place + first)
    return np.stack([column, 2 * pair + is_second], axis=1).astype(float)


def _kind(dictionary: str) -> str:
    """Return the name of a dictionary without its size: those of one kind begin alike."""
    head, _, tail = dictionary.rpartition("_")
    return head if tail.isdigit() else dictionary


def _smallest(largest: str, number: int) -> str:
    """Return the smallest dictionary of a kind that holds a marker."""
    kind = _kind(largest)
    return largest if kind == largest else f"{kind}_{next(size for size in _SIZES if number < size)}"


# Radial distortion of a lens from one photograph of the board, and photographs without it.
#
# x' = x (1 + k1 r^2) for points x of the plane at distance 1 before the camera, r = |x|: OpenCV's model, one
# coefficient. Printed points are first looked for in the photograph as it is, then, with the distortion that they
# show, in one that is free of it, and so on, since straight lines are what finds them.


CONTRADICTED = "focal length of the photo [px]"  # `InvalidInput.what` of a given one that the board contradicts
_LENS_ROUNDS = 3
_SURE_STD = 0.03  # of a focal length that is sure, relative
_MOST_FACTOR = 1.15  # by which a given focal length may differ from that
_SURE = 3.0  # standard deviations
_CENTRE_SHARE, _FOCAL_SHARE = 0.01, 0.01  # deviations: of the principal point from the middle, of a given focal length
_MOST_RADIAL = 0.5  # of |k1|
_LEAST_BEND_PX = 0.5  # of distortion in the photograph's corners
FINE_PX = 0.015  # of points, where the lens is modelled: they scatter by 0.01 px in VGA


def locate_board_through_lens(image: Image8, board: Board, intrinsics: Intrinsics | None) -> tuple[BoardView, Lens]:
    """Find the camera of a photograph that shows a board, and its lens; arguments and errors as of `locate_board`.

    Returns:
        The camera of the straightened photograph, and the lens that straightens it. Its radial coefficient is 0 where
        the board's points show none: fewer than 3 standard deviations, or half a pixel in the corners.
    """
    found, lens = board_points_through_lens(image, board, intrinsics)
    size = image.shape[1], image.shape[0]
    if intrinsics is not None:
        free = fit_focal(found.points_m, found.points_px, size, ACCURACY_PX * px_scale(size))
        given, is_sure = float(intrinsics[0, 0]), free is not None and free.focal_std < _SURE_STD * free.focal
        ratio = given / free.focal if free is not None and is_sure else 1.0
        if not 1 / _MOST_FACTOR < ratio < _MOST_FACTOR:
            allowed = f"about {1 / ratio:.2f} times that, as the board in it shows; leave it out to have it found"
            raise InvalidInput(CONTRADICTED, f"given as {given:.0f} at {size[0]} x {size[1]} pixels", allowed)
    view = board_view(found, size, intrinsics)
    return view, lens or Lens(view.intrinsics)


def board_points_through_lens(
    image: Image8, board: Board, intrinsics: Intrinsics | None = None
) -> tuple[FoundPoints, Lens | None]:
    """Find the board's corners in the straightened photograph, and the lens; arguments as of `locate_board`.

    Raises:
        InvalidInput: if the image is no photograph, or no board or too little of it is found.
    """
    found, size = board_points(image, board), (image.shape[1], image.shape[0])
    lens: Lens | None = None
    for _ in range(_LENS_ROUNDS):
        seen_px = found.points_px if lens is None else lens.bent(found.points_px)
        fit = _fitted(found.points_m, seen_px, size, intrinsics)
        if fit is None:
            break
        lens, found = fit, board_points(fit.straightened(image), board)
    return found, lens


def _fitted(points_m: Points, points_px: Points, size: tuple[int, int], intrinsics: Intrinsics | None) -> Lens | None:
    """Fit a lens; None if the points are not sure of a distortion.

    Pose, focal length, principal point and k1 are fitted together; a principal point beside the middle looks much like
    distortion, so that it is left free within 1 % of the image, and a focal length that is given within 1 %.
    """
    accuracy, middle = FINE_PX * px_scale(size), np.array(size) / 2
    start = fit_focal(points_m, points_px, size, accuracy)
    if start is None:
        return None
    points = on_plane(points_m)
    focal = start.focal if intrinsics is None else float(intrinsics[0, 0])
    spread = np.array([_FOCAL_SHARE if intrinsics is not None else 1.0, *[_CENTRE_SHARE * max(size)] * 2, 1.0])

    def matrix(p: Float[np.ndarray, "10"]) -> Intrinsics:
        return camera_matrix(focal * np.exp(p[6]), *(middle + p[7:9]))

    def residuals(p: Float[np.ndarray, "10"]) -> Float[np.ndarray, "M"]:
        bend = np.array([p[9], 0.0, 0.0, 0.0])
        at = cv2.projectPoints(points, p[:3], p[3:6], matrix(p), bend)[0].reshape(-1, 2)
        return np.concatenate([(at - points_px).ravel() / accuracy, p[6:] / spread])

    first = np.concatenate([start.rotation, start.translation, [np.log(start.focal / focal)], np.zeros(3)])
    fit = least_squares(residuals, first, x_scale="jac", method="lm")
    scatter = max(1.0, float(np.sqrt(2 * fit.cost / max(fit.fun.size - first.size, 1))))
    std = scatter * float(np.sqrt(np.linalg.pinv(fit.jac.T @ fit.jac)[-1, -1]))
    K, radial = matrix(fit.x), float(fit.x[9])
    reach = np.hypot(*size) / 2 / K[0, 0]  # of the corners from the middle, at distance 1
    if not (_SURE * std < abs(radial) < _MOST_RADIAL and abs(radial) * reach**3 * K[0, 0] > _LEAST_BEND_PX):
        return None
    return Lens(K, (radial,), std=std)


# The page with the calibration board, to print.


RULER_M = 0.1
INSTRUCTION = "Print at 100 %, check that this line is 100 mm long, and lay the sheet flat on the table."
_PRINT_DPI = 600
_INCH_M = 0.0254


def page_image(board: Board, pixels_per_m: float) -> Bool[np.ndarray, "h w"]:
    """Draw the page to print: the board in its middle, and below it a ruler and an instruction. True is paper.

    Args:
        board: to print.
        pixels_per_m: resolution; edges are right within half a pixel.

    Raises:
        InvalidInput: if the board does not fit on the page.
    """
    for side, page in zip(board.size_m, PAGE_M, strict=True):
        if side > page - 2 * _MIN_MARGIN_M:
            allowed = f"at most {page - 2 * _MIN_MARGIN_M:.3f}, so that it fits on landscape A4 with a margin"
            raise InvalidInput("side of the board [m]", round(side, 4), allowed)
    width, height = (round(side * pixels_per_m) for side in PAGE_M)
    paper = board.image()
    column, row = (
        np.floor(((np.arange(count) + 0.5) / pixels_per_m - (page - side) / 2) * SQUARE_PIXELS / board.square_m)
        for count, page, side in zip((width, height), PAGE_M, board.size_m, strict=True)
    )
    inside = ((row >= 0) & (row < paper.shape[0]))[:, None] & ((column >= 0) & (column < paper.shape[1]))
    nearest = np.ix_(*(np.clip(i, 0, n - 1).astype(int) for i, n in zip((row, column), paper.shape, strict=True)))
    page = np.where(inside, paper[nearest], True)
    return page & _ruler_image(board, (width, height), pixels_per_m)


def _ruler_image(board: Board, size: tuple[int, int], pixels_per_m: float) -> Bool[np.ndarray, "h w"]:
    image = Image.new("1", size, 1)
    draw = ImageDraw.Draw(image)
    left = (PAGE_M[0] - board.size_m[0]) / 2
    middle = PAGE_M[1] - (PAGE_M[1] - board.size_m[1]) / 4
    tick, line = 0.0015, max(round(0.0002 * pixels_per_m), 1)
    marks = [(0.0, 0.0, RULER_M, 0.0), (0.0, -tick, 0.0, tick), (RULER_M, -tick, RULER_M, tick)]
    for mark in marks:
        ends = [round(v * pixels_per_m) for v in np.add(mark, (left, middle, left, middle))]
        draw.line(ends, fill=0, width=line)
    font = ImageFont.load_default(0.0032 * pixels_per_m)
    place = ((left + RULER_M + 0.005) * pixels_per_m, middle * pixels_per_m)
    draw.text(place, INSTRUCTION, fill=0, font=font, anchor="lm")
    return np.array(image)


def board_pdf(board: Board) -> bytes:
    """Return the page to print as PDF: A4, 600 dots an inch."""
    out = io.BytesIO()
    page = Image.fromarray(page_image(board, _PRINT_DPI / _INCH_M))
    page.save(out, "PDF", resolution=_PRINT_DPI, title="Calibration board", subject=f"{board}")
    return out.getvalue()
