"""What planning, control and the command line need of a model of dynamics, whichever it is."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float

from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState


class DynamicsModel(Protocol):
    """Predicts what pushes do: our `PushModel`, or the paper's (`osfcore.paper.dynamics`)."""

    device: torch.device

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that it can predict."""
        ...

    def rollout(
        self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None = None
    ) -> Rollouts:
        """Predict poses under K sequences of T actions.

        Args:
            state: state of the scene, with its pusher.
            actions: velocities (vx, vy, 0) of the pusher [m/s], each held for 0.2 s.
            before: the same objects one action ago, for models that consider how things move.
        """
        ...
