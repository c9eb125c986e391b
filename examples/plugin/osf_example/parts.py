"""One of each: run them with `osf episode --world slippery --cost last --planner shooting --estimator daylight`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from osfcore.control.estimators import Estimators
from osfcore.geometry.light import Light
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.planning.mppi import PlanRound
from osfcore.planning.parts import CostInputs, PlannerInputs
from osfcore.planning.costs import Cost, PoseGoal, object_costs
from osfcore.world.scenes import Conditions
from osfcore.world.tabletop import WorldInputs
from osfcore.world.tabletop import Tabletop


def slippery(given: WorldInputs) -> Tabletop:
    """Our table with half the friction. Any class with the methods of `SimulatedWorld` may take its place."""
    return Tabletop(given.library, request=given.request, conditions=Conditions(friction_factor=0.5))


class LastPose:
    """How far objects are from their goals at the end, however they come there [m]."""

    def __init__(self, given: CostInputs) -> None:
        self._goal = given.goal

    def __call__(self, rollouts: Rollouts) -> np.ndarray:
        """One cost for each of the K sequences."""
        return object_costs(rollouts, self._goal)[:, -1].sum(axis=1)


class RandomShooting:
    """The best of the pushes that are proposed, with nothing refined."""

    def __init__(self, given: PlannerInputs) -> None:
        self._given, self.settings = given, given.settings
        self.reset()

    def reset(self) -> None:
        """Forget the plan."""
        self._plan = np.zeros((0, 3))

    def plan(
        self, state: SceneState, goal: PoseGoal, cost: Cost, rng: np.random.Generator, before: SceneState | None = None
    ) -> Iterator[PlanRound]:
        """One round: propose, predict, compare; the plan so far takes part, so that it is kept while it is best."""
        count, horizon = self.settings.samples, self.settings.horizon
        pushes = self._given.proposals.draw(state, goal, count - 1, horizon, rng)
        actions = np.concatenate([self.nominal(horizon)[None], pushes])
        rollouts = self._given.rollout(state, actions, before)
        costs = cost(rollouts)
        self._plan = actions[int(costs.argmin())]
        yield PlanRound(0, self._plan, rollouts, costs)

    def nominal(self, count: int) -> np.ndarray:
        """The next actions of the plan; zero after its end."""
        plan = self._plan[:count]
        return np.concatenate([plan, np.zeros((count - len(plan), 3))])

    def shift(self, count: int) -> None:
        """Go on by actions that have been executed."""
        self._plan = self._plan[count:]


def daylight(data_dir: Path) -> Estimators:
    """Ours, told that all light comes from above."""
    overhead = Light(np.array([0.0, 0.0, 1.0]))
    return Estimators.with_known_lights(overhead, overhead)
