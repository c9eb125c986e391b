"""The part of a photograph around one object's mask, at the resolution that a search asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import distance_transform_edt

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.photo.photograph import Photograph

_MARGIN = 0.4  # of the mask's longest side, on each side
_MIN_PIXELS = 30  # of a mask in the photograph


@dataclass(frozen=True, slots=True)
class WindowFrame:
    """Which part of a photograph a window shows, and its size; it may reach beyond the photograph.

    Attributes:
        left, top, right, bottom: of the part, the last two not included [px of the photograph].
        width, height: of the window [px].
    """

    left: int
    top: int
    right: int
    bottom: int
    width: int
    height: int

    def cut(self, array: Float32[np.ndarray, "h w *colours"], outside: float = 0.0) -> Float32[np.ndarray, "*window"]:
        """That part of an image, averaged over areas; `outside` beyond the photograph."""
        high, wide = array.shape[:2]
        inner = array[max(self.top, 0) : self.bottom, max(self.left, 0) : self.right]
        border = max(-self.top, 0), max(self.bottom - high, 0), max(-self.left, 0), max(self.right - wide, 0)
        whole = cv2.copyMakeBorder(inner, *border, cv2.BORDER_CONSTANT, value=(outside,) * 4)
        return cv2.resize(whole, (self.width, self.height), interpolation=cv2.INTER_AREA)

    def intrinsics(self, photo: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Of the window's camera, from the photograph's [px]."""
        moved = photo.copy()
        moved[:2, 2] -= self.left, self.top
        scale = [[self.width / (self.right - self.left)], [self.height / (self.bottom - self.top)], [1.0]]
        return moved * np.array(scale)


@dataclass(frozen=True, eq=False, slots=True)
class ObjectWindow:
    """A window of a photograph.

    Attributes:
        image: linear radiance.
        luminance: its mean over colours.
        mask: pixels of the object.
        known: pixels of which the mask tells whether they show the object: none that another object may hide, and none
            outside the photograph.
        plain: well exposed pixels within the mask, one pixel away from its border.
        signed_distance: to the mask's border, positive inside [px].
        intrinsics: of the window [px].
        T_camera_world: the inverse of the camera's pose.
        cut: share of the mask's border that lies on the photograph's edge.
        frame: which part of the photograph it is.
    """

    image: Float32[np.ndarray, "h w 3"]
    luminance: Float32[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]
    plain: Bool[np.ndarray, "h w"]
    signed_distance: Float32[np.ndarray, "h w"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_camera_world: Pose
    cut: float
    frame: WindowFrame

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        height, width = self.mask.shape
        return height, width

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Of the mask (x, y) [px]."""
        rows, columns = np.nonzero(self.mask)
        return np.array([columns.mean(), rows.mean()]) + 0.5

    def camera(self, name: str) -> Camera:
        """The window's camera, for renderers."""
        height, width = self.size
        return Camera(name, self.T_camera_world.inverse(), self.intrinsics, width, height)


def object_windows(photos: Sequence[Photograph], name: str, side: int) -> tuple[ObjectWindow, ...]:
    """A window of each photograph with a mask of the object.

    Args:
        photos: of one scene.
        name: of the object.
        side: longest side that the mask shall have [px]; smaller masks are not enlarged.

    Raises:
        InvalidInput: if no photograph has a mask of the object, or it has too few pixels.
    """
    windows = tuple(_window(photo, name, side) for photo in photos if name in photo.masks)
    if not windows:
        raise InvalidInput(f"mask of {name}", "missing", "given in at least one photo; draw a box around the object")
    return windows


def _window(photo: Photograph, name: str, side: int) -> ObjectWindow:
    mask = photo.masks[name]
    if mask.sum() < _MIN_PIXELS:
        allowed = f"{_MIN_PIXELS} pixels or more; come closer or take a larger photo"
        raise InvalidInput(f"size of the mask of {name}", f"{int(mask.sum())} pixels", allowed)
    others = np.zeros_like(mask)
    for other, its in photo.masks.items():
        if other != name:
            others |= its
    frame = _frame(mask, side)
    own = frame.cut(mask.astype(np.float32)) > 0.5
    hidden = frame.cut((others & ~mask).astype(np.float32)) > 0.5
    beyond = frame.cut(np.zeros(mask.shape, np.float32), 1.0) > 0.5
    exposed = frame.cut(photo.well_exposed.astype(np.float32)) > 0.99
    core = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    image = np.ascontiguousarray(frame.cut(photo.image), np.float32)
    return ObjectWindow(
        image,
        image.mean(axis=-1),
        own,
        ~(hidden | beyond),
        core & exposed,
        signed_distance(own),
        frame.intrinsics(photo.intrinsics),
        photo.T_world_camera.inverse(),
        _share_cut(mask),
        frame,
    )


def _frame(mask: Bool[np.ndarray, "h w"], side: int) -> WindowFrame:
    rows, columns = np.nonzero(mask)
    longest = int(max(np.ptp(rows), np.ptp(columns))) + 1
    margin = int(_MARGIN * longest)
    left, top = int(columns.min()) - margin, int(rows.min()) - margin
    right, bottom = int(columns.max()) + 1 + margin, int(rows.max()) + 1 + margin
    scale = min(1.0, side / longest)
    width, height = max(round((right - left) * scale), 1), max(round((bottom - top) * scale), 1)
    return WindowFrame(left, top, right, bottom, width, height)


def _share_cut(mask: Bool[np.ndarray, "h w"]) -> float:
    at_edge = int(mask[[0, -1]].sum() + mask[:, [0, -1]].sum())
    border = int((mask & ~(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)).sum())
    return at_edge / max(border + at_edge, 1)


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Distance from each pixel's centre to the border of a mask, positive inside [px]."""
    inside, outside = np.asarray(distance_transform_edt(mask)), np.asarray(distance_transform_edt(~mask))
    return np.where(mask, inside - 0.5, 0.5 - outside).astype(np.float32)
