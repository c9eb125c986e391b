"""The lights of the reference renderer: what points of the world see of a distant one, and of a near lamp.

Both answer the same four questions. `SpotLamp` has the equations of the lamp.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from osfcore.fields.table_field import TableField
from osfcore.geometry.spot_lamp import MIN_PENUMBRA_RAD, SpotLamp

FAR = 1e9


class DistantLight(NamedTuple):
    """The same from everywhere."""

    direction: Float[Tensor, "3"]

    def toward(self, points: Float[Tensor, "R 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "R 3"]:
        """Unit vectors from points [m] toward the light, in the frame into which `rotation` leads from the world."""
        return (rotation @ self.direction).expand_as(points)

    def distance(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R"]:
        """From points to the light [m]; what lies beyond it casts no shadow."""
        return torch.full_like(points[:, 0], FAR)

    def gain(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 1"]:
        """Share of the diffuse light that arrives at points where nothing shades them."""
        return torch.ones_like(points[:, :1])

    def on_table(self, table: TableField, points: Float[Tensor, "R 3"]) -> Float[Tensor, "#R 3"]:
        """Direct light of three colours on a white table at points of it where nothing shades them."""
        return torch.as_tensor(table.direct(self.direction.cpu().double().numpy()[None])).to(points)


class NearLight(NamedTuple):
    """A lamp at a finite distance."""

    position: Float[Tensor, "3"]  # [m]
    axis: Float[Tensor, "3"]  # unit vector from it toward what it looks at
    inner: float  # half-angles of its cone [rad]
    outer: float

    def toward(self, points: Float[Tensor, "R 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "R 3"]:
        """As of a distant light."""
        return normalize(self.position - points, dim=-1) @ rotation.T

    def distance(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R"]:
        """As of a distant light."""
        return torch.linalg.norm(self.position - points, dim=-1)

    def gain(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 1"]:
        """As of a distant light: the cone's share times the falloff, (d0 / r)^2."""
        angle = torch.arccos((normalize(points - self.position, dim=-1) @ self.axis).clamp(-1, 1))
        s = ((self.outer - angle) / max(self.outer - self.inner, MIN_PENUMBRA_RAD)).clamp(0, 1)
        falloff = (self.position @ self.position) / self.distance(points) ** 2
        return (s * s * (3 - 2 * s) * falloff)[:, None]

    def on_table(self, table: TableField, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """As of a distant light."""
        directions = normalize(self.position - points, dim=-1)
        return torch.as_tensor(table.direct(directions.cpu().double().numpy())).to(points) * self.gain(points)


def near_light(spot: SpotLamp, tensor: Callable[[object], Tensor]) -> NearLight:
    """A lamp as tensors, which `tensor` makes of arrays."""
    return NearLight(tensor(spot.position), tensor(spot.axis), *spot.cone_rad)
