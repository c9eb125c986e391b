"""What lies between a scene and a program: noise, compression, encodings, calibrations and masks that are a bit off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.estimation.photometry.camera_response import linear_of_srgb, srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.io.image_file import to_uint8

ImageChange = Literal["none", "noise", "jpeg", "srgb_8bit", "srgb_8bit_decoded", "srgb_noise_jpeg"]
NOISE_SIGMA = 0.02  # of each channel of each pixel
JPEG_QUALITY = 80


def received(
    image: Float[np.ndarray, "h w 3"], change: ImageChange, rng: np.random.Generator
) -> Float[np.ndarray, "h w 3"]:
    """An image as a program gets it; whatever else happens, sensors saturate at 1.

    Args:
        image: linear radiance.
        change: "noise" adds Gaussian noise; "jpeg" stores linear values in a JPEG file; "srgb_8bit" hands over sRGB
            values of 8 bit where linear ones are expected; "srgb_8bit_decoded" makes them linear again;
            "srgb_noise_jpeg" hands over sRGB values with half of the noise, from a JPEG file.
        rng: draws the noise.

    Returns:
        Values in [0, 1].
    """
    image = np.clip(image, 0, 1)
    match change:
        case "noise":
            noise = rng.standard_normal(image.shape, np.float32)
            return np.clip(image + np.float32(NOISE_SIGMA) * noise, 0, 1)
        case "jpeg":
            return _through_jpeg(to_uint8(image)).astype(np.float32) / 255
        case "srgb_8bit":
            return to_uint8(srgb_of_linear(image)).astype(np.float32) / 255
        case "srgb_8bit_decoded":
            return linear_of_srgb(to_uint8(srgb_of_linear(image)).astype(np.float32) / 255)
        case "srgb_noise_jpeg":
            noisy = image + np.float32(NOISE_SIGMA / 2) * rng.standard_normal(image.shape, np.float32)
            return _through_jpeg(to_uint8(srgb_of_linear(np.clip(noisy, 0, 1)))).astype(np.float32) / 255
        case "none":
            return image


def _through_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    assert decoded is not None
    return np.asarray(decoded, np.uint8)


def resized_masks(masks: Bool[np.ndarray, "V N h w"], radius_px: int) -> Bool[np.ndarray, "V N h w"]:
    """Masks that reach farther by a number of pixels, or less far where it is negative; the image's border eats none.

    Masks that reach farther may overlap, as those of a segmentation that looks at one object after the other.
    """
    if radius_px == 0:
        return masks
    steps = np.arange(-abs(radius_px), abs(radius_px) + 1) ** 2
    disc = (steps[:, None] + steps <= radius_px**2).astype(np.uint8)
    change = cv2.dilate if radius_px > 0 else cv2.erode
    flat = masks.reshape(-1, *masks.shape[-2:]).astype(np.uint8)
    return np.array([change(mask, disc) for mask in flat], bool).reshape(masks.shape)


@dataclass(frozen=True, eq=False, slots=True)
class CameraError:
    """How a camera stands otherwise than its calibration tells.

    Attributes:
        rotation: rotation vector about axes of the world through the optical centre [rad].
        shift: of the optical centre in the world [m].
    """

    rotation: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]

    @staticmethod
    def random(rng: np.random.Generator, turn_rad: float, shift_m: float) -> CameraError:
        """An error of given size, about a random axis and in a random direction."""
        axis, direction = rng.standard_normal((2, 3))
        return CameraError(turn_rad * axis / np.linalg.norm(axis), shift_m * direction / np.linalg.norm(direction))

    def applied(self, camera: Camera) -> Camera:
        """The camera as it stands."""
        told = camera.T_world_camera
        quaternion = quaternion_multiply(quaternion_exp(self.rotation), told.quaternion)
        return replace(camera, T_world_camera=Pose(told.position + self.shift, quaternion))
