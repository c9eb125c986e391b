"""The interface of dynamics models, for planning, control and the command line."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float

from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState


class DynamicsModel(Protocol):
    """A model that predicts the effect of pushes: `PushModel`, or the paper's (`osfcore.paper.dynamics`)."""

    device: torch.device

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects that it can predict."""
        ...

    def rollout(
        self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None = None
    ) -> Rollouts:
        """Predict poses under K sequences of T actions.

        Args:
            state: state of the scene, with a pusher.
            actions: velocities (vx, vy, 0) of the pusher in the world [m/s], each held for 0.2 s.
            before: state of the same objects one action earlier, for models that use velocities.
        """
        ...
