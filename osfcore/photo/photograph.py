"""A photograph as the rest of the program sees it: linear radiance, camera, and where its objects are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.errors import InvalidInput, shown
from osfcore.geometry.poses import Pose


@dataclass(frozen=True, eq=False, slots=True)
class Photograph:
    """Radiance, camera and masks of one photo.

    Attributes:
        image: linear radiance in [0, 1].
        well_exposed: where the radiance was measured: no channel saturated, not all of them black.
        intrinsics: K, focal lengths and principal point [px], pixel centres at +0.5.
        T_world_camera: pose of the camera, OpenCV axes.
        on_table: whether the world's z = 0 is the table's plane; if not, the world is the camera's own frame.
        masks: which pixels show an object, by its name.
    """

    image: Float32[np.ndarray, "h w 3"]
    well_exposed: Bool[np.ndarray, "h w"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_world_camera: Pose
    on_table: bool
    masks: Mapping[str, Bool[np.ndarray, "h w"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        _check_image(self.image)
        if self.well_exposed.shape != self.image.shape[:2] or self.well_exposed.dtype != bool:
            given = f"an array of {self.well_exposed.dtype} of shape {self.well_exposed.shape}"
            raise InvalidInput("exposure mask of the photo", given, f"boolean, of shape {self.image.shape[:2]}")
        K = self.intrinsics
        is_sane = K.shape == (3, 3) and np.all(np.isfinite(K)) and K[0, 0] > 0 and K[1, 1] > 0
        if not is_sane or not np.array_equal(K[2], (0, 0, 1)):
            allowed = "a 3 x 3 matrix with positive focal lengths and last row 0, 0, 1"
            raise InvalidInput("K of the photo's camera", K.tolist(), allowed)
        pose = self.T_world_camera
        if pose.position.shape != (3,) or not np.all(np.isfinite(pose.matrix())):
            raise InvalidInput("pose of the photo's camera", pose.position.tolist(), "one pose of finite numbers")
        if not self.on_table and not np.allclose(pose.matrix(), np.eye(4)):
            raise InvalidInput("pose of the photo's camera", "another", "the identity where no table is known")
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

    def with_masks(self, masks: Mapping[str, Bool[np.ndarray, "h w"]]) -> Photograph:
        """Return the same photograph with other masks.

        Raises:
            InvalidInput: if a mask has another size than the image, or is empty.
        """
        return replace(self, masks=dict(masks))

    def resized(self, longest: int) -> Photograph:
        """Return the same view with fewer pixels; one that is small enough already stays as it is.

        Radiance is averaged over the area of each new pixel. A new pixel belongs to a mask if more than half of its
        area does, and is well exposed only if all of its area is.

        Args:
            longest: side of the new image [px].

        Raises:
            InvalidInput: if `longest` is not positive, or so small that nothing is left of a mask.
        """
        if longest < 1:
            raise InvalidInput("longest side of the photo [px]", longest, "at least 1")
        scale = longest / max(self.height, self.width)
        if scale >= 1:
            return self
        size = max(round(self.width * scale), 1), max(round(self.height * scale), 1)
        per_axis = np.array([[size[0] / self.width], [size[1] / self.height], [1.0]])
        masks = {name: _averaged(mask, size) > 0.5 for name, mask in self.masks.items()}
        for name, mask in masks.items():
            if not mask.any():
                allowed = f"larger, since nothing of {shown(name)} would be left"
                raise InvalidInput("longest side of the photo [px]", longest, allowed)
        return replace(
            self,
            image=np.clip(_averaged(self.image, size), 0, 1),
            well_exposed=_averaged(~self.well_exposed, size) == 0,
            intrinsics=self.intrinsics * per_axis,
            masks=masks,
        )


def _averaged(image: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "h w *c"]:
    return cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _check_image(image: np.ndarray) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or not image.size or image.dtype != np.float32:
        given = f"an array of {image.dtype} of shape {image.shape}"
        raise InvalidInput("image of the photo", given, "float32, of shape (height, width, 3)")
    if not (image.min() >= 0 and image.max() <= 1):  # also false for NaN
        given = f"between {image.min():g} and {image.max():g}"
        raise InvalidInput("radiance of the photo", given, "finite and between 0 and 1")


def _check_mask(name: str, mask: np.ndarray, shape: tuple[int, int]) -> None:
    if mask.dtype != bool or mask.ndim != 2:
        given = f"an array of {mask.dtype} of shape {mask.shape}"
        raise InvalidInput(f"mask of {shown(name)}", given, f"boolean, of shape {shape}")
    if mask.shape != shape:
        given, wanted = (f"{s[1]} x {s[0]} px" for s in (mask.shape, shape))
        raise InvalidInput(f"mask of {shown(name)}", given, f"as large as the photo, {wanted}")
    if not mask.any():
        raise InvalidInput(f"mask of {shown(name)}", "empty", "drawn over the object")
