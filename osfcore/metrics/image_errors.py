"""Errors of images: PSNR and SSIM, over whole images or masks.

Images hold linear radiance in [0, 1]; a mean over images is the mean of each image's figure, never of pooled pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from osfcore.errors import InvalidInput

MASK_MARGIN_PX = 2
MOST_DB = 100.0
_SSIM_SIDE = 11


def psnr(
    truth: Float[np.ndarray, "h w 3"], image: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Peak signal-to-noise ratio for values in [0, 1]: -10 log10(MSE) [dB].

    The MSE is the mean over the pixels of the mask and the three colours. A difference of d everywhere gives
    -20 log10(d). Equal images would give infinity; they get 100 dB, so that means stay finite.

    Args:
        truth: linear radiance in [0, 1].
        image: what is compared with it.
        mask: pixels that count; all by default.

    Raises:
        InvalidInput: if shapes differ, or the mask has no pixel.
    """
    _same_shape(truth, image)
    x, y = truth.astype(np.float64), image.astype(np.float64)
    if mask is not None:
        if mask.shape != truth.shape[:2] or not mask.any():
            size = f"of shape {mask.shape} with {int(mask.sum())} pixels"
            raise InvalidInput("mask", size, "as the image, not empty")
        x, y = x[mask], y[mask]
    with np.errstate(divide="ignore"):
        return float(min(peak_signal_noise_ratio(x, y, data_range=1), MOST_DB))


def ssim(truth: Float[np.ndarray, "h w 3"], image: Float[np.ndarray, "h w 3"]) -> float:
    """Structural similarity (Wang et al., 2004), 1 for equal images.

    As in the paper: Gaussian window of 11 x 11 px with sigma 1.5 px, K1 = 0.01, K2 = 0.03, values in [0, 1]; the mean
    over the colours and all windows that lie inside the image.

    Raises:
        InvalidInput: if shapes differ, or a side is shorter than 11 px.
    """
    _same_shape(truth, image)
    if min(truth.shape[:2]) < _SSIM_SIDE:
        raise InvalidInput("sides of the images [px]", truth.shape[:2], f"at least {_SSIM_SIDE}")
    wang = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    x, y = truth.astype(np.float64), image.astype(np.float64)
    return float(np.mean(structural_similarity(x, y, data_range=1, channel_axis=2, **wang)))


def dilated(mask: Bool[np.ndarray, "h w"], margin_px: int = MASK_MARGIN_PX) -> Bool[np.ndarray, "h w"]:
    """Return the mask, grown by some pixels in every direction, diagonals included."""
    kernel = np.ones((2 * margin_px + 1,) * 2, np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def _same_shape(truth: np.ndarray, image: np.ndarray) -> None:
    if truth.shape != image.shape or truth.ndim != 3:
        raise InvalidInput("shape of the image", image.shape, f"that of the truth, {truth.shape}")
