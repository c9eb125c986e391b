"""A photograph in the form that the program uses: linear radiance, camera, and masks of its objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped

from osfcore.errors import InvalidInput, shown
from osfcore.geometry.poses import Pose
from osfcore.photo.board import Intrinsics, checked_intrinsics

Masks = Mapping[str, Bool[np.ndarray, "h w"]]  # by name of the object
Box = tuple[float, float, float, float]  # left, top, right, bottom [px]


@dataclass(frozen=True, slots=True)
class WindowFrame:
    """The part of a photograph that a window shows, and the size of the window. It may reach beyond the photograph.

    Attributes:
        left, top, right, bottom: borders of the part, the last two not included [px of the photograph].
        width, height: size of the window [px].
    """

    left: int
    top: int
    right: int
    bottom: int
    width: int
    height: int

    def cut(self, array: Shaped[np.ndarray, "h w *colours"], outside: float = 0.0) -> Shaped[np.ndarray, "*window"]:
        """Return that part of an image, averaged over areas; `outside` beyond the photograph."""
        high, wide = array.shape[:2]
        inner = array[max(self.top, 0) : self.bottom, max(self.left, 0) : self.right]
        border = max(-self.top, 0), max(self.bottom - high, 0), max(-self.left, 0), max(self.right - wide, 0)
        whole = cv2.copyMakeBorder(inner, *border, cv2.BORDER_CONSTANT, value=(outside,) * 4)
        return cv2.resize(whole, (self.width, self.height), interpolation=cv2.INTER_AREA)

    def intrinsics(self, photo: Intrinsics) -> Intrinsics:
        """Return K of the window's camera, from the photograph's [px]."""
        moved = photo.copy()
        moved[:2, 2] -= self.left, self.top
        scale = [[self.width / (self.right - self.left)], [self.height / (self.bottom - self.top)], [1.0]]
        return moved * np.array(scale)

    def points(self, pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Return positions in the photograph as positions in the window [px]."""
        per_px = np.array([self.width, self.height]) / (self.right - self.left, self.bottom - self.top)
        return (pixels - (self.left, self.top)) * per_px

    def placed(self, share: Float32[np.ndarray, "a b"], shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
        """Return the pixels of the whole photograph of which a window marks more than half."""
        whole = cv2.resize(share, (self.right - self.left, self.bottom - self.top)) > 0.5
        top, left = max(self.top, 0), max(self.left, 0)
        bottom, right = min(self.bottom, shape[0]), min(self.right, shape[1])
        placed = np.zeros(shape, bool)
        placed[top:bottom, left:right] = whole[top - self.top : bottom - self.top, left - self.left : right - self.left]
        return placed


@dataclass(frozen=True, eq=False, slots=True)
class Photograph:
    """Radiance, camera and masks of one photo.

    Attributes:
        image: linear radiance in [0, 1].
        well_exposed: pixels whose radiance was measured: no channel is saturated, and not all are black.
        intrinsics: K, focal lengths and principal point [px], pixel centres at +0.5.
        T_world_camera: pose of the camera in the world, OpenCV axes.
        on_table: whether the world's z = 0 is the table's plane; if not, the world is the frame of the first camera.
        masks: pixels that show an object, by its name.
        boxes: drawn around objects whose masks are no more than proposals, by name; masks of others are trusted.
    """

    image: Float32[np.ndarray, "h w 3"]
    well_exposed: Bool[np.ndarray, "h w"]
    intrinsics: Intrinsics
    T_world_camera: Pose
    on_table: bool
    masks: Masks = field(default_factory=dict)
    boxes: Mapping[str, Box] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        image = self.image
        if image.ndim != 3 or image.shape[2] != 3 or not image.size or image.dtype != np.float32:
            given = f"an array of {image.dtype} of shape {image.shape}"
            raise InvalidInput("image of the photo", given, "float32, of shape (height, width, 3)")
        if not (image.min() >= 0 and image.max() <= 1):  # also false for NaN
            given = f"between {image.min():g} and {image.max():g}"
            raise InvalidInput("radiance of the photo", given, "finite and between 0 and 1")
        if self.well_exposed.shape != self.image.shape[:2] or self.well_exposed.dtype != bool:
            given = f"an array of {self.well_exposed.dtype} of shape {self.well_exposed.shape}"
            raise InvalidInput("exposure mask of the photo", given, f"boolean, of shape {self.image.shape[:2]}")
        checked_intrinsics(self.intrinsics, "K of the photo's camera")
        pose = self.T_world_camera
        if pose.position.shape != (3,) or not np.all(np.isfinite(pose.matrix())):
            raise InvalidInput("pose of the photo's camera", pose.position.tolist(), "one pose of finite numbers")
        for name, mask in self.masks.items():
            _check_mask(name, mask, self.image.shape[:2])

    @property
    def height(self) -> int:
        """Height of the image [px]."""
        return self.image.shape[0]

    @property
    def width(self) -> int:
        """Width of the image [px]."""
        return self.image.shape[1]

    def with_masks(self, masks: Masks, boxes: Mapping[str, Box] | None = None) -> Photograph:
        """Return the same photograph with other masks.

        Args:
            masks: by name.
            boxes: around objects whose masks are no more than proposals; None leaves them as they are.

        Raises:
            InvalidInput: if a mask has another size than the image, or is empty.
        """
        return replace(self, masks=dict(masks), boxes=self.boxes if boxes is None else dict(boxes))

    def resized(self, longest: int) -> Photograph:
        """Return the same view with fewer pixels. A small photograph is not changed.

        Radiance is averaged over the area of each new pixel. A new pixel belongs to a mask if more than half of its
        area does, and is well exposed only if all of its area is.

        Args:
            longest: longest side of the new image [px].

        Raises:
            InvalidInput: if `longest` is not positive, or so small that nothing is left of a mask.
        """
        if longest < 1:
            raise InvalidInput("longest side of the photo [px]", longest, "at least 1")
        scale = longest / max(self.height, self.width)
        if scale >= 1:
            return self
        size = max(round(self.width * scale), 1), max(round(self.height * scale), 1)
        scale_x, scale_y = size[0] / self.width, size[1] / self.height
        per_axis = np.array([[scale_x], [scale_y], [1.0]])
        masks = {name: _averaged(mask, size) > 0.5 for name, mask in self.masks.items()}
        for name, mask in masks.items():
            if not mask.any():
                allowed = f"larger, since nothing of {shown(name)} would be left"
                raise InvalidInput("longest side of the photo [px]", longest, allowed)
        image, exposed = np.clip(_averaged(self.image, size), 0, 1), _averaged(~self.well_exposed, size) == 0
        boxes = {n: (a * scale_x, b * scale_y, c * scale_x, d * scale_y) for n, (a, b, c, d) in self.boxes.items()}
        K = self.intrinsics * per_axis
        return replace(self, image=image, well_exposed=exposed, intrinsics=K, masks=masks, boxes=boxes)


def check_shared(marked: Sequence[Set[str]], on_board: Sequence[bool]) -> None:
    """Check that each of several photographs shows the board, or an object that another one shows as well.

    Args:
        marked: names of the objects that are marked in each.
        on_board: whether each shows the board.

    Raises:
        InvalidInput: if one does not, so that nothing shows where it was taken.
    """
    for number, (names, is_on_board) in enumerate(zip(marked, on_board, strict=True)):
        others = {name for k, its in enumerate(marked) if k != number for name in its}
        if len(marked) > 1 and not is_on_board and not names & others:
            what, allowed = f"number of objects marked both in photo {number + 1} and in another", "1 or more, better 2"
            raise InvalidInput(what, 0, f"{allowed}: without a board in view, they show where it was taken")


def mask_box(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "4"]:
    """Return the box of a mask: left, top, right, bottom [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([columns[0], rows[0], columns[-1] + 1.0, rows[-1] + 1.0])


def _averaged(image: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "h w *c"]:
    return cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _check_mask(name: str, mask: np.ndarray, shape: tuple[int, int]) -> None:
    if mask.dtype != bool or mask.ndim != 2:
        given = f"an array of {mask.dtype} of shape {mask.shape}"
        raise InvalidInput(f"mask of {shown(name)}", given, f"boolean, of shape {shape}")
    if mask.shape != shape:
        given, wanted = (f"{s[1]} x {s[0]} px" for s in (mask.shape, shape))
        raise InvalidInput(f"mask of {shown(name)}", given, f"as large as the photo, {wanted}")
    if not mask.any():
        raise InvalidInput(f"mask of {shown(name)}", "empty", "drawn over the object")
