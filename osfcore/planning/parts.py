"""Costs and planners by name, and the inputs of their factories. Other packages can add more (`osfcore.plugins`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.states import SceneState
from osfcore.planning.costs import Cost, ImageCost, PoseCost, PoseGoal
from osfcore.planning.mppi import MPPIPlanner, PlanRound, PlanSettings, PushSource, Rollout
from osfcore.plugins import PartKind
from osfcore.render.types import Renderer


@dataclass(frozen=True, eq=False, slots=True)
class CostInputs:
    """Inputs of a factory of costs.

    Attributes:
        goal: the goal poses.
        camera: camera of the goal image.
        image: goal image, linear RGB in [0, 1].
        light: light of the goal image.
        renderer: renderer of the objects on the table, to draw futures with.

    Example:
        >>> given = CostInputs(goal, cameras[0], images[0], light, models.together)
        >>> cost = PoseCost(given.goal)
        >>> cost(push_model.rollout(state, np.zeros((1, 5, 3)))).round(3)  # 3 x 0.08 m
        array([0.24])
    """

    goal: PoseGoal
    camera: Camera
    image: Float[np.ndarray, "h w 3"]
    light: Light
    renderer: Renderer


@dataclass(frozen=True, eq=False, slots=True)
class PlannerInputs:
    """Inputs of a factory of planners.

    Attributes:
        rollout: function that predicts futures from a state, actions, and the state one action earlier or None.
        proposals: source of pushes that are likely to be useful.
        settings: settings of the plan.
    """

    rollout: Rollout
    proposals: PushSource
    settings: PlanSettings


class Planner(Protocol):
    """A planner of actions. `MPPIPlanner` describes each method in full.

    Attributes:
        settings: settings of the plan. An episode replaces them while it runs: the horizon shrinks to the actions that
            are left.
    """

    settings: PlanSettings

    def plan(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None = None
    ) -> Iterator[PlanRound]:
        """Yield one or more rounds of a new plan."""
        ...

    def nominal(self, count: int) -> Float[np.ndarray, "count 3"]:
        """Return the next actions of the plan [m/s]; zeros after its end, or without a plan."""
        ...

    def shift(self, count: int) -> None:
        """Drop actions that have been executed from the beginning of the plan."""
        ...

    def reset(self) -> None:
        """Forget the plan, because the goal or the scene has changed."""
        ...


COST = PartKind("cost", ("__call__",))
PLANNER = PartKind("planner", ("plan", "nominal", "shift", "reset"))


def mppi(given: PlannerInputs) -> Planner:
    """Return the default planner."""
    return MPPIPlanner(given.rollout, given.proposals, given.settings)


COSTS: Mapping[str, Callable[[CostInputs], Cost]] = {
    "pose": lambda given: PoseCost(given.goal),
    "image": lambda given: ImageCost(given.renderer, given.camera, given.image, given.light),
}
PLANNERS: Mapping[str, Callable[[PlannerInputs], Planner]] = {"mppi": mppi}
