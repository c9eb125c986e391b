"""FitVid: variational video prediction that is conditioned on actions (Babaeizadeh et al., 2021, arXiv 2106.13195).

A frame x_t becomes a vector h_t and feature maps in the encoder. From there on everything is recurrent over vectors:

    posterior   q(z_t | x_1..t)     from h_t
    prior       p(z_t | x_c)        from h_c
    next frame  d_t = LSTM(h_c, a_t-1, f(p_t), z_t),    x'_t = decoder(d_t, f(p_t) - f(p_c), c)

with the last context frame c and its feature maps, and the places of the pusher p_t as sines and cosines f. What is
minimised is sum_t |x_t - x'_t|^2 (a mean over pixels) + beta * KL(q || p), with z_t from the posterior; to predict, z_t
comes from the prior.

The deviations from the published program are what lets so small a network, trained for so short a time, follow actions
at all:

- Channels start with 4 at full size, where the original has 64, and double per stage; there are as many stages as
  leave 8 x 8 pixels to the coarsest maps, whatever the images' size.
- It is told where the pusher is, as all other methods here are; the original sees it in images alone.
- Behind the context the recurrence sees neither true nor predicted frames, where the original's sees the one before. So
  what it is trained for is what it does when it predicts.
- The recurrence tells the decoder what has changed since the last context frame, in batch norm, where the original's
  tells all of the next frame's vector; the decoder changes that frame, where the original's draws a new one. A pusher
  is a few pixels of a scene: in a vector of everything it is lost beside what stands still.
- A frame's vector is a linear function of its whole coarsest map, not of the map's mean, and is brought to unit
  variance.
- Batch norm takes its statistics over all steps of a batch at once, not step by step. The frame predictor has no
  variance, which the original computes and never uses. Encoder and decoder may compute in bfloat16. The skip
  connections come from the last context frame, in the original from the first one. Actions are in units of the highest
  speed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from osfcore.dynamics.rollout import pusher_centres
from osfcore.errors import CorruptFile, InvalidInput, check_ranges, shown
from osfcore.experiments.rivals import repository_weights
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, PUSHER_REACH_M, STEP_S
from osfcore.io.checkpoint import read_parameters
from osfcore.io.files import write_atomically

# Residual cells of NVAE (Vahdat and Kautz, 2020) as FitVid uses them, and squeeze-and-excitation in them.


EXPANSION = 4  # of the channels within a decoder's cell
_MOMENTUM, _EPSILON = 0.1, 1e-5
_SQUEEZE, _LEAST_SQUEEZED = 16, 4


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_EPSILON, momentum=_MOMENTUM)


def _conv(before: int, after: int, side: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(before, after, side, stride, padding=side // 2, bias=False)


class SqueezeExcitation(nn.Module):
    """Channels scaled by what all of them are on average (Hu et al., 2018).

        y = x * sigmoid(E relu(R mean(x)))

    Args:
        channels: of x; a sixteenth of them, four at least, are in the middle.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        squeezed = max(channels // _SQUEEZE, _LEAST_SQUEEZED)
        self.reduce, self.expand = nn.Linear(channels, squeezed), nn.Linear(squeezed, channels)

    def forward(self, x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B c h w"]:
        """Return x with its channels scaled."""
        scale = self.expand(functional.relu(self.reduce(x.mean(dim=(2, 3))))).sigmoid()
        return x * scale[:, :, None, None]


class EncoderCell(nn.Module):
    """Two 3 x 3 convolutions, each behind batch norm and swish, and squeeze-and-excitation beside a shortcut.

    Args:
        before: channels.
        after: channels.
        stride: 2 to halve height and width.
    """

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__()
        self.first, self.second = _conv(before, after, 3, stride), _conv(after, after, 3)
        self.norms = nn.ModuleList([_norm(before), _norm(after)])
        self.excitation = SqueezeExcitation(after)
        same = before == after and stride == 1
        self.shortcut = nn.Identity() if same else nn.Sequential(_conv(before, after, 1, stride), _norm(after))

    def forward(self, x: Float[Tensor, "B before h w"]) -> Float[Tensor, "B after h2 w2"]:
        """Return features of the same or half the height and width."""
        y = self.first(functional.silu(self.norms[0](x)))
        y = self.second(functional.silu(self.norms[1](y)))
        return functional.silu(self.shortcut(x) + self.excitation(y))


class DecoderCell(nn.Module):
    """An inverted bottleneck: 1 x 1 to four times the channels, 5 x 5 among them, 1 x 1 back, beside a shortcut.

    The last batch norm begins with scale 0, so that the cell begins as its shortcut.

    Args:
        before: channels.
        after: channels.
        grows: whether height and width are doubled first, by repetition.
    """

    def __init__(self, before: int, after: int, *, grows: bool = False) -> None:
        super().__init__()
        inner = EXPANSION * after
        self.grows = grows
        self.widen, self.mix, self.narrow = _conv(before, inner, 1), _conv(inner, inner, 5), _conv(inner, after, 1)
        self.norms = nn.ModuleList([_norm(before), _norm(inner), _norm(inner), _norm(after)])
        nn.init.zeros_(self.norms[-1].get_parameter("weight"))
        self.excitation = SqueezeExcitation(after)
        same = before == after
        self.shortcut = nn.Identity() if same else nn.Sequential(_conv(before, after, 1), _norm(after))

    def forward(self, x: Float[Tensor, "B before h w"]) -> Float[Tensor, "B after h2 w2"]:
        """Return features of the same or twice the height and width."""
        if self.grows:
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
        y = self.widen(self.norms[0](x))
        y = self.mix(functional.silu(self.norms[1](y)))
        y = self.norms[3](self.narrow(functional.silu(self.norms[2](y))))
        return functional.silu(self.shortcut(x) + self.excitation(y))


# FitVid's recurrent parts: Gaussians over the latent, step by step, and the vector of the next frame.


class Gaussian(NamedTuple):
    """A normal distribution with a diagonal covariance.

    Attributes:
        mean: of each component.
        logvar: logarithm of the variance.
    """

    mean: Float[Tensor, "*batch z"]
    logvar: Float[Tensor, "*batch z"]

    def sample(self, generator: torch.Generator | None) -> Float[Tensor, "*batch z"]:
        """Draw from the distribution; gradients pass through.

        Args:
            generator: draws it, on the device of the mean.
        """
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.mean + (self.logvar / 2).exp() * noise


def kl_divergence(p: Gaussian, q: Gaussian) -> Float[Tensor, "*batch"]:
    """Return KL(p || q) in closed form, summed over the components.

        sum_i (ln s_q^2 - ln s_p^2 + (s_p^2 + (m_p - m_q)^2) / s_q^2 - 1) / 2

    Args:
        p: such as the posterior.
        q: such as the prior.
    """
    ratio = (p.logvar - q.logvar).exp()
    far = (p.mean - q.mean).square() * (-q.logvar).exp()
    return (q.logvar - p.logvar + ratio + far - 1).sum(dim=-1) / 2


class Recurrence(nn.Module):
    """A linear embedding and layers of LSTM.

    Args:
        inputs: numbers taken in at each step.
        hidden: units of embedding and layers.
        layers: of LSTM.
    """

    def __init__(self, inputs: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.embedding, self.lstm = nn.Linear(inputs, hidden), nn.LSTM(hidden, hidden, layers, batch_first=True)

    def forward(self, x: Float[Tensor, "B T inputs"]) -> Float[Tensor, "B T hidden"]:
        """Return outputs of the last layer; the state begins with zeros."""
        return self.lstm(self.embedding(x))[0]


class LatentLSTM(nn.Module):
    """The posterior or the learned prior: a Gaussian over the latent at each step, given all vectors so far.

    Args:
        inputs: length of the vectors.
        hidden: units.
        latent: components of the latent (z).
    """

    def __init__(self, inputs: int, hidden: int, latent: int) -> None:
        super().__init__()
        self.recurrence = Recurrence(inputs, hidden, 1)
        self.mean, self.logvar = nn.Linear(hidden, latent), nn.Linear(hidden, latent)

    def forward(self, x: Float[Tensor, "B T inputs"]) -> Gaussian:
        """Return Gaussians (B, T, z)."""
        y = self.recurrence(x)
        return Gaussian(self.mean(y), self.logvar(y))


class FrameLSTM(nn.Module):
    """What changes until the next frame; nothing at the beginning of training.

    Args:
        inputs: length of all that is given.
        hidden: units of each of both layers.
        features: length of the vector (g).
    """

    def __init__(self, inputs: int, hidden: int, features: int) -> None:
        super().__init__()
        self.recurrence, self.head = Recurrence(inputs, hidden, 2), nn.Linear(hidden, features)

    def forward(self, x: Float[Tensor, "B T inputs"]) -> Float[Tensor, "B T g"]:
        """Return changes."""
        return self.head(self.recurrence(x))


# FitVid's encoder of a frame, and the decoder that mirrors it and takes its features over skip connections.
#
# Deviation: the decoder's last layer, which begins at zero, changes the logits of a known frame, where the
# original's makes all of a frame. A network begins at copying that way, and what it learns are the changes; 50
# minutes on one core did not teach ours to draw the standing background anew as well as a copied frame shows it.


COARSEST_SIDE = 8  # of the feature maps between encoder and decoder, as in the original [px]
_CELLS = 2  # of a stage
_LEAST = 1 / 256  # of a colour whose logit is taken

_WAVES = (1, 2, 4, 8)  # half periods of the sines and cosines over the pusher's reach
PLACE_FEATURES = 2 + 4 * len(_WAVES)


def place_features(pushers: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch f"]:
    """Return places of the pusher [m] as numbers, sines and cosines (Tancik et al., 2020)."""
    x = pushers / PUSHER_REACH_M
    return torch.cat([x, *(wave(torch.pi * n * x) for n in _WAVES for wave in (torch.sin, torch.cos))], dim=-1)


Skips = Sequence[Float[Tensor, "_ _ _ _"]]  # features after each of the encoder's cells, the finest first


class Encoder(nn.Module):
    """A frame as a vector: stages of two cells, all but the first beginning by halving the image, then a linear layer.

    The vector is brought to mean 0 and variance 1 (Ba et al., 2016).

    Args:
        stages: their number; channels double from one to the next.
        width: channels of the first stage.
        features: length of the vector (g).
    """

    def __init__(self, stages: int, width: int, features: int) -> None:
        super().__init__()
        cells, before = [], 3
        for stage in range(stages):
            for cell in range(_CELLS):
                after = width * 2**stage
                cells.append(EncoderCell(before, after, 2 if stage > 0 and cell == 0 else 1))
                before = after
        self.cells = nn.ModuleList(cells)
        self.head, self.norm = nn.Linear(before * COARSEST_SIDE**2, features), nn.LayerNorm(features)

    def forward(self, frames: Float[Tensor, "B 3 h w"]) -> tuple[Float[Tensor, "B g"], list[Float[Tensor, "B _ _ _"]]]:
        """Return the vector of each frame, and the features after each cell."""
        # With colours last in memory, 1 x 1 convolutions of few channels at stride 2 crash PyTorch 2.13.
        skips, x = [], frames.contiguous()
        for cell in self.cells:
            x = cell(x)
            skips.append(x)
        return self.norm(self.head(x.flatten(1))), skips


class Decoder(nn.Module):
    """A change as a frame: a linear layer to the coarsest map, the encoder's stages backwards, a 3 x 3 convolution.

    After each cell the features of the encoder's cell across from it are added.

    Args:
        stages: of the encoder.
        width: channels of its first stage.
        features: length of the vector (g).
    """

    def __init__(self, stages: int, width: int, features: int) -> None:
        super().__init__()
        self._channels = before = width * 2 ** (stages - 1)
        self.ground = nn.Linear(features + PLACE_FEATURES, before * COARSEST_SIDE**2)
        self.norm = nn.BatchNorm1d(before * COARSEST_SIDE**2)
        cells = []
        for stage in reversed(range(stages)):
            for cell in range(_CELLS):
                after = width * 2**stage
                cells.append(DecoderCell(before, after, grows=stage < stages - 1 and cell == 0))
                before = after
        self.cells = nn.ModuleList(cells)
        self.colours = nn.Conv2d(before, 3, 3, padding=1, bias=False)

    def forward(
        self, changes: Float[Tensor, "B changed"], skips: Skips, known: Float[Tensor, "_ 3 h w"]
    ) -> Float[Tensor, "B 3 h w"]:
        """Return frames in [0, 1].

        Args:
            changes: of vector and place of the pusher since the known frame.
            skips: of the encoder, for each of the changes or of one frame for all of them.
            known: the frames of which those are.
        """
        x = self.norm(self.ground(changes)).view(len(changes), self._channels, COARSEST_SIDE, COARSEST_SIDE)
        for cell, skip in zip(self.cells, reversed(skips), strict=True):
            x = cell(x) + skip
        return (torch.logit(known, _LEAST) + self.colours(x).float()).sigmoid()


CONTEXT = 2  # frames that are given
_ACTION = 3
_MOST_STAGES = 8
_AT_ONCE = 32  # sequences: more would take memory and no less time


@dataclass(frozen=True, slots=True)
class FitVidSettings:
    """Sizes of a network.

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
        settings: its sizes.
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
        self.frame_predictor = FrameLSTM(s.features + _ACTION + PLACE_FEATURES + s.latent, s.hidden, s.features)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):  # as the original begins (LeCun)
                nn.init.normal_(module.weight, std=module.weight[0].numel() ** -0.5)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        nn.init.zeros_(self.decoder.colours.weight)
        nn.init.zeros_(self.frame_predictor.head.weight)

    @property
    def parameter_count(self) -> int:
        """Numbers that are learned."""
        return sum(parameter.numel() for parameter in self.parameters())

    def _encoded(self, frames: Float[Tensor, "B 3 h w"]) -> tuple[Float[Tensor, "B g"], list[Tensor]]:
        with torch.autocast(frames.device.type, self.precision, enabled=self.precision != torch.float32):
            vectors, skips = self.encoder(frames)
        return vectors.float(), skips

    def _decoded(self, changes: Float[Tensor, "B changed"], skips: Skips, known: Tensor) -> Float[Tensor, "B 3 h w"]:
        with torch.autocast(changes.device.type, self.precision, enabled=self.precision != torch.float32):
            return self.decoder(changes, skips, known)

    def _changes(self, vectors: Tensor, actions: Tensor, places: Tensor, latents: Tensor) -> Float[Tensor, "B T g"]:
        """Return what changes; places are those after the actions."""
        return self.frame_predictor(torch.cat([vectors, actions / MAX_SPEED_M_S, places, latents], dim=-1))

    def losses(
        self,
        frames: Float[Tensor, "B T1 3 side side"],
        actions: Float[Tensor, "B T 3"],
        pushers: Float[Tensor, "B T1 2"],
        generator: torch.Generator | None,
        decoded: Sequence[int] | None = None,
    ) -> Losses:
        """Return the losses of predicting each frame but the first from the context, of which there is one at first.

        Args:
            frames: in [0, 1], three at least.
            actions: between them [m/s].
            pushers: places of the pusher in them [m].
            generator: draws the latents.
            decoded: those of the T steps whose images count, in place of all; each then counts T / len(decoded) times.
        """
        count, length = frames.shape[:2]
        steps = list(range(length - 1) if decoded is None else decoded)
        known = [min(step, CONTEXT - 1) for step in range(length - 1)]  # last frame of the context, at each step
        vectors, skips = self._encoded(frames.flatten(0, 1))
        vectors, places = vectors.unflatten(0, (count, length)), place_features(pushers)
        posterior, prior = self.posterior(vectors[:, 1:]), self.prior(vectors[:, known])
        changes = self._changes(vectors[:, known], actions, places[:, 1:], posterior.sample(generator))
        moved = places[:, 1:] - places[:, known]
        last = [known[step] for step in steps]
        skips = [skip.unflatten(0, (count, length))[:, last].flatten(0, 1) for skip in skips]
        told = torch.cat([changes, moved], dim=-1)[:, steps].flatten(0, 1)
        images = self._decoded(told, skips, frames[:, last].flatten(0, 1)).unflatten(0, (count, len(steps)))
        true = frames[:, [step + 1 for step in steps]]
        squared_error = (images - true).square().mean() * (length - 1)
        return Losses(squared_error, kl_divergence(posterior, prior).sum(dim=1).mean())

    def rollout(
        self,
        context: Float[Tensor, "B 2 3 side side"],
        actions: Float[Tensor, "B T1 3"],
        pushers: Float[Tensor, "B T2 2"],
    ) -> Iterator[Tensor]:
        """Yield the frames (B, 3, side, side) after the context, one after the other; latents are the prior's means.

        Args:
            context: true frames in [0, 1].
            actions: the first one between the context's frames, then one for each frame that is predicted [m/s].
            pushers: places of the pusher in the context and in each frame that is predicted [m].
        """
        vectors, skips = self._context(context)
        yield from self._continued(vectors, skips, context[:, -1], actions, pushers)

    @torch.inference_mode()
    def _context(self, context: Float[Tensor, "B 2 3 side side"]) -> tuple[Float[Tensor, "B 2 g"], list[Tensor]]:
        """Return vectors of the context's frames, and the feature maps of the last ones."""
        vectors, skips = self._encoded(context.flatten(0, 1))
        return vectors.unflatten(0, (-1, CONTEXT)), [skip[CONTEXT - 1 :: CONTEXT] for skip in skips]

    def _continued(
        self,
        vectors: Float[Tensor, "B 2 g"],
        skips: list[Tensor],
        known: Float[Tensor, "_ 3 side side"],
        actions: Float[Tensor, "B T1 3"],
        pushers: Float[Tensor, "B T2 2"],
    ) -> Iterator[Tensor]:
        with torch.inference_mode():
            places, length = place_features(pushers), actions.shape[1]
            given = vectors[:, [min(step, CONTEXT - 1) for step in range(length)]]
            changes = self._changes(given, actions, places[:, 1:], self.prior(given).mean)
            told = torch.cat([changes, places[:, 1:] - places[:, [CONTEXT - 1]]], dim=-1)
        for step in range(CONTEXT - 1, length):
            with torch.inference_mode():
                frame = self._decoded(told[:, step], skips, known)
            yield frame

    def predict(
        self,
        context_frames: Float[np.ndarray, "2 h w 3"],
        actions: Float[np.ndarray, "K T 3"],
        pusher: Float[np.ndarray, "3"],
        *,
        between: Float[np.ndarray, "3"] | None = None,
    ) -> Float32[np.ndarray, "K T h w 3"]:
        """Predict what will be seen after each action of each sequence.

        Args:
            context_frames: what was seen one action ago, and now, in [0, 1].
            actions: sequences [m/s].
            pusher: its centre now [m]; it goes where actions take it.
            between: the action between the context's frames [m/s]; standing still if None.

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
        path = pusher_centres(pusher[:2], actions, PUSHER_CENTRE_Z_M)[..., :2]
        before = np.broadcast_to(pusher[:2] - STEP_S * first[:2], (len(actions), 1, 2))
        places = np.concatenate([before, path], axis=1)
        given, told = (torch.as_tensor(one, dtype=torch.float32, device=device) for one in (all_actions, places))
        vectors, skips = self._context(context[None])  # once for all sequences
        parts = []
        for part, where in zip(given.split(_AT_ONCE), told.split(_AT_ONCE), strict=True):
            futures = self._continued(vectors.expand(len(part), -1, -1), skips, context[None, -1], part, where)
            parts.append(torch.stack(list(futures), dim=1))
        return torch.cat(parts).movedim(2, -1).contiguous().cpu().numpy()


# Files of trained FitVid networks: safetensors with half-precision parameters, checked when read.


FORMAT = "fitvid-3"
_FILE = "fitvid.safetensors"


def fitvid_path(data_dir: Path | None) -> Path:
    """Return the file of the network: DATA_DIR/fitvid.safetensors if it is there, else the repository's.

    Raises:
        OsfError: if neither is there.
    """
    own = None if data_dir is None else data_dir / _FILE
    return own if own is not None and own.is_file() else repository_weights(_FILE, f"DATA_DIR/{_FILE}")


def write_fitvid(path: Path, model: FitVidModel) -> None:
    """Write a network; the statistics of batch norm keep their precision. The file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    halved = {name for name, _ in model.named_parameters()}
    tensors = {
        name: (value.detach().half() if name in halved else value.detach()).cpu().contiguous()
        for name, value in model.state_dict().items()
    }
    sizes = {name: str(int(value)) for name, value in asdict(model.settings).items()}
    write_atomically(path, save(tensors, {"format": FORMAT, **sizes}))


def read_fitvid(path: Path, precision: torch.dtype = torch.float32) -> FitVidModel:
    """Read a network, ready to predict.

    Args:
        path: of the file.
        precision: of its computations.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or no such network.
    """
    metadata, values = read_parameters(path, FORMAT, "video prediction network")
    try:
        settings = FitVidSettings(**{size.name: int(metadata[size.name]) for size in fields(FitVidSettings)})
    except (KeyError, ValueError) as error:
        raise CorruptFile(path, f"it holds no video prediction network of known size ({shown(error)})") from error
    with torch.device("meta"):  # what the file describes may be larger than what it holds
        model = FitVidModel(settings, precision)
    expected = model.state_dict()
    if {n: v.shape for n, v in values.items()} != {n: v.shape for n, v in expected.items()}:
        raise CorruptFile(path, "its parameters do not fit its description")
    model.load_state_dict({name: value.to(expected[name].dtype) for name, value in values.items()}, assign=True)
    return model.eval()
