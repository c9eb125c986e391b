"""Radial distortion of a lens from one photograph of the board, and photographs without it.

x' = x (1 + k1 r^2) for points x of the plane at distance 1 before the camera, r = |x|: OpenCV's model, one coefficient.
Printed points are first looked for in the photograph as it is, then, with the distortion that they show, in one that is
free of it, and so on, since straight lines are what finds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from osfcore.errors import InvalidInput
from osfcore.photo.board import (
    ACCURACY_PX,
    Board,
    BoardView,
    FoundPoints,
    Image8,
    Intrinsics,
    Points,
    board_points,
    board_view,
    camera_matrix,
    fit_focal,
    on_plane,
    px_scale,
)

CONTRADICTED = "focal length of the photo [px]"  # `InvalidInput.what` of a given one that the board contradicts
_ROUNDS = 3
_SURE_STD, _MOST_FACTOR = (
    0.03,
    1.15,
)  # relative deviation of a focal length that is sure; factor by which a given may differ
_SURE = 3.0  # standard deviations
_CENTRE_SHARE, _FOCAL_SHARE = 0.01, 0.01  # deviations: of the principal point from the middle, of a given focal length
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

    intrinsics: Intrinsics
    radial: float
    std: float = 0.0

    def straightened(self, image: np.ndarray) -> np.ndarray:
        """Return the same view without distortion, by the same intrinsics; beyond the photograph its edge repeats."""
        if not self.radial:
            return image
        centre = self.intrinsics.copy()
        centre[:2, 2] -= 0.5  # OpenCV counts indices
        bend, size = np.array([self.radial, 0.0, 0.0, 0.0]), (image.shape[1], image.shape[0])
        maps = cv2.initUndistortRectifyMap(centre, bend, np.eye(3), centre, size, cv2.CV_32FC1)
        return cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def bent(self, points_px: Points) -> Points:
        """Return where points of the straight photograph are in the one that was taken [px]."""
        K = self.intrinsics
        x = (points_px - K[:2, 2]) / K[[0, 1], [0, 1]]
        return x * (1 + self.radial * (x**2).sum(axis=1, keepdims=True)) * K[[0, 1], [0, 1]] + K[:2, 2]


def locate_board_through_lens(
    image: Image8, board: Board, intrinsics: Intrinsics | None = None
) -> tuple[BoardView, Lens]:
    """Find the camera of a photograph that shows a board, and its lens; arguments and errors as of `locate_board`.

    Returns:
        The camera of the straightened photograph, and the lens that straightens it. Its radial coefficient is 0 where
        the board's points show none: fewer than 3 standard deviations, or half a pixel in the corners.
    """
    found, lens = board_points_through_lens(image, board, intrinsics)
    size = image.shape[1], image.shape[0]
    if intrinsics is not None:
        _check_focal(found, size, float(intrinsics[0, 0]))
    view = board_view(found, size, intrinsics)
    return view, lens or Lens(view.intrinsics, 0.0)


def board_points_through_lens(
    image: Image8, board: Board, intrinsics: Intrinsics | None = None
) -> tuple[FoundPoints, Lens | None]:
    """Find the board's corners in the straightened photograph, and the lens; arguments as of `locate_board`.

    Raises:
        InvalidInput: if the image is no photograph, or no board or too little of it is found.
    """
    found, size = board_points(image, board), (image.shape[1], image.shape[0])
    lens: Lens | None = None
    for _ in range(_ROUNDS):
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
    if not (_SURE * std < abs(radial) < _MOST and abs(radial) * reach**3 * K[0, 0] > _LEAST_PX):
        return None
    return Lens(K, radial, std)


def _check_focal(found: FoundPoints, size: tuple[int, int], given: float) -> None:
    """Refuse a focal length that the board contradicts."""
    free = fit_focal(found.points_m, found.points_px, size, ACCURACY_PX * px_scale(size))
    if free is None or free.focal_std >= _SURE_STD * free.focal:
        return
    if not 1 / _MOST_FACTOR < given / free.focal < _MOST_FACTOR:
        raise InvalidInput(
            CONTRADICTED, f"given as {given:.0f} at {size[0]} x {size[1]} pixels",
            f"about {free.focal / given:.2f} times that, as the board in it shows; "
            "leave it out to let the board tell it",
        )  # fmt: skip
