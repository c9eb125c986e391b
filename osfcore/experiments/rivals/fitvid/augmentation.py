"""Variations of videos while FitVid learns: a random crop and one random change of colours, the same for all frames.

Deviations from the paper, which takes most operations of RandAugment (Cubuk et al., 2020): none that moves the image
(flips, rotations, shears, translations), for actions stay what they are and would then point elsewhere; a crop is close
enough to a camera that moved. The strength of a change is drawn, for the published program's fixed one leaves colour,
contrast and brightness as they are. No equalisation of histograms. What an operation reads off the image, such as the
mean grey that contrast is relative to, it reads off the whole video.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

LEAST_CROP = 0.8  # of the side
_STRENGTH = 0.3  # by which colour, contrast, brightness and sharpness are changed at most
_BITS = (5, 9)  # of colours after posterisation: the first, and the one after the last
_GREY = (0.299, 0.587, 0.114)

Video = Float[Tensor, "T 3 h w"]


def augmented(videos: Float[Tensor, "B T 3 h w"], rng: np.random.Generator) -> Float[Tensor, "B T 3 h w"]:
    """Each video with a crop and a change of colours of its own.

    Args:
        videos: in [0, 1], square.
        rng: draws crops and changes.

    Returns:
        Videos of the same size in [0, 1].
    """
    return torch.stack([_recoloured(_cropped(video, rng), rng).clamp(0, 1) for video in videos])


def _cropped(video: Video, rng: np.random.Generator) -> Video:
    """A square of at least four fifths of the side, brought back to the video's size."""
    full = video.shape[-1]
    side = int(rng.integers(round(LEAST_CROP * full), full + 1))
    top, left = rng.integers(full - side + 1, size=2)
    crop = video[..., top : top + side, left : left + side]
    return functional.interpolate(crop, (full, full), mode="bilinear", align_corners=False)


def _recoloured(video: Video, rng: np.random.Generator) -> Video:
    change = _CHANGES[rng.integers(len(_CHANGES))]
    return change(video, rng)


def _blended(video: Video, plain: Tensor, rng: np.random.Generator) -> Video:
    """Nearer to what it is blended with, or farther away."""
    return plain + (1 + rng.uniform(-_STRENGTH, _STRENGTH)) * (video - plain)


def _grey(video: Video) -> Float[Tensor, "T 1 h w"]:
    return (video * video.new_tensor(_GREY)[:, None, None]).sum(dim=1, keepdim=True)


def _colour(video: Video, rng: np.random.Generator) -> Video:
    return _blended(video, _grey(video), rng)


def _contrast(video: Video, rng: np.random.Generator) -> Video:
    return _blended(video, _grey(video).mean(), rng)


def _brightness(video: Video, rng: np.random.Generator) -> Video:
    return _blended(video, video.new_zeros(()), rng)


def _sharpness(video: Video, rng: np.random.Generator) -> Video:
    kernel = video.new_tensor([[1, 1, 1], [1, 5, 1], [1, 1, 1]]) / 13
    padded = functional.pad(video, (1, 1, 1, 1), mode="replicate")
    return _blended(video, functional.conv2d(padded, kernel.expand(3, 1, 3, 3), groups=3), rng)


def _autocontrast(video: Video, rng: np.random.Generator) -> Video:
    """Each colour stretched so that it spans everything from 0 to 1."""
    low, high = video.amin(dim=(0, 2, 3), keepdim=True), video.amax(dim=(0, 2, 3), keepdim=True)
    return torch.where(high > low, (video - low) / (high - low).clamp(min=1e-6), video)


def _posterised(video: Video, rng: np.random.Generator) -> Video:
    levels = 2 ** int(rng.integers(*_BITS)) - 1
    return (video * levels).round() / levels


_CHANGES: tuple[Callable[[Video, np.random.Generator], Video], ...] = (
    _colour,
    _contrast,
    _brightness,
    _sharpness,
    _autocontrast,
    _posterised,
)
