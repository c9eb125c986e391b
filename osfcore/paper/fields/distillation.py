"""From a teacher OSF to tiny networks, the second of the three steps of KiloNeRF (Reiser et al. 2021, section 3.2).

Points are drawn uniformly from the occupied space, with the views and lights that the images have; the tiny networks
learn to answer as the teacher does, by the mean squared error of the opacity of a voxel and of rho.

Deviation: rho counts where the teacher is opaque, for the tiny networks never render it elsewhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.fields.osf import OSF
from osfcore.fields.ray_sampling import RayBatch
from osfcore.fields.training.optimization import Rates
from osfcore.paper.fields.tiny_field import TinyField
from osfcore.paper.fields.tiny_query import TinyQuery

RATES = Rates(3e-3, 1e-3)
_POINTS = 8192


class TinyDistillation:
    """Tiny networks while they learn from a teacher.

    Args:
        field: where the networks begin.
        teacher: a trained OSF of the same object.
        device: that computes.
    """

    def __init__(self, field: TinyField, teacher: OSF, device: torch.device) -> None:
        self.teacher, self.grid = teacher, field
        self.query = TinyQuery(field, device=device)
        self._optimiser = torch.optim.Adam(self.query.parameters(), eps=1e-12)
        self._corners = np.argwhere(field.occupied).astype(np.float32)

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, _generator: torch.Generator) -> float:
        """One step of descent on random points.

        Args:
            rays: views and lights are drawn from theirs.
            share: of the stage that is done, in [0, 1].
            rng: draws the points.

        Returns:
            The loss.
        """
        for group in self._optimiser.param_groups:
            group["lr"] = RATES.at(share)
        corner = self._corners[rng.integers(len(self._corners), size=_POINTS)]
        jitter = rng.uniform(-0.5, 0.5, corner.shape).astype(np.float32)
        points = self.grid.origin + np.float32(self.grid.voxel) * (corner + jitter)
        ray = rng.integers(len(rays.lights), size=_POINTS)
        loss = self.loss(*(torch.as_tensor(a, device=self.query.device)
                           for a in (points, rays.lights[ray], rays.directions[ray])))  # fmt: skip
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        return float(loss.detach())

    def loss(
        self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]
    ) -> Float[Tensor, ""]:
        """Squared error of a voxel's opacity, and of rho where the teacher is opaque.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
        """
        with torch.no_grad():
            right = self.teacher(x, light, view)
            alpha = -torch.expm1(-right.sigma * self.grid.voxel)
        mine = self.query(x, light, view)
        error = ((mine.direct - right.ambient - right.direct) ** 2).sum(dim=-1)
        return (alpha * error + (-torch.expm1(-mine.sigma * self.grid.voxel) - alpha) ** 2).mean()

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs."""
        return {"adam": self._optimiser.state_dict(), "student": self.query.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._optimiser.load_state_dict(state["adam"])
        self.query.load_state_dict(state["student"])
