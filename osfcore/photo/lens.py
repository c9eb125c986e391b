"""Lenses that bend straight lines, by OpenCV's models, and pictures without that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, shown

HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV and ROS have pixel centres at whole numbers


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A camera whose lens may bend straight lines.

    A point of the plane at distance 1 before the camera, r from the axis, appears at

        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + tangential terms of p1, p2
        x' = x theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r,  theta = atan r,  for a fisheye

    and its pixel is K x'.

    Attributes:
        intrinsics: K, 3 x 3 without skew [px], pixel centres at +0.5.
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6 and so on, as OpenCV orders them; k1 to k4 of a fisheye.
        is_fisheye: whether angles are bent (cv2.fisheye) instead of distances.
        std: standard deviation of k1, where it was fitted.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    coefficients: tuple[float, ...] = ()
    is_fisheye: bool = False
    std: float = 0.0

    @property
    def radial(self) -> float:
        """k1; 0 for none."""
        return self.coefficients[0] if self.coefficients else 0.0

    @property
    def bends(self) -> bool:
        """Whether it bends straight lines at all."""
        return self.is_fisheye or any(self.coefficients)

    def scaled(self, ratio: Sequence[float] | np.ndarray) -> Lens:
        """Return the lens of pictures whose width and height are this many times larger."""
        return replace(self, intrinsics=self.intrinsics * np.array([[ratio[0]], [ratio[1]], [1.0]]))

    def straightened(self, image: np.ndarray) -> np.ndarray:
        """Return the same view without distortion, by the same intrinsics; beyond the picture its edge repeats."""
        if not self.bends:
            return image
        K, size = self.intrinsics - HALF_PIXEL, (image.shape[1], image.shape[0])
        rectify = cv2.fisheye.initUndistortRectifyMap if self.is_fisheye else cv2.initUndistortRectifyMap
        maps = rectify(K, self._opencv, np.eye(3), K, size, cv2.CV_32FC1)
        return cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def bent(self, points_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Return where points of the straight picture are in the one that was taken [px]."""
        K, still = self.intrinsics, np.zeros(3)
        rays = np.column_stack([(points_px - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(points_px))])[:, None]
        project = cv2.fisheye.projectPoints if self.is_fisheye else cv2.projectPoints
        return project(rays, still, still, K, self._opencv)[0].reshape(-1, 2)

    @property
    def _opencv(self) -> Float[np.ndarray, "C"]:
        return np.pad(np.array(self.coefficients, float), (0, max(0, 4 - len(self.coefficients))))


_BROWN = ("plumb_bob", "rational_polynomial", "radtan", "brown_conrady", "opencv")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "opencv_fisheye")
_COUNTS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV takes
_MOST_TANGENTIAL = 0.05  # p1 and p2 of real lenses are below 0.01
_ANOTHER = "plumb_bob, rational_polynomial or equidistant; straighten the pictures first, and leave distortion out then"


def lens_of(K: np.ndarray, model: str, coefficients: Sequence[float], owner: str) -> Lens:
    """Return the lens that another program describes.

    Args:
        K: intrinsics [px], pixel centres at whole numbers.
        model: name of the distortion: ROS's plumb_bob, rational_polynomial or equidistant, or what Kalibr and
            RealSense call the same; "" for OpenCV's usual one.
        coefficients: of the model, in OpenCV's order.
        owner: whose they are, for the message.

    Raises:
        InvalidInput: if K has skew or is none, the model is another one, or the number of coefficients is not its own.
    """
    is_K = K.shape == (3, 3) and np.all(np.isfinite(K)) and min(K[0, 0], K[1, 1]) > 0
    if not is_K or not np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1)):
        raise InvalidInput(f"K of {owner}", K.tolist(), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")
    if K[0, 1]:
        raise InvalidInput(f"skew of {owner} (K[0][1])", K[0, 1], "0: pixels with skewed axes are not modelled")
    centred, plain = K + HALF_PIXEL, model.lower().replace(" ", "_").rpartition(".")[2]
    values = np.array(coefficients, float)
    if not np.all(np.isfinite(values)):
        raise InvalidInput(f"distortion of {owner}", values.tolist(), "finite numbers")
    if plain in _FISHEYE:
        return Lens(centred, _counted(values, (4,), owner), is_fisheye=True)
    if not values.any() and (not plain or plain in (*_BROWN, "none") or "brown_conrady" in plain):
        return Lens(centred)
    if plain and plain not in _BROWN:
        raise InvalidInput(f"distortion_model of {owner}", shown(model), _ANOTHER)
    found = _counted(values, _COUNTS, owner)
    if not plain and len(found) == 4 and max(map(abs, found[2:])) > _MOST_TANGENTIAL:  # k3 and k4 of a fisheye
        allowed = "with its distortion_model: plumb_bob, or equidistant of a fisheye, of which four numbers do not tell"
        raise InvalidInput(f"distortion of {owner}", values.tolist(), allowed)
    return Lens(centred, found)


def _counted(values: Float[np.ndarray, "C"], counts: tuple[int, ...], owner: str) -> tuple[float, ...]:
    """Return coefficients in a number that the model has; drivers add zeros at the end of some."""
    fitting = [count for count in counts if len(np.trim_zeros(values, "b")) <= count <= len(values)]
    if not fitting:
        allowed = f"{', '.join(map(str, counts))} in number"
        raise InvalidInput(f"distortion of {owner}", values.tolist(), allowed)
    return tuple(values[: fitting[0]].tolist())
