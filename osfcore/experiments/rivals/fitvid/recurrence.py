"""FitVid's recurrent parts: Gaussians over the latent, step by step, and the vector of the next frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

State = tuple[Float[Tensor, "layers B hidden"], Float[Tensor, "layers B hidden"]]


class Gaussian(NamedTuple):
    """A normal distribution with a diagonal covariance.

    Attributes:
        mean: of each component.
        logvar: logarithm of the variance.
    """

    mean: Float[Tensor, "*batch z"]
    logvar: Float[Tensor, "*batch z"]

    def sample(self, generator: torch.Generator | None) -> Float[Tensor, "*batch z"]:
        """A draw that gradients pass through.

        Args:
            generator: draws it, on the device of the mean.
        """
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.mean + (self.logvar / 2).exp() * noise


def kl_divergence(p: Gaussian, q: Gaussian) -> Float[Tensor, "*batch"]:
    """KL(p || q) in closed form, summed over the components.

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

    def forward(
        self, x: Float[Tensor, "B T inputs"], state: State | None = None
    ) -> tuple[Float[Tensor, "B T hidden"], State]:
        """Outputs of the last layer, and the state after the last step; without a state it begins with zeros."""
        return self.lstm(self.embedding(x), state)


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

    def forward(self, x: Float[Tensor, "B T inputs"], state: State | None = None) -> tuple[Gaussian, State]:
        """Gaussians (B, T, z), and the state to go on from."""
        y, after = self.recurrence(x, state)
        return Gaussian(self.mean(y), self.logvar(y)), after


class FrameLSTM(nn.Module):
    """The vector of the next frame from that of this one, the action and the latent.

    Args:
        inputs: length of all three together.
        hidden: units of each of both layers.
        features: length of the vector (g).
    """

    def __init__(self, inputs: int, hidden: int, features: int) -> None:
        super().__init__()
        self.recurrence, self.head = Recurrence(inputs, hidden, 2), nn.Linear(hidden, features)

    def forward(
        self, x: Float[Tensor, "B T inputs"], state: State | None = None
    ) -> tuple[Float[Tensor, "B T g"], State]:
        """Vectors in (0, 1), and the state to go on from."""
        y, after = self.recurrence(x, state)
        return self.head(y).sigmoid(), after
