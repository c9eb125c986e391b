"""The part of a photo that becomes a goal image: a rectangle in the photo's own pixels, perhaps turned."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from app.storage.photos import Photo
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.photo.read_photograph import MIN_SIDE

GOAL_SIDE = 512  # of goal images at most [px]: estimators look at less
MAX_TURN_DEG = 180.0


@dataclass(frozen=True, slots=True)
class PhotoCrop:
    """A rectangle in the proportions of a camera.

    Attributes:
        left: of the rectangle before it is turned [px of the photo].
        top: likewise.
        width: of the rectangle; its height follows from the camera's proportions.
        turn_deg: by which it is turned clockwise about its centre.
    """

    left: float
    top: float
    width: float
    turn_deg: float = 0.0


def central_crop(photo_width: int, photo_height: int, camera: Camera) -> PhotoCrop:
    """The largest rectangle in the middle of a photo."""
    width = min(photo_width, photo_height * camera.width / camera.height)
    height = width * camera.height / camera.width
    return PhotoCrop((photo_width - width) / 2, (photo_height - height) / 2, width)


def check_crop(crop: PhotoCrop, photo_width: int, photo_height: int, camera: Camera) -> None:
    """Refuse a rectangle that is too small, or of which a part lies beside the photo before it is turned.

    Raises:
        InvalidInput: if so.
    """
    height = crop.width * camera.height / camera.width
    if min(crop.width, height) < MIN_SIDE:
        raise InvalidInput("size of the crop [px]", f"{crop.width:.0f} x {height:.0f}", f"at least {MIN_SIDE} a side")
    right, bottom, slack = crop.left + crop.width, crop.top + height, 1.0  # sliders round
    if min(crop.left, crop.top) < -slack or right > photo_width + slack or bottom > photo_height + slack:
        where = f"{crop.left:.0f} to {right:.0f} across and {crop.top:.0f} to {bottom:.0f} down"
        raise InvalidInput("crop [px]", where, f"within the photo's {photo_width} x {photo_height}")
    if not abs(crop.turn_deg) <= MAX_TURN_DEG:
        raise InvalidInput("turn of the crop [degrees]", crop.turn_deg, f"-{MAX_TURN_DEG:g} to {MAX_TURN_DEG:g}")


def cut_out(photo: Photo, crop: PhotoCrop, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The pixels of a crop, no side longer than 512 px; corners that turn out of the photo repeat its border.

    Args:
        photo: perhaps scaled down.
        crop: in pixels of the photo as it was sent.
        camera: whose proportions the crop has.
    """
    pixels = photo.pixels
    height, width = pixels.shape[:2]
    per_pixel = width / photo.width  # of the pixels that are kept, for one of the photo as it was sent
    across, down = crop.width * per_pixel, crop.width * per_pixel * camera.height / camera.width
    scale = min(1.0, GOAL_SIDE / max(across, down))
    if scale < 1:  # area averaging, then a warp without change of size: no aliasing
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        scale = size[0] / width
    out = max(round(across * scale), 1), max(round(down * scale), 1)
    centre = np.array([crop.left + crop.width / 2, crop.top + crop.width * camera.height / camera.width / 2])
    angle = np.deg2rad(crop.turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # Pixel centres lie at +0.5: a pixel p of the crop is turn (p + 0.5 - out / 2) + centre of the photo, less 0.5.
    shift = centre * per_pixel * scale - 0.5 + turn @ (0.5 - np.array(out) / 2)
    warp = np.column_stack([turn, shift])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(pixels, warp, out, flags=flags, borderMode=cv2.BORDER_REPLICATE)
