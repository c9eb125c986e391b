"""ArUco and AprilTag markers: which dictionaries there are, and where markers lie in a photograph, roughly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import UnknownName

_DETECTION_SIDE = 1920  # smaller photographs are enlarged towards it: markers of 10 px are read far more often
_MAX_ENLARGEMENT = 3.0


@dataclass(frozen=True, eq=False, slots=True)
class Marker:
    """One marker in a photograph; it may be a mistake, since marks are read leniently.

    Attributes:
        number: of the marker in its dictionary.
        corners_px: of its black border: top left, top right, bottom right, bottom left of the print [px].
    """

    number: int
    corners_px: Float[np.ndarray, "4 2"]


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """A predefined dictionary of OpenCV, such as "DICT_4X4_50".

    Raises:
        UnknownName: if OpenCV has none of that name.
    """
    known = {key: number for key, number in vars(cv2.aruco).items() if key.startswith("DICT_")}
    if name not in known:
        raise UnknownName("dictionary of markers", name, sorted(known))
    return cv2.aruco.getPredefinedDictionary(known[name])


def find_markers(grey: UInt8[np.ndarray, "h w"], dictionary: cv2.aruco.Dictionary) -> list[Marker]:
    """Markers of a dictionary, about one pixel exact.

    Bits are read leniently, which finds twice as many markers of 10 px as OpenCV's defaults, and wrong ones: whoever
    asks has to check them against what was printed.

    Args:
        grey: the photograph.
        dictionary: of the markers.
    """
    scale = min(max(_DETECTION_SIDE / max(grey.shape), 1.0), _MAX_ENLARGEMENT)
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else grey
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, _lenient_parameters()).detectMarkers(large)
    if numbers is None:
        return []
    sizes = np.divide(grey.shape[::-1], large.shape[::-1])
    return [
        Marker(int(number), (quad.reshape(4, 2).astype(float) + 0.5) * sizes)
        for quad, number in zip(corners, np.ravel(numbers), strict=True)
    ]


def _lenient_parameters() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = 5
    parameters.adaptiveThreshWinSizeMax = 45
    parameters.adaptiveThreshWinSizeStep = 8
    parameters.minMarkerPerimeterRate = 0.01
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    parameters.maxErroneousBitsInBorderRate = 0.5
    parameters.errorCorrectionRate = 1.0
    return parameters
