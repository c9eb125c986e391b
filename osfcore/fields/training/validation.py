"""Measuring a field on images that it did not learn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8

from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.ray_sampling import RaySource
from osfcore.fields.training.optimization import composite
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import ImageSet

MASK_MARGIN_PX = 2
_GLANCE_IMAGES = 6
_DIFFERENCE_GAIN = 4
_MIN_WEIGHT = 1e-5
_MOST_SAMPLES = 192
_MIN_ERROR = 1e-10  # 100 dB


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """A measurement.

    Attributes:
        psnr_full: mean over images of the PSNR of the whole image over black [dB].
        psnr_mask: mean over images of the PSNR inside the silhouette, dilated by 2 px [dB].
        images: how many were looked at.
        preview: one of them: truth, ours, difference x 4.
    """

    psnr_full: float
    psnr_mask: float
    images: int
    preview: UInt8[np.ndarray, "h w3 3"]


class Holdout:
    """The test images of a set."""

    def __init__(self, images: ImageSet) -> None:
        """Take over a split; pixels are not copied."""
        self._images, self._source = images, RaySource(images)

    def glance(self, field: KiloOSF) -> Look:
        """Measure on a few images."""
        count = len(self._images.cameras)
        return self._look(field, np.unique(np.linspace(0, count - 1, _GLANCE_IMAGES).astype(int)).tolist())

    def everything(self, field: KiloOSF) -> Look:
        """Measure on all images."""
        return self._look(field, range(len(self._images.cameras)))

    def beside(self, fields: Sequence[KiloOSF], count: int = 3) -> UInt8[np.ndarray, "h w 3"]:
        """A few images under each other: the truth, and beside it what each of the fields makes of it."""
        rows = []
        for number in np.unique(np.linspace(0, len(self._images.cameras) - 1, count).astype(int)).tolist():
            pairs = [self._pair(KiloQuery(field), field, number) for field in fields]
            rows.append(np.hstack([pairs[0][0], *(ours for _, ours in pairs)]))
        return to_uint8(np.vstack(rows))

    def _look(self, field: KiloOSF, numbers: Sequence[int]) -> Look:
        query = KiloQuery(field)
        full, inside, preview = [], [], None
        for number in numbers:
            truth, ours = self._pair(query, field, number)
            error = np.mean((truth - ours) ** 2, axis=-1)
            full.append(_decibels(error))
            inside.append(_decibels(error[dilated_mask(self._images.rgba[number, ..., 3])]))
            if preview is None:
                strip = np.hstack([truth, ours, _DIFFERENCE_GAIN * np.abs(truth - ours)])
                preview = to_uint8(strip)
        assert preview is not None, "a set has at least one test image"
        return Look(float(np.mean(full)), float(np.mean(inside)), len(full), preview)

    @torch.no_grad()
    def _pair(self, query: KiloQuery, field: KiloOSF, number: int) -> tuple[np.ndarray, np.ndarray]:
        rays = self._source.batch(self._source.image_pixels(number))
        colour, _ = composite(query, field, rays, min_weight=_MIN_WEIGHT, most=_MOST_SAMPLES)
        shape = (*self._source.image_shape, 3)
        ours: Float32[np.ndarray, "h w 3"] = np.clip(colour.numpy(), 0, 1).reshape(shape)
        return rays.rgb.reshape(shape), ours


def dilated_mask(alpha: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The silhouette, grown by 2 px."""
    kernel = np.ones((2 * MASK_MARGIN_PX + 1,) * 2, np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def _decibels(squared_error: Float[np.ndarray, "*shape"]) -> float:
    """PSNR of values in [0, 1]; at most 100 dB."""
    return float(-10 * np.log10(max(float(np.mean(squared_error)), _MIN_ERROR)))
