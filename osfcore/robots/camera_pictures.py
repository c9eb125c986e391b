"""Pictures as a robot's cameras encode them, made what an `Observation` holds: linear radiance of moderate size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.errors import InvalidInput, shown
from osfcore.estimation.photometry.camera_response import linear_from_encoded
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.photo.read_photograph import KEPT_SIDE as MOST_SIDE
from osfcore.photo.read_photograph import read_photograph

KEPT_SIDE = 640  # larger pictures are reduced to this; estimates look at less


@dataclass(frozen=True, eq=False, slots=True)
class SentCamera:
    """A camera as a robot describes it: of any image size.

    Attributes:
        name: how it is called.
        T_world_camera: its place over the table.
        intrinsics: K of the pictures that are sent, pixel centres at +0.5 [px].
        width: of these [px].
        height: of these [px].
        distortion: coefficients of OpenCV's model; none where straight lines are straight.
    """

    name: str
    T_world_camera: Pose
    intrinsics: Float[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def kept(self) -> Camera:
        """The camera of the pictures as they are kept.

        Raises:
            InvalidInput: if its values are out of range.
        """
        if not 0 < min(self.width, self.height) <= max(self.width, self.height) <= MOST_SIDE:
            what = f"picture of camera {shown(self.name)} [px]"
            raise InvalidInput(what, f"{self.width} x {self.height}", f"between 1 and {MOST_SIDE} a side")
        scale = min(1.0, KEPT_SIDE / max(self.width, self.height))
        width, height = round(scale * self.width), round(scale * self.height)
        ratio = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.name, self.T_world_camera, self.intrinsics * ratio, width, height)

    def radiance(self, picture: bytes) -> Float32[np.ndarray, "h w 3"]:
        """A JPEG or PNG file of this camera, sRGB, as linear radiance through `kept`.

        Raises:
            CorruptFile: if it is no such file.
            InvalidInput: if it has another size than was described.
        """
        encoded = read_photograph(picture).encoded
        self._check_size(encoded.shape[:2])
        linear = linear_from_encoded(encoded / np.iinfo(encoded.dtype).max, "srgb").astype(np.float32)
        return self._reduced(self._straight(linear), cv2.INTER_AREA)

    def mask(self, picture: bytes) -> Bool[np.ndarray, "h w"]:
        """A mask of this camera, more than 127 being the object."""
        grey = read_photograph(picture).eight_bit[..., 0].astype(np.float32)
        self._check_size(grey.shape)
        return self._reduced(self._straight(grey), cv2.INTER_AREA) > 127

    def _check_size(self, shape: tuple[int, ...]) -> None:
        if shape != (self.height, self.width):
            what = f"picture of camera {shown(self.name)} [px]"
            raise InvalidInput(what, f"{shape[1]} x {shape[0]}", f"{self.width} x {self.height}, as the robot tells")

    def _straight(self, image: np.ndarray) -> np.ndarray:
        if not any(self.distortion):
            return image
        K = self.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's pixel centres are whole
        return cv2.undistort(image, K, np.array(self.distortion))

    def _reduced(self, image: np.ndarray, how: int) -> np.ndarray:
        size = (self.kept().width, self.kept().height)
        return image if size == (self.width, self.height) else cv2.resize(image, size, interpolation=how)


def observation_of(
    cameras: Sequence[SentCamera],
    pictures: Sequence[bytes],
    names: tuple[str, ...],
    pusher: Float[np.ndarray, "3"],
    time_s: float,
    masks: Mapping[tuple[str, str], bytes] | None = None,
) -> Observation:
    """Everything that was sent, as an observation.

    Args:
        cameras: that took the pictures.
        pictures: one of each, as files.
        names: of the objects, which the owner tells.
        pusher: its centre [m].
        time_s: since the first one [s].
        masks: files by names of camera and object, where the robot has them; what is left out is not visible.

    Raises:
        CorruptFile: if one is no picture.
        InvalidInput: if one has another size than was described, or the cameras differ in size.
    """
    kept = tuple(camera.kept() for camera in cameras)
    sizes = sorted({f"{camera.width} x {camera.height}" for camera in kept})
    if len(sizes) != 1:
        raise InvalidInput("sizes of the robot's cameras [px]", ", ".join(sizes) or "none", "one size for all of them")
    images = np.stack([camera.radiance(picture) for camera, picture in zip(cameras, pictures, strict=True)])
    outlines = None
    if masks is not None:
        outlines = np.zeros((len(kept), len(names), *images.shape[1:3]), bool)
        for view, camera in enumerate(cameras):
            for number, name in enumerate(names):
                if (camera.name, name) in masks:
                    outlines[view, number] = camera.mask(masks[camera.name, name])
    return Observation(kept, images, names, outlines, pusher, time_s)
