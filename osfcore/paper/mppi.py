"""MPPI (Williams et al. 2015) as published: Gaussian samples around the mean of the last plan (Algorithm 1).

    a_k = clip(mean + eps_k),  eps_k ~ N(0, sigma^2 I),    mean' = sum_k w_k a_k,    w_k ~ exp(-(S_k - min S) / lambda)

There are no proposals, no goal poses, no second round. Choices where the paper says nothing: K, H, sigma, and lambda,
which is relative to the standard deviation of the costs. Noise moves the pusher along x and y, for it stays at its
height here. K and H make a plan take about as long as one of ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import check_ranges
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S
from osfcore.planning.costs import Cost
from osfcore.planning.mppi import PlanRound, Rollout

STEPS = 30  # T, actions of an episode


@dataclass(frozen=True, slots=True)
class GaussianPlanSettings:
    """How plans are sampled.

    Attributes:
        samples: sequences of actions (K).
        horizon: actions in each (H).
        noise_m_s: sigma of each velocity around the mean [m/s].
        temperature: lambda, as a share of the costs' standard deviation.
    """

    samples: int = 200
    horizon: int = 15
    noise_m_s: float = 0.2
    temperature: float = 0.3

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_ranges(
            ("number of samples", self.samples, 2, MAX_SEQUENCES),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("noise [m/s]", self.noise_m_s, 0.0, MAX_SPEED_M_S),
            ("temperature", self.temperature, 1e-6, 1e6),
        )


class GaussianMPPI:
    """Receding-horizon planner; its mean is warm-started from the last plan.

    Args:
        rollout: predicts futures.
        settings: of the samples.
    """

    def __init__(self, rollout: Rollout, settings: GaussianPlanSettings | None = None) -> None:
        self.settings = settings or GaussianPlanSettings()
        self._rollout = rollout
        self._mean: Float[np.ndarray, "H 3"] = np.zeros((self.settings.horizon, 3))

    def plan(self, state: SceneState, cost: Cost, rng: np.random.Generator) -> PlanRound:
        """Sample, score and average; the actions of the round are the new mean.

        Args:
            state: of the scene, with its pusher.
            cost: of rollouts.
            rng: draws the samples.
        """
        settings = self.settings
        noise = rng.normal(0, settings.noise_m_s, (settings.samples, *self._mean.shape)) * (1, 1, 0)
        actions = (self._mean + noise).clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)
        rollouts = self._rollout(state, actions, None)
        costs = cost(rollouts)
        scale = settings.temperature * max(float(costs.std()), 1e-12)
        weights = np.exp(-(costs - costs.min()) / scale)
        self._mean = np.einsum("k,kta->ta", weights / weights.sum(), actions)
        return PlanRound(0, self._mean, rollouts, costs)

    def shift(self) -> None:
        """Drop the first action, which was executed; the new last one is at rest."""
        self._mean = np.concatenate([self._mean[1:], np.zeros((1, 3))])
