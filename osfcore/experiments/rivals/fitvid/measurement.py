"""How well held-out videos are predicted, step by step, against the last context frame, copied."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.experiments.rivals.fitvid.frame_windows import Video, windows
from osfcore.experiments.rivals.fitvid.model import CONTEXT, FitVidModel
from osfcore.metrics.image_errors import MOST_DB

HORIZONS = (10, 30)  # predicted steps
_AT_ONCE = 8  # videos


@dataclass(frozen=True, eq=False, slots=True)
class VideoErrors:
    """Errors of N videos at T predicted steps.

    Attributes:
        predicted: mean squared error over the pixels of each frame.
        copied: the same if nothing ever changed after the context.
    """

    predicted: Float[np.ndarray, "N T"]
    copied: Float[np.ndarray, "N T"]

    def report(self) -> dict[str, Any]:
        """Means over each horizon that the videos are long enough for, and by step, as plain JSON."""
        steps = self.predicted.shape[1]
        shown = [horizon for horizon in HORIZONS if horizon <= steps] or [steps]
        return {
            "videos": len(self.predicted),
            "horizons": {str(horizon): self._means(slice(horizon)) for horizon in shown},
            "steps": [self._means(slice(step, step + 1)) for step in range(steps)],
        }

    def _means(self, steps: slice) -> dict[str, float]:
        """Means of errors, and of each frame's own PSNR [dB]."""
        report = {}
        for name, errors in (("", self.predicted[:, steps]), ("_copied", self.copied[:, steps])):
            psnr = np.minimum(-10 * np.log10(np.maximum(errors, 1e-12)), MOST_DB)
            report |= {f"mse{name}": round(float(errors.mean()), 7), f"psnr{name}": round(float(psnr.mean()), 3)}
        return report


def measure(model: FitVidModel, videos: Sequence[Video]) -> Iterator[VideoErrors]:
    """Predict the beginnings of videos with the prior's means; yields what there is after each few of them.

    Args:
        model: in evaluation mode.
        videos: as far as the longest horizon, or as the shortest of them goes.

    Raises:
        CorruptFile: if one cannot be read.
    """
    steps = min(*(video.steps for video in videos), CONTEXT - 1 + max(HORIZONS))
    device = next(model.parameters()).device
    predicted, copied = [], []
    for first in range(0, len(videos), _AT_ONCE):
        some = videos[first : first + _AT_ONCE]
        read = windows(some, np.zeros(len(some), int), steps)
        frames = as_frames(read.frames, device)
        futures = model.rollout(frames[:, :CONTEXT], torch.as_tensor(read.actions, device=device))
        last, truths = frames[:, CONTEXT - 1], frames[:, CONTEXT:].unbind(dim=1)
        errors = [(_error(future, truth), _error(last, truth)) for future, truth in zip(futures, truths, strict=True)]
        predicted.append(np.stack([ours for ours, _ in errors], axis=1))
        copied.append(np.stack([theirs for _, theirs in errors], axis=1))
        yield VideoErrors(np.concatenate(predicted), np.concatenate(copied))


def as_frames(frames: np.ndarray, device: torch.device) -> Float[Tensor, "B T 3 h w"]:
    """Recorded 8-bit frames (B, T, h, w, 3) as the network takes them."""
    return torch.as_tensor(frames, device=device).movedim(-1, 2).float() / 255


def _error(images: Tensor, truth: Tensor) -> Float[np.ndarray, "B"]:
    return (images - truth).square().mean(dim=(1, 2, 3)).cpu().numpy().astype(float)
