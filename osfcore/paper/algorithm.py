"""Algorithm 1 as published: estimate, sample, predict, render, compare, act; for T steps, whatever happens.

Nothing else is there: no poses of the goal, no stopping, no doubts, no search for what was lost. The objects' fields,
the estimators and the dynamics model are arguments, so that each can be replaced by ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from osfcore.control.closed_loop import StageTimer
from osfcore.control.estimators import Estimators, SceneModels
from osfcore.control.events import ActionExecuted, Event, Finished, Looking, Observed, Planning, Stepped
from osfcore.control.goal import GoalImage
from osfcore.control.world import World
from osfcore.errors import InvalidInput
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.states import EstimatedState
from osfcore.paper.mppi import STEPS, GaussianMPPI, GaussianPlanSettings
from osfcore.planning.costs import ImageCost
from osfcore.render.types import PLANNING, SceneBatch


@dataclass(frozen=True, slots=True)
class AlgorithmSettings:
    """How an episode goes.

    Attributes:
        steps: actions (T).
        plan: how they are sampled.
        has_masks: whether there are masks at every step, as in the paper's evaluation; else in the first frame alone.
    """

    steps: int = STEPS
    plan: GaussianPlanSettings = field(default_factory=GaussianPlanSettings)
    has_masks: bool = False


def run_algorithm(
    world: World,
    models: SceneModels,
    goal: GoalImage,
    settings: AlgorithmSettings,
    estimators: Estimators,
    rng: np.random.Generator,
) -> Iterator[Event]:
    """Run Algorithm 1, until a `Finished`.

    Args:
        world: cameras and pusher.
        models: of the objects.
        goal: I_goal and its viewpoint.
        settings: how it goes.
        estimators: Psi.
        rng: draws everything.

    Raises:
        InvalidInput: if the world gives no masks for the first frame.
        UnknownName: if an object is not known.
    """
    planner = GaussianMPPI(models.dynamics.rollout, settings.plan)
    observation = world.observe(masks=True)
    yield Observed(0, observation)
    timer = StageTimer()
    steps = estimators.first_frame(models.appearance, observation, rng)
    estimate = yield from _look(0, timer.steps("first", steps))
    for number in range(settings.steps):
        estimate = estimate.with_pusher(observation.pusher)
        yield _stepped(number, settings, models, goal, estimate, timer.taken())
        with timer.stage("plan"):
            cost = ImageCost(models.appearance.together, goal.camera, goal.image, estimate.state.light, every=1)
            round_ = planner.plan(estimate.state, cost, rng)
        yield Planning(number, round_)
        world.act(round_.actions[0])
        planner.shift()
        yield ActionExecuted(number + 1, round_.actions[0])
        observation = world.observe(masks=settings.has_masks)
        yield Observed(number + 1, observation)
        later = estimators.later_frame(models.appearance, observation, estimate.state, rng)
        estimate = yield from _look(number + 1, timer.steps("estimate", later))
    estimate = estimate.with_pusher(observation.pusher)
    yield _stepped(settings.steps, settings, models, goal, estimate, timer.taken())
    yield Finished(settings.steps, "out of steps", f"All {settings.steps} pushes are done.", estimate.state)


def _look(number: int, steps: Iterator[EstimateStep]) -> Iterator[Event]:  # returns the EstimatedState
    estimate = None
    for step in steps:
        estimate = step.estimate
        yield Looking(number, "next" if number else "first", step)
    if estimate is None:
        raise InvalidInput("last step of the estimator", "without an estimate", "one that holds it")
    return estimate


def _stepped(
    number: int,
    settings: AlgorithmSettings,
    models: SceneModels,
    goal: GoalImage,
    estimate: EstimatedState,
    seconds: dict[str, float],
) -> Stepped:
    """Return the event of a step; distances to the goal are not known, for it has no poses here."""
    batch = SceneBatch.of(replace(estimate.state, pusher=None))  # as the goal image would show it
    rendered = models.appearance.together.render(batch, (goal.camera,), quality=PLANNING).rgb[0, 0]
    cost = float(((rendered - goal.image) ** 2).mean())
    unknown = np.zeros(0)
    return Stepped(number, settings.steps, estimate, unknown, unknown, cost, rendered, seconds)
