"""Costs and planners by name, and what each is made from; other packages offer more (`osfcore.plugins`)."""

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
    """Inputs of a cost: what it may compare futures with, and a renderer to draw them.

    Attributes:
        goal: where everything should be.
        camera: of the goal image.
        image: that camera's, linear RGB.
        light: of the goal image.
        renderer: of the objects on the table.
    """

    goal: PoseGoal
    camera: Camera
    image: Float[np.ndarray, "h w 3"]
    light: Light
    renderer: Renderer


@dataclass(frozen=True, eq=False, slots=True)
class PlannerInputs:
    """Inputs of a planner.

    Attributes:
        rollout: predicts futures: state, actions, and the state one action ago if known.
        proposals: samples pushes that are likely to be useful.
        settings: of the plan.
    """

    rollout: Rollout
    proposals: PushSource
    settings: PlanSettings


class Planner(Protocol):
    """A planner of actions: `MPPIPlanner` says what each method does.

    Attributes:
        settings: replaced while an episode runs; the horizon shrinks to the actions that are left.
    """

    settings: PlanSettings

    def plan(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None = None
    ) -> Iterator[PlanRound]:
        """Plan anew; one round or more."""
        ...

    def nominal(self, count: int) -> Float[np.ndarray, "count 3"]:
        """The next actions of the plan; zero after its end, and without one [m/s]."""
        ...

    def shift(self, count: int) -> None:
        """Go on by actions that have been executed."""
        ...

    def reset(self) -> None:
        """Drop the plan: the goal or the scene is another one."""
        ...


COST = PartKind("cost", ("__call__",))
PLANNER = PartKind("planner", ("plan", "nominal", "shift", "reset"))


def mppi(given: PlannerInputs) -> Planner:
    """Make our planner."""
    return MPPIPlanner(given.rollout, given.proposals, given.settings)


COSTS: Mapping[str, Callable[[CostInputs], Cost]] = {
    "pose": lambda given: PoseCost(given.goal),
    "image": lambda given: ImageCost(given.renderer, given.camera, given.image, given.light),
}
PLANNERS: Mapping[str, Callable[[PlannerInputs], Planner]] = {"mppi": mppi}
