"""Radial distortion of a lens from one photograph of the board, and photographs without it.

x' = x (1 + k1 r^2) for points x of the plane at distance 1 before the camera, r = |x|: OpenCV's model, one coefficient.
Printed points are first looked for in the photograph as it is, then, with the distortion that they show, in one that is
free of it, and so on, since straight lines are what finds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import least_squares

from osfcore.errors import InvalidInput
from osfcore.photo.board import ACCURACY_PX, Board, BoardView, FoundPoints, board_points, board_view, calibrated

CONTRADICTED = "focal length of the photo [px]"  # of the error that names it
_ROUNDS = 3
_TOLD, _MOST_OFF = (
    0.03,
    1.15,
)  # deviation of a focal length that the board tells, and factor by which the given may differ
_SURE = 3.0  # standard deviations
_CENTRE_SHARE, _FOCAL_SHARE = (
    0.01,
    0.01,
)  # deviations of the principal point from the middle, and of a given focal length
_MOST = 0.5  # of |k1|
_LEAST_PX = 0.5  # of distortion in the photograph's corners
FINE_PX = 0.015  # of points, where the lens is modelled: they scatter by 0.01 px in VGA


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A camera with radial distortion.

    Attributes:
        intrinsics: 3 x 3 [px], pixel centres at +0.5.
        radial: k1; 0 for none.
        std: its standard deviation.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    radial: float
    std: float = 0.0

    def straightened(self, image: np.ndarray) -> np.ndarray:
        """The same view without distortion, by the same intrinsics; beyond the photograph its edge repeats."""
        if not self.radial:
            return image
        centre = self.intrinsics.copy()
        centre[:2, 2] -= 0.5  # OpenCV counts indices
        size = image.shape[1], image.shape[0]
        maps = cv2.initUndistortRectifyMap(centre, self._coefficients, np.eye(3), centre, size, cv2.CV_32FC1)
        return cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def bent(self, points_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Where points of the straight photograph are in the one that was taken [px]."""
        K = self.intrinsics
        x = (points_px - K[:2, 2]) / K[[0, 1], [0, 1]]
        return x * (1 + self.radial * (x**2).sum(axis=1, keepdims=True)) * K[[0, 1], [0, 1]] + K[:2, 2]

    @property
    def _coefficients(self) -> Float[np.ndarray, "4"]:
        return np.array([self.radial, 0.0, 0.0, 0.0])


def locate_board_through_lens(
    image: UInt8[np.ndarray, "h w *channels"], board: Board, intrinsics: Float[np.ndarray, "3 3"] | None = None
) -> tuple[BoardView, Lens]:
    """The camera of a photograph that shows a board, and its lens; arguments and errors as of `locate_board`.

    Returns:
        The camera of the straightened photograph, and the lens that straightens it. Its radial coefficient is 0 where
        the board's points do not tell of any: fewer than 3 standard deviations, or half a pixel in the corners.
    """
    found, lens = board_points_through_lens(image, board, intrinsics)
    size = image.shape[1], image.shape[0]
    if intrinsics is not None:
        _check_focal(found, size, intrinsics)
    view = board_view(found, size, intrinsics)
    return view, lens or Lens(view.intrinsics, 0.0)


def board_points_through_lens(
    image: UInt8[np.ndarray, "h w *channels"], board: Board, intrinsics: Float[np.ndarray, "3 3"] | None = None
) -> tuple[FoundPoints, Lens | None]:
    """Corners of the board's squares in the straightened photograph, and the lens; arguments as of `locate_board`.

    Raises:
        InvalidInput: if the image is no photograph, or no board or too little of it is found.
    """
    found, size = board_points(image, board), (image.shape[1], image.shape[0])
    lens: Lens | None = None
    for _ in range(_ROUNDS):
        seen = FoundPoints(found.points_m, found.points_px if lens is None else lens.bent(found.points_px))
        fit = _fitted(seen, size, intrinsics)
        if fit is None:
            break
        lens, found = fit, board_points(fit.straightened(image), board)
    return found, lens


def _fitted(seen: FoundPoints, size: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"] | None) -> Lens | None:
    """A lens with a distortion that the points are sure of; None without.

    Pose, focal length, principal point and k1 are fitted together; a principal point beside the middle looks much like
    distortion, so that it is left free within 1 % of the image, and a focal length that is given within 1 %.
    """
    accuracy, middle = FINE_PX * max(1.0, max(size) / 1920), np.array(size) / 2
    start = calibrated(seen.points_m, seen.points_px, size, accuracy)
    if start is None:
        return None
    points = np.pad(seen.points_m, ((0, 0), (0, 1)))
    focal = start.focal if intrinsics is None else float(intrinsics[0, 0])
    spread = np.array([_FOCAL_SHARE if intrinsics is not None else 1.0, *[_CENTRE_SHARE * max(size)] * 2, 1.0])

    def residuals(p: Float[np.ndarray, "10"]) -> Float[np.ndarray, "M"]:
        f, centre, bend = focal * np.exp(p[6]), middle + p[7:9], np.array([p[9], 0.0, 0.0, 0.0])
        K = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
        at = cv2.projectPoints(points, p[:3], p[3:6], K, bend)[0].reshape(-1, 2)
        return np.concatenate([(at - seen.points_px).ravel() / accuracy, p[6:] / spread])

    first = np.concatenate([start.rotation, start.translation, [np.log(start.focal / focal)], np.zeros(3)])
    fit = least_squares(residuals, first, x_scale="jac", method="lm")
    scatter = max(1.0, float(np.sqrt(2 * fit.cost / max(fit.fun.size - first.size, 1))))
    std = scatter * float(np.sqrt(np.linalg.pinv(fit.jac.T @ fit.jac)[-1, -1]))
    f, centre, radial = focal * np.exp(fit.x[6]), middle + fit.x[7:9], float(fit.x[9])
    reach = np.hypot(*size) / 2 / f  # of the corners from the middle, at distance 1
    if not (_SURE * std < abs(radial) < _MOST and abs(radial) * reach**3 * f > _LEAST_PX):
        return None
    return Lens(np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]]), radial, std)


def _check_focal(found: FoundPoints, size: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"]) -> None:
    """Refuse a focal length that the board contradicts."""
    free = calibrated(found.points_m, found.points_px, size, ACCURACY_PX * max(1.0, max(size) / 1920))
    if free is None:
        return
    given, seen = intrinsics[0, 0], free.focal
    if free.focal_std < _TOLD * seen and not 1 / _MOST_OFF < given / seen < _MOST_OFF:
        share = seen / given
        raise InvalidInput(
            CONTRADICTED, f"given as {given:.0f} at {size[0]} x {size[1]} pixels",
            f"about {share:.2f} times that, as the board in it shows; leave it out to let the board tell it",
        )  # fmt: skip
