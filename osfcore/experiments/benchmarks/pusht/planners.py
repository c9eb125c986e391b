"""Planners that are compared: ours, the paper's and pytorch-mppi's, with one cost, budget and dynamics.

All choose among velocities within the same limits and compare the same futures by the same cost of poses. K sequences
of T actions are looked at for each action: all at once by the Gaussian ones, in two rounds and a comparison by ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from osfcore.experiments.benchmarks.pusht.environment import STATE, MissingPushT, Step
from osfcore.experiments.benchmarks.pusht.table import NAME, cost_of, rollouts_of, scene_of, tee_shape
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S
from osfcore.paper.mppi import GaussianMPPI, GaussianPlanSettings
from osfcore.planning.mppi import COMPARED, MPPIPlanner, PlanSettings
from osfcore.planning.pose_cost import PoseGoal
from osfcore.planning.push_proposals import PushProposals

NOISE_M_S = 0.2  # of both Gaussian planners' velocities, as in the paper's implementation
PYTORCH_MPPI_LAMBDA = 0.001  # of the cost [m]; the best of 0.0003 to 0.03 on three tasks of other seeds


@dataclass(frozen=True, eq=False, slots=True)
class Problem:
    """What a planner is given.

    Attributes:
        goal: where the T should be.
        step: the dynamics.
        samples: sequences for each plan (K).
        horizon: actions in each (T).
    """

    goal: PoseGoal
    step: Step
    samples: int
    horizon: int


class Planner(Protocol):
    """Plans again before every action."""

    def plan(self, state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        """The next action [m/s].

        Args:
            state: of the plane.
        """
        ...


class OurPlanner:
    """MPPI with straight push proposals; as it ships, but that plans are not recombined nor judged over begins."""

    def __init__(self, problem: Problem, rng: np.random.Generator) -> None:
        self._futures, self._goal, self._rng = _Futures(problem.step), problem.goal, rng
        samples = (problem.samples - COMPARED) // 2
        settings = PlanSettings(samples, problem.horizon, recombined=0, begins_m=0.0)
        self._planner = MPPIPlanner(self._futures, PushProposals({NAME: tee_shape()}), settings)

    def plan(self, state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        """The next action [m/s]."""
        scene = self._futures.begin(state)
        *_, last = self._planner.plan(scene, self._goal, cost_of(self._goal), self._rng)
        self._planner.shift(1)
        return last.actions[0, :2]


class PaperPlanner:
    """Gaussian MPPI of the paper."""

    def __init__(self, problem: Problem, rng: np.random.Generator) -> None:
        self._futures, self._goal, self._rng = _Futures(problem.step), problem.goal, rng
        settings = GaussianPlanSettings(samples=problem.samples, horizon=problem.horizon, noise_m_s=NOISE_M_S)
        self._planner = GaussianMPPI(self._futures, settings)

    def plan(self, state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        """The next action [m/s]."""
        actions = self._planner.plan(self._futures.begin(state), cost_of(self._goal), self._rng).actions
        self._planner.shift()
        return actions[0, :2]


class PytorchMPPI:
    """`MPPI` of pytorch-mppi (University of Michigan), begun at rest; it adds its own cost of actions.

    It draws from torch's global generator, so `rng` is left alone.

    Raises:
        MissingPushT: if it is not installed.
    """

    def __init__(self, problem: Problem, rng: np.random.Generator) -> None:
        import torch

        try:
            from pytorch_mppi import MPPI  # pyright: ignore[reportMissingImports]  an extra
        except ImportError:
            raise MissingPushT from None
        cost = cost_of(problem.goal)

        def dynamics(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(problem.step(states.numpy(), actions.numpy()))

        def cost_of_nothing(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
            return states.new_zeros(len(states))

        def cost_of_all(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
            after = states[0].numpy()  # K x T, without the state before; the cost leaves the first one out
            return torch.from_numpy(cost(rollouts_of(np.concatenate([after[:, :1], after], axis=1))))

        limit = torch.full((2,), MAX_SPEED_M_S, dtype=torch.float64)
        self._planner: Any = MPPI(
            dynamics, cost_of_nothing, STATE, NOISE_M_S**2 * torch.eye(2, dtype=torch.float64),
            num_samples=problem.samples, horizon=problem.horizon, terminal_state_cost=cost_of_all,
            lambda_=PYTORCH_MPPI_LAMBDA, u_min=-limit, u_max=limit,
            U_init=torch.zeros(problem.horizon, 2, dtype=torch.float64),
        )  # fmt: skip

    def plan(self, state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        """The next action [m/s]."""
        return self._planner.command(state).numpy().clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)


PLANNERS = {"ours": OurPlanner, "paper": PaperPlanner, "pytorch_mppi": PytorchMPPI}


class _Futures:
    """Rolls out from one state of the plane, which tells more than a scene: the pusher's velocity."""

    def __init__(self, step: Step) -> None:
        self._step, self._now = step, np.zeros(STATE)

    def begin(self, state: Float[np.ndarray, "7"]) -> SceneState:
        """Where futures begin from here on, as a scene."""
        self._now = state
        return scene_of(state)

    def __call__(self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None) -> Rollouts:
        """Futures of K sequences."""
        states = [np.tile(self._now, (len(actions), 1))]
        for t in range(actions.shape[1]):
            states.append(self._step(states[-1], actions[:, t, :2]))
        return rollouts_of(np.stack(states, axis=1))
