"""One photograph: linear radiance, what is well exposed, its camera, and masks of objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose

_MIN_SIDE = 64


@dataclass(frozen=True, eq=False, slots=True)
class Photograph:
    """A photograph.

    Attributes:
        image: linear radiance in [0, 1].
        well_exposed: pixels whose values tell: not saturated.
        intrinsics: focal lengths and principal point, 3 x 3, pixel centres at +0.5 [px].
        T_world_camera: pose of the camera.
        on_table: z = 0 of the world is the table's plane; otherwise the world is the camera's own frame.
        masks: pixels of objects by name.
    """

    image: Float32[np.ndarray, "h w 3"]
    well_exposed: Bool[np.ndarray, "h w"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_world_camera: Pose = field(default_factory=Pose.identity)
    on_table: bool = False
    masks: Mapping[str, Bool[np.ndarray, "h w"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check sizes and numbers.

        Raises:
            InvalidInput: if the photograph is too small, the camera makes no sense, or a mask does not fit.
        """
        size = self.image.shape[:2]
        if min(size) < _MIN_SIDE:
            raise InvalidInput(
                "size of the photo", f"{size[1]} x {size[0]} pixels", f"{_MIN_SIDE} x {_MIN_SIDE} or more"
            )
        K = self.intrinsics
        is_sane = K.shape == (3, 3) and np.all(np.isfinite(K)) and K[0, 0] > 0 and K[1, 1] > 0
        if not is_sane or not np.array_equal(K[2], (0, 0, 1)):
            allowed = "a 3 x 3 matrix with positive focal lengths [px] and last row 0, 0, 1"
            raise InvalidInput("K of the photo", K.tolist(), allowed)
        for name, mask in {"what is well exposed": self.well_exposed, **self.masks}.items():
            if mask.shape != size:
                allowed = f"that of the photo, {size[1]} x {size[0]} pixels"
                raise InvalidInput(f"size of the mask of {name}", f"{mask.shape[1]} x {mask.shape[0]} pixels", allowed)
        for name, mask in self.masks.items():
            if not mask.any():
                raise InvalidInput(f"mask of {name}", "empty", "the pixels that show it; draw a box around the object")

    def reduced(self, longest: int) -> Photograph:
        """The same photograph with its longest side at most `longest` pixels, averaged over areas."""
        height, width = self.image.shape[:2]
        scale = longest / max(height, width)
        if scale >= 1:
            return self
        size = max(round(width * scale), 1), max(round(height * scale), 1)

        def share(mask: np.ndarray) -> np.ndarray:
            return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)

        return replace(
            self,
            image=cv2.resize(self.image, size, interpolation=cv2.INTER_AREA),
            well_exposed=share(self.well_exposed) > 0.99,
            intrinsics=self.intrinsics * np.array([[size[0] / width], [size[1] / height], [1.0]]),
            masks={name: share(mask) > 0.5 for name, mask in self.masks.items()},
        )
