"""One task of planning, done: by us from images, and by the same planner that is told the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.control.closed_loop import Episode
from osfcore.control.episode_settings import EpisodeSettings
from osfcore.control.estimators import EpisodeParts
from osfcore.control.events import Event, Stepped
from osfcore.control.goal import GoalImage, nearest_symmetric_goal
from osfcore.control.monitor import offsets
from osfcore.control.scene_models import SceneModels
from osfcore.experiments.rearrangement.factors import Factor, VariedWorld
from osfcore.experiments.rearrangement.methods import LoopParts, Variant, told_truths
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.states import SceneState
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.algorithm import AlgorithmSettings, run_algorithm
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.planning.mppi import MPPIPlanner, Rollout
from osfcore.planning.pose_cost import PoseCost, PoseGoal
from osfcore.planning.push_proposals import PushProposals
from osfcore.world.simulated_dynamics import SimulatedPushes
from osfcore.world.tabletop import Tabletop


@dataclass(frozen=True, eq=False, slots=True)
class TrueState:
    """The truth at an instant that the loop has just estimated.

    Attributes:
        state: which the loop must not see.
    """

    state: SceneState


@dataclass(frozen=True, eq=False, slots=True)
class Ended:
    """A table that planning has left.

    Attributes:
        state: the truth.
        image: as the goal camera sees it, without the pusher.
        goal: the goal image.
    """

    state: SceneState
    image: Float[np.ndarray, "h w 3"]
    goal: Float[np.ndarray, "h w 3"]


def run_from_images(
    task: RearrangementTask,
    assets: AssetLibrary,
    parts: LoopParts,
    settings: EpisodeSettings,
    rng: np.random.Generator,
    factor: Factor | None = None,
    variant: Variant | None = None,
    published: GaussianPlanSettings | None = None,
) -> Iterator[Event | TrueState | Ended]:
    """The whole loop, with the truth before each `Stepped`; the last step is how it ended.

    Args:
        task: what is told of it is the goal image alone.
        assets: meshes, for the simulator.
        parts: what the loop is made of.
        settings: how the loop goes; of planning as published, the number of steps alone.
        rng: of estimates and plans.
        factor: how the world differs from what is taken for granted.
        variant: tells who plans, what is replaced by the truth, and how many cameras there are.
        published: how planning as published samples.
    """
    variant = variant or Variant()
    cameras = default_cameras()[: variant.views]
    world = VariedWorld(assets, factor or Factor(), rng.spawn(1)[0], cameras=cameras)
    try:
        goal = world.goal_image(task.goal, goal_camera())
        world.restore(task.start)
        parts = told_truths(parts, variant.truths, world.truth, assets)
        if variant.published("planning"):
            how = AlgorithmSettings(settings.steps, published or GaussianPlanSettings(), variant.has_masks)
            events = run_algorithm(world, parts.models, goal, how, parts.estimators, rng)
        else:
            target = PoseGoal(task.goal.names, task.goal.poses) if "goal" in variant.truths else goal
            events = Episode(world, parts.models, target, settings, rng, parts=EpisodeParts(parts.estimators)).run()
        for event in events:
            if isinstance(event, Stepped):
                yield TrueState(world.truth())
            yield event
        yield _ended(world, goal)
    finally:
        world.close()


def run_told_the_truth(
    task: RearrangementTask,
    assets: AssetLibrary,
    models: SceneModels,
    settings: EpisodeSettings,
    rng: np.random.Generator,
    *,
    knows_pushes: bool,
) -> Ended:
    """How the same planner leaves the table with true poses.

    Args:
        task: with the true goal.
        assets: meshes, for the simulator.
        models: of which only shapes, symmetries and pushes play a part.
        settings: of which only steps, plans and what counts as arrived play a part.
        rng: of the plans.
        knows_pushes: whether the simulator is its dynamics, and not the learned model.
    """
    with contextlib.ExitStack() as stack:
        world = stack.enter_context(contextlib.closing(Tabletop(assets)))
        rollout: Rollout = models.pushes.rollout
        if knows_pushes:
            meshes = {name: assets.load(name) for name in task.start.names}
            rollout = stack.enter_context(contextlib.closing(SimulatedPushes(meshes))).rollout
        image = _goal_image(world, task)
        world.restore(task.start)
        _push_there(world, rollout, task, models, settings, rng)
        return _ended(world, image)


def _push_there(
    world: Tabletop,
    rollout: Rollout,
    task: RearrangementTask,
    models: SceneModels,
    settings: EpisodeSettings,
    rng: np.random.Generator,
) -> None:
    planner = MPPIPlanner(rollout, PushProposals(models.shapes, models.pushes.rollout), settings.plan)
    goal, number = _moved_goal(task), 0
    while number < settings.steps:
        state = world.truth()
        goal = nearest_symmetric_goal(goal, state, models.symmetries)
        far, turned = offsets(goal, state)
        if far.max() <= settings.reached_m and turned.max() <= settings.reached_rad:
            return
        left = settings.steps - number
        planner.settings = replace(settings.plan, horizon=min(settings.plan.horizon, left))
        for _ in planner.plan(state, goal, PoseCost(goal), rng):
            pass
        actions = planner.nominal(min(settings.replan_every, left))
        for action in actions:
            world.act(action)
        planner.shift(len(actions))
        number += len(actions)


def _moved_goal(task: RearrangementTask) -> PoseGoal:
    return PoseGoal.of(task.start, {name: task.goal.pose(name) for name in task.moved})


def _goal_image(world: Tabletop, task: RearrangementTask) -> GoalImage:
    world.restore(task.goal)
    camera = goal_camera()
    return GoalImage(camera, world.render((camera,), with_pusher=False).images[0])


def _ended(world: Tabletop | VariedWorld, goal: GoalImage) -> Ended:
    image = world.render((goal.camera,), with_pusher=False).images[0]
    return Ended(world.truth(), image, goal.image)
