"""Comparing images: PSNR, SSIM, and sheets that show truth, ours and the difference.

Images hold linear radiance in [0, 1]; a mean over images is the mean of each image's figure, never of pooled pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.errors import CannotWrite, InvalidInput
from osfcore.files import write_atomically

MASK_MARGIN_PX = 2
MOST_DB = 100.0
DIFFERENCE_GAIN = 4
_SSIM_SIDE, _SSIM_SIGMA = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2
_LABEL_PX = 16
_ROW_LABEL_PX = 40
_PAPER = 255


def psnr(
    truth: Float[np.ndarray, "h w 3"], image: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Peak signal-to-noise ratio for values in [0, 1]: -10 log10(MSE) [dB].

    The MSE is the mean over the pixels of the mask and the three colours. A difference of d everywhere gives
    -20 log10(d). Equal images would give infinity; they get 100 dB, so that means stay finite.

    Raises:
        InvalidInput: if shapes differ, or the mask has no pixel.
    """
    _same_shape(truth, image)
    error = (truth.astype(np.float64) - image) ** 2
    if mask is not None:
        if mask.shape != truth.shape[:2] or not mask.any():
            raise InvalidInput(
                "mask", f"of shape {mask.shape} with {int(mask.sum())} pixels", "as the image, not empty"
            )
        error = error[mask]
    return float(-10 * np.log10(max(float(error.mean()), 10 ** (-MOST_DB / 10))))


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
    x, y = truth.astype(np.float64), image.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    var_x = _window_mean(x * x) - mean_x**2
    var_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _SSIM_C1) / (mean_x**2 + mean_y**2 + _SSIM_C1)
    structure = (2 * covariance + _SSIM_C2) / (var_x + var_y + _SSIM_C2)
    return float((luminance * structure).mean())


def dilated(mask: Bool[np.ndarray, "h w"], margin_px: int = MASK_MARGIN_PX) -> Bool[np.ndarray, "h w"]:
    """The mask, grown by some pixels in every direction, diagonals included."""
    kernel = np.ones((2 * margin_px + 1,) * 2, np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """One column of a contact sheet.

    Attributes:
        label: a few letters above it.
        truth: what it should look like.
        ours: what it looks like.
    """

    label: str
    truth: UInt8[np.ndarray, "h w 3"]
    ours: UInt8[np.ndarray, "h w 3"]


def as_bytes(image: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1] as 8 bit."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def contact_sheet(
    columns: Sequence[Comparison], *, per_row: int = 8, truth: str = "truth"
) -> UInt8[np.ndarray, "H W 3"]:
    """Columns side by side, in blocks of `per_row`: truth, ours and the absolute difference x 4, below each other.

    Args:
        columns: what to show.
        per_row: columns in a block.
        truth: what to call the first row, in a few letters.

    Raises:
        InvalidInput: if there is nothing to show, or sizes differ.
    """
    if len({c.truth.shape for c in columns} | {c.ours.shape for c in columns}) != 1:
        raise InvalidInput("images of a contact sheet", f"{len(columns)} pairs", "at least one, all of one size")
    blocks = [_block(columns[i : i + per_row], truth) for i in range(0, len(columns), per_row)]
    width = max(block.shape[1] for block in blocks)
    padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_PAPER) for b in blocks]
    return np.vstack(padded)


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    done, data = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise CannotWrite(path, "the image could not be encoded")
    write_atomically(path, data.tobytes())


def _same_shape(truth: np.ndarray, image: np.ndarray) -> None:
    if truth.shape != image.shape or truth.ndim != 3:
        raise InvalidInput("shape of the image", image.shape, f"that of the truth, {truth.shape}")


def _window_mean(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "y x 3"]:
    """Weighted means over the windows that lie inside the image."""
    blurred = cv2.GaussianBlur(image, (_SSIM_SIDE, _SSIM_SIDE), _SSIM_SIGMA)
    edge = _SSIM_SIDE // 2
    return blurred[edge:-edge, edge:-edge]


def _block(columns: Sequence[Comparison], first: str) -> UInt8[np.ndarray, "H W 3"]:
    """Three rows with a line of labels above and a margin of row names on the left."""
    height, width = columns[0].truth.shape[:2]
    sheet = np.full((_LABEL_PX + 3 * height, _ROW_LABEL_PX + len(columns) * width, 3), _PAPER, np.uint8)
    for row, name in enumerate((first, "ours", f"diff x{DIFFERENCE_GAIN}")):
        put_text(sheet, name, (1, _LABEL_PX + row * height + height // 2), _ROW_LABEL_PX)
    for number, column in enumerate(columns):
        left = _ROW_LABEL_PX + number * width
        put_text(sheet, column.label, (left + 2, _LABEL_PX - 5), width - 4)
        difference = np.abs(column.truth.astype(int) - column.ours)
        shown = np.clip(DIFFERENCE_GAIN * difference, 0, 255).astype(np.uint8)
        for row, image in enumerate((column.truth, column.ours, shown)):
            top = _LABEL_PX + row * height
            sheet[top : top + height, left : left + width] = image
    return sheet


def put_text(sheet: UInt8[np.ndarray, "H W 3"], text: str, place: tuple[int, int], width: int) -> None:
    """Small black letters, cut to a width [px]."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.32
    while text and cv2.getTextSize(text, font, scale, 1)[0][0] > width:
        text = text[:-1]
    cv2.putText(sheet, text, place, font, scale, (0, 0, 0), 1, cv2.LINE_AA)
