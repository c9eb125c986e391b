"""Photos that strangers send: looked at by their header first, then decoded to 8-bit RGB of a moderate size.

A part of one becomes a goal image: a rectangle in the photo's own pixels, perhaps turned.
Decoders have defects, so the service leaves them to a process of its own, which may take too long, die, or ask for too
much memory without hurting anybody.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.photo.read_photograph import MIN_SIDE, read_photograph

from ..processes.child_process import limit_memory
from ..processes.client import ProcessClient, ProcessHangs
from ..processes.photo_process import PhotoRefused
from ..processes.server import ProcessServer

GOAL_SIDE = 512  # of goal images at most [px]: estimators look at less
MAX_TURN_DEG = 180.0
_PATIENCE_S = 20.0  # sound photos take two, and a busy machine some to start the process
_MEMORY_BYTES = 3 << 29  # sound photos take two thirds of it


@dataclass(frozen=True, eq=False, slots=True)
class Photo:
    """A decoded photo, upright.

    Attributes:
        pixels: perhaps scaled down.
        width: as it was sent [px].
        height: as it was sent [px].
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    width: int
    height: int


def read_photo(data: bytes) -> Photo:
    """The pixels of a photo in any usual format, see `read_photograph`, in 8 bit.

    Raises:
        PhotoRefused: if it is no such image, is broken, or has too many or too few pixels.
    """
    try:
        raw = read_photograph(data)
    except CorruptFile as error:
        raise PhotoRefused(str(error)) from None
    return Photo(raw.eight_bit, *raw.sent_size)


class PhotoReader:
    """Decodes photos in a process of its own, one at a time; it starts at the first photo, and again if it dies.

    Args:
        read: a function of a module that takes a photo and returns it decoded.
        answer_s: how long it may take, the start of the process included [s].
    """

    def __init__(self, read: Callable[[bytes], Photo] = read_photo, answer_s: float = _PATIENCE_S) -> None:
        self._answer_s = answer_s
        self._process = ProcessClient(reader_main, (read,), "decoder of photos", answer_s=answer_s)
        self._one_at_a_time = threading.Lock()  # so that none waits for another's time

    def read(self, data: bytes) -> Photo:
        """A photo, see `read_photo`. Blocks.

        Raises:
            PhotoRefused: if it cannot be used, or takes too long.
            ProcessUnavailable: if the process died.
        """
        try:
            with self._one_at_a_time:
                return self._process.call(data)
        except ProcessHangs:
            late = f"The photo could not be decoded within {self._answer_s:g} s; save it anew as a plain JPEG."
            raise PhotoRefused(late) from None

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        self._process.stop()


def reader_main(server: ProcessServer, read: Callable[[bytes], Photo]) -> None:
    """Decode the photos that are sent."""
    limit_memory(_MEMORY_BYTES)
    server.serve(lambda data, _: read(data))


@dataclass(frozen=True, slots=True)
class PhotoCrop:
    """A rectangle in the proportions of a camera.

    Attributes:
        left: of the rectangle before it is turned [px of the photo].
        top: likewise.
        width: of the rectangle; its height follows from the camera's proportions.
        turn_deg: by which it is turned clockwise about its centre.
    """

    left: FiniteFloat
    top: FiniteFloat
    width: FiniteFloat
    turn_deg: FiniteFloat = 0.0


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
