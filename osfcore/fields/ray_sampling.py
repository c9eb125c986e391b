"""Rays and pixel colours of an image set, by pixel number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from osfcore.geometry.cameras import Camera
from osfcore.io.image_set import ImageSet

_MARGIN_PX = 3  # beyond the silhouette, so that its edge is learned from both sides


@dataclass(frozen=True, eq=False, slots=True)
class RayBatch:
    """R rays in the frame of a set, with what their pixels show.

    Attributes:
        origins: camera centres [m].
        directions: unit vectors into the scene.
        lights: unit vectors toward the light.
        rgb: linear colour times opacity, that is, over black.
        alpha: opacity.
    """

    origins: Float32[np.ndarray, "R 3"]
    directions: Float32[np.ndarray, "R 3"]
    lights: Float32[np.ndarray, "R 3"]
    rgb: Float32[np.ndarray, "R 3"]
    alpha: Float32[np.ndarray, "R"]


class RaySource:
    """The rays of a set's pixels. A pixel's number counts through images, rows and columns."""

    def __init__(self, images: ImageSet) -> None:
        """Take over a set; its pixels are not copied."""
        self._images = images
        self._origins = np.array([c.T_world_camera.position for c in images.cameras], np.float32)
        matrices = [c.T_world_camera.matrix()[:3, :3] @ np.linalg.inv(c.intrinsics) for c in images.cameras]
        self._from_pixels = np.array(matrices, np.float32)
        self.image_shape = images.rgba.shape[1:3]

    def silhouette_pixels(self) -> Int64[np.ndarray, "n"]:
        """Numbers of the pixels in and close around the silhouettes; the others show that there is nothing."""
        kernel = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
        parts = []
        for number, rgba in enumerate(self._images.rgba):
            near = cv2.dilate((rgba[..., 3] > 0).astype(np.uint8), kernel)
            parts.append(np.flatnonzero(near) + number * near.size)
        return np.concatenate(parts)

    def image_pixels(self, number: int) -> Int64[np.ndarray, "n"]:
        """Numbers of all pixels of one image."""
        size = self.image_shape[0] * self.image_shape[1]
        return np.arange(number * size, (number + 1) * size)

    def batch(self, pixels: Int64[np.ndarray, "R"]) -> RayBatch:
        """Rays through the centres of pixels."""
        height, width = self.image_shape
        image, rest = np.divmod(pixels, height * width)
        row, column = np.divmod(rest, width)
        places = np.stack([column + 0.5, row + 0.5, np.ones(len(pixels))], axis=1).astype(np.float32)
        directions = np.einsum("rij,rj->ri", self._from_pixels[image], places)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rgba = self._images.rgba[image, row, column].astype(np.float32) / 255
        lights = self._images.light_directions[image].astype(np.float32)
        return RayBatch(self._origins[image], directions, lights, rgba[:, :3] * rgba[:, 3:], rgba[:, 3])


def camera_rays(camera: Camera) -> tuple[Float32[np.ndarray, "R 3"], Float32[np.ndarray, "R 3"]]:
    """Origins and directions through all pixel centres of a camera, row by row."""
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    directions = camera.ray_directions(np.stack([column + 0.5, row + 0.5], axis=1)).astype(np.float32)
    return np.broadcast_to(camera.T_world_camera.position.astype(np.float32), directions.shape), directions


def shares_of_views(
    points: Float32[np.ndarray, "n 3"], cameras: Sequence[Camera], alphas: Sequence[np.ndarray], allowed_misses: int
) -> tuple[Float32[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """The smallest opacity that any view shows at points, and which points every view saw within its frame.

    Args:
        points: in the set's frame [m].
        cameras: V views.
        alphas: V images of opacity in [0, 1], float32.
        allowed_misses: that many of the smallest values are passed over: single wrong silhouettes carve nothing away.
    """
    least = np.ones((allowed_misses + 1, len(points)), np.float32)
    framed = np.ones(len(points), bool)
    for camera, alpha in zip(cameras, alphas, strict=True):
        pixels = camera.project(points).astype(np.float32) - 0.5
        inside = np.all((pixels > 0) & (pixels < (camera.width - 1, camera.height - 1)), axis=1)
        framed &= inside
        seen = _sample(alpha, pixels)
        worst = np.where(inside, seen, 1)
        for row in least:  # keep the few smallest, sorted
            row[:], worst = np.minimum(row, worst), np.maximum(row, worst)
    return least[-1], framed


def _sample(image: Float32[np.ndarray, "h w"], pixels: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n"]:
    """Bilinear values; OpenCV wants its maps as images of less than 32,768 columns."""
    width = 4096
    padded = np.zeros((-(-len(pixels) // width) * width, 2), np.float32)
    padded[: len(pixels)] = pixels
    maps = padded.reshape(-1, width, 2)
    values = [
        cv2.remap(image, np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1]), cv2.INTER_LINEAR)
        for part in np.array_split(maps, max(1, len(maps) // 16_384))
    ]
    return np.concatenate(values).ravel()[: len(pixels)]
