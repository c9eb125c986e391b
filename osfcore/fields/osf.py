"""OSF: one object's relightable scattering function as one large network, the paper's own form (section 4.1).

f(x, light direction, view direction) -> (rho, sigma), eq. 1, is a multilayer perceptron over positional encodings, as
in NeRF. A trunk with one skip connection computes density and albedo from the position. One more layer of half its
width, which also reads the light and the view, computes the scattered light:

    sigma = DENSITY_GAIN * softplus(s) / half of the box's longest side         [1 / unit of length]
    rho   = albedo * (ambient + softplus(gain))

It serves as a teacher (`train_kiloosf.Distillation`) and for comparison; the shipped fields are KiloOSFs. Deviations
from the paper:

- rho has an ambient part that depends on neither light nor view. The lamp comes with ambient light that no shadow
  removes, and every image shows one light only, from which a free split could not be learned.
- The sigmoid of the published code is on the albedo alone, so that a well-lit point may send out more than its albedo.
- The integral of eq. 2 over light directions is one term, since the light is distant.
- Lights and views have unit length in training and in use. The published code mixes unit lights and lights of length
  15.
- Positions are divided by the object's box, not by a constant of each scene.
- A voxel grid proposes samples (`train_osf.NetworkStage`) in place of NeRF's coarse network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf_query import Scatter
from osfcore.fields.rays import FIRST_AMBIENT

DENSITY_GAIN = 50.0
POSITION_OCTAVES = 10
DIRECTION_OCTAVES = 4
_FIRST_DENSITY = -3.0  # of s: thin fog, so that light reaches what silhouettes cannot carve
_FIRST_GAIN = -0.5


@dataclass(frozen=True, slots=True)
class OSFSize:
    """Size of the network; the paper's is 8 x 256.

    Attributes:
        depth: layers of the trunk. The position enters again halfway.
        width: units of each layer.
    """

    depth: int = 4
    width: int = 64

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: if a number is out of range.
        """
        if not 2 <= self.depth <= 16:
            raise InvalidInput("teacher depth", self.depth, "between 2 and 16")
        if not 8 <= self.width <= 1024:
            raise InvalidInput("teacher width", self.width, "between 8 and 1024")


def encoding(values: Float[Tensor, "S d"], octaves: int) -> Float[Tensor, "S e"]:
    """Return the values, then sine and cosine of 1, 2, 4, ... times them: d * (1 + 2 * octaves) columns."""
    scales = 2.0 ** torch.arange(octaves, dtype=values.dtype, device=values.device)
    angles = (values[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], dim=-1)


class OSF(nn.Module):
    """The large network of one object; called like osfcore.fields.kiloosf_query.KiloQuery."""

    def __init__(
        self,
        box: Float[np.ndarray, "2 3"],
        size: OSFSize | None = None,
        *,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        """Draw the first weights.

        Args:
            box: box of the object: lowest and highest corner [m].
            size: size of the network.
            generator: random generator of the weights, on the CPU.
            dtype: data type of the parameters.
            device: device of the parameters.
        """
        super().__init__()
        self.size = size or OSFSize()
        self.box = np.asarray(box, np.float64).copy()
        low, high = self.box
        self.half_length = float((high - low).max() / 2)
        self.centre: Tensor
        self.register_buffer("centre", torch.as_tensor((low + high) / 2, dtype=dtype, device=device))
        width, encoded = self.size.width, 3 * (1 + 2 * POSITION_OCTAVES)
        inputs = [encoded] + [width] * (self.size.depth - 1)
        self._skip = self.size.depth // 2  # the trunk's layer that reads the position once more
        inputs[self._skip] += encoded
        directions = 2 * 3 * (1 + 2 * DIRECTION_OCTAVES)

        def layer(columns: int, units: int, gain: float = 6.0) -> nn.Linear:
            made = nn.Linear(columns, units, dtype=dtype, device="meta").to_empty(device="cpu")
            with torch.no_grad():
                bound = (gain / columns) ** 0.5
                made.weight.uniform_(-bound, bound, generator=generator)
                made.bias.zero_()
            return made.to(device)

        self.trunk = nn.ModuleList(layer(columns, width) for columns in inputs)
        self.material = layer(width, 4, gain=1.0)  # s, albedo
        self.bottleneck = layer(width, width, gain=3.0)
        self.mixing, self.gain = layer(width + directions, width // 2), layer(width // 2, 3, gain=1.0)
        self.ambient = nn.Parameter(torch.full((3,), FIRST_AMBIENT, dtype=dtype, device=device))
        with torch.no_grad():
            self.material.bias[0] = _FIRST_DENSITY
            self.gain.bias.fill_(_FIRST_GAIN)

    @property
    def device(self) -> torch.device:
        """The device of its parameters."""
        return self.ambient.device

    def density(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Return the density at points of the object's frame [1/m]."""
        return self._sigma(self.material(self._features(x))[:, 0])

    def material_at(self, x: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """Return density [1/m] and albedo at points, which depend on neither light nor view."""
        material = self.material(self._features(x))
        return self._sigma(material[:, 0]), torch.sigmoid(material[:, 1:])

    def forward(self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]) -> Scatter:
        """Evaluate the field (paper eq. 1).

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
        """
        features = self._features(x)
        material = self.material(features)
        albedo = torch.sigmoid(material[:, 1:])
        a = torch.cat([self.bottleneck(features), *(encoding(d, DIRECTION_OCTAVES) for d in (light, view))], dim=-1)
        gain = functional.softplus(self.gain(torch.relu(self.mixing(a))))
        return Scatter(albedo * self.ambient, albedo * gain, self._sigma(material[:, 0]))

    def _features(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S w"]:
        encoded = encoding((x - self.centre) / self.half_length, POSITION_OCTAVES)
        a = encoded
        for number, layer in enumerate(self.trunk):
            a = torch.relu(layer(torch.cat([a, encoded], dim=-1) if number == self._skip else a))
        return a

    def _sigma(self, s: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
        return functional.softplus(s) * (DENSITY_GAIN / self.half_length)
