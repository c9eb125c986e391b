"""FitVid: variational video prediction that is conditioned on actions (Babaeizadeh et al., 2021, arXiv 2106.13195).

A frame x_t becomes a vector h_t and feature maps in the encoder. From there on everything is recurrent over vectors:

    posterior   q(z_t | x_1..t)     from h_t
    prior       p(z_t | x_1..t-1)   from h_t-1
    next frame  h'_t = sigmoid(LSTM(h_t-1, a_t-1, z_t)),    x'_t = decoder(h'_t, c, feature maps of c)

with the last context frame c, and what is minimised is sum_t |x_t - x'_t|^2 (a mean over pixels) + beta * KL(q || p),
with z_t from the posterior and true frames behind h_t-1. To predict, z_t comes from the prior, and behind the context
h_t-1 from the predicted frame.

Deviations from the published program: images are of 128 pixels instead of 64, as in the paper that is reproduced here,
by one more stage in front, so that the coarsest maps stay 8 x 8 pixels; channels start with 4 at full size and double
per stage, so that at 64 pixels there are 8 where the original has 64 (7.4 instead of 302 million parameters). Batch
norm takes its statistics over all steps of a batch at once, not step by step. The frame predictor has no variance,
which the original computes and never uses. The decoder changes the last context frame, where the original's draws a
new one (`coders`). Encoder and decoder may compute in bfloat16. Predictions take the skip connections from the last
context frame, as training does; the original takes those of the first one there. Actions are in units of the highest
speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from osfcore.errors import InvalidInput, check_ranges
from osfcore.experiments.rivals.fitvid.coders import COARSEST_SIDE, Decoder, Encoder, Skips
from osfcore.experiments.rivals.fitvid.recurrence import FrameLSTM, LatentLSTM, kl_divergence
from osfcore.geometry.workspace import MAX_SPEED_M_S

CONTEXT = 2  # frames that are given
_ACTION = 3
_MOST_STAGES = 8
_AT_ONCE = 32  # sequences: more would take memory and no less time


@dataclass(frozen=True, slots=True)
class FitVidSettings:
    """How large a network is.

    Attributes:
        side: of its square images [px]: 8 times a power of two.
        width: channels at full size; they double whenever the image is halved (original: 64 for 64 pixels).
        features: length of a frame's vector (g).
        hidden: units of the LSTMs.
        latent: components of z.
    """

    side: int = 128
    width: int = 4
    features: int = 128
    hidden: int = 256
    latent: int = 10

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        if self.side not in [COARSEST_SIDE * 2**n for n in range(1, _MOST_STAGES)]:
            raise InvalidInput("side of the frames [px]", self.side, "16, 32, 64, 128, 256, 512 or 1024")
        check_ranges(
            ("width of the network", self.width, 1, 256),
            ("features of a frame", self.features, 1, 4096),
            ("units of the LSTMs", self.hidden, 1, 4096),
            ("components of the latent", self.latent, 1, 1024),
        )

    @property
    def stages(self) -> int:
        """Sizes of image between full size and 8 pixels, both included."""
        return (self.side // COARSEST_SIDE).bit_length()


class Losses(NamedTuple):
    """What is minimised: squared_error + beta * kl.

    Attributes:
        squared_error: mean over pixels and sequences, summed over the predicted frames.
        kl: of posterior and prior, likewise summed; mean over sequences [nat].
    """

    squared_error: Float[Tensor, ""]
    kl: Float[Tensor, ""]


class FitVidModel(nn.Module):
    """The network.

    Attributes:
        settings: how large it is.
        precision: what encoder and decoder compute in; parameters and frames are float32 in any case.
    """

    def __init__(self, settings: FitVidSettings | None = None, precision: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.settings = s = settings or FitVidSettings()
        self.precision = precision
        self.encoder = Encoder(s.stages, s.width, s.features)
        self.decoder = Decoder(s.stages, s.width, s.features)
        self.posterior = LatentLSTM(s.features, s.hidden, s.latent)
        self.prior = LatentLSTM(s.features, s.hidden, s.latent)
        self.frame_predictor = FrameLSTM(s.features + _ACTION + s.latent, s.hidden, s.features)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):  # as the original begins (LeCun)
                nn.init.normal_(module.weight, std=module.weight[0].numel() ** -0.5)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        nn.init.zeros_(self.decoder.colours.weight)

    @property
    def parameter_count(self) -> int:
        """Numbers that are learned."""
        return sum(parameter.numel() for parameter in self.parameters())

    def _encoded(self, frames: Float[Tensor, "B 3 h w"]) -> tuple[Float[Tensor, "B g"], list[Tensor]]:
        with torch.autocast(frames.device.type, self.precision, enabled=self.precision != torch.float32):
            vectors, skips = self.encoder(frames)
        return vectors.float(), skips

    def _decoded(self, vectors: Float[Tensor, "B g"], skips: Skips, known: Tensor) -> Float[Tensor, "B 3 h w"]:
        with torch.autocast(vectors.device.type, self.precision, enabled=self.precision != torch.float32):
            return self.decoder(vectors, skips, known)

    def losses(
        self,
        frames: Float[Tensor, "B T1 3 side side"],
        actions: Float[Tensor, "B T 3"],
        generator: torch.Generator | None,
    ) -> Losses:
        """How well each frame but the first is predicted from the true ones before it.

        Args:
            frames: in [0, 1], three at least.
            actions: between them [m/s].
            generator: draws the latents.
        """
        count, length = frames.shape[:2]
        vectors, skips = self._encoded(frames.flatten(0, 1))
        vectors = vectors.unflatten(0, (count, length))
        posterior, _ = self.posterior(vectors[:, 1:])
        prior, _ = self.prior(vectors[:, :-1])
        inputs = [vectors[:, :-1], actions / MAX_SPEED_M_S, posterior.sample(generator)]
        following, _ = self.frame_predictor(torch.cat(inputs, dim=-1))
        seen = [min(step, CONTEXT - 1) for step in range(length - 1)]  # frames whose maps are handed over
        skips = [skip.unflatten(0, (count, length))[:, seen].flatten(0, 1) for skip in skips]
        predicted = self._decoded(following.flatten(0, 1), skips, frames[:, seen].flatten(0, 1))
        predicted = predicted.unflatten(0, (count, length - 1))
        squared_error = (predicted - frames[:, 1:]).square().mean(dim=(0, 2, 3, 4)).sum()
        return Losses(squared_error, kl_divergence(posterior, prior).sum(dim=1).mean())

    def rollout(
        self,
        context: Float[Tensor, "B 2 3 side side"],
        actions: Float[Tensor, "B T1 3"],
        generator: torch.Generator | None = None,
    ) -> Iterator[Tensor]:
        """The frames (B, 3, side, side) after the context, one after the other.

        Args:
            context: true frames in [0, 1].
            actions: the first one between the context's frames, then one for each frame that is predicted [m/s].
            generator: draws latents from the prior; its mean is taken if None.
        """
        vectors, skips = self._context(context)
        yield from self._continued(vectors, skips, context[:, -1], actions, generator)

    @torch.inference_mode()
    def _context(self, context: Float[Tensor, "B 2 3 side side"]) -> tuple[Float[Tensor, "B 2 g"], list[Tensor]]:
        """Vectors of the context's frames, and the feature maps of the last ones."""
        vectors, skips = self._encoded(context.flatten(0, 1))
        return vectors.unflatten(0, (-1, CONTEXT)), [skip[CONTEXT - 1 :: CONTEXT] for skip in skips]

    def _continued(
        self,
        vectors: Float[Tensor, "B 2 g"],
        skips: list[Tensor],
        known: Float[Tensor, "_ 3 side side"],
        actions: Float[Tensor, "B T1 3"],
        generator: torch.Generator | None,
    ) -> Iterator[Tensor]:
        prior_state = frame_state = frame = None
        for step in range(actions.shape[1]):
            with torch.inference_mode():
                vector = vectors[:, step] if frame is None else self._encoded(frame)[0]
                prior, prior_state = self.prior(vector[:, None], prior_state)
                latent = prior.mean if generator is None else prior.sample(generator)
                inputs = [vector[:, None], actions[:, step : step + 1] / MAX_SPEED_M_S, latent]
                following, frame_state = self.frame_predictor(torch.cat(inputs, dim=-1), frame_state)
                frame = self._decoded(following[:, 0], skips, known) if step + 1 >= CONTEXT else None
            if frame is not None:
                yield frame

    def predict(
        self,
        context_frames: Float[np.ndarray, "2 h w 3"],
        actions: Float[np.ndarray, "K T 3"],
        *,
        between: Float[np.ndarray, "3"] | None = None,
        generator: torch.Generator | None = None,
    ) -> Float32[np.ndarray, "K T h w 3"]:
        """What will be seen after each action of each sequence.

        Args:
            context_frames: what was seen one action ago, and now, in [0, 1].
            actions: sequences [m/s].
            between: the action between the context's frames [m/s]; standing still if None.
            generator: draws a latent for each sequence and step, on this network's device; the prior's means are taken
                if None, so that the same is predicted each time.

        Raises:
            InvalidInput: if the frames are of another size than the network's.
        """
        side = self.settings.side
        if context_frames.shape != (CONTEXT, side, side, 3):
            raise InvalidInput("shape of the context frames", context_frames.shape, f"{(CONTEXT, side, side, 3)}")
        device = next(self.parameters()).device
        context = torch.as_tensor(context_frames, dtype=torch.float32, device=device).permute(0, 3, 1, 2)
        first = np.zeros(_ACTION) if between is None else between
        all_actions = np.concatenate([np.broadcast_to(first, (len(actions), 1, _ACTION)), actions], axis=1)
        given = torch.as_tensor(all_actions, dtype=torch.float32, device=device)
        vectors, skips = self._context(context[None])  # once for all sequences
        parts = []
        for part in given.split(_AT_ONCE):
            futures = self._continued(vectors.expand(len(part), -1, -1), skips, context[None, -1], part, generator)
            parts.append(torch.stack(list(futures), dim=1))
        return torch.cat(parts).movedim(2, -1).contiguous().cpu().numpy()
