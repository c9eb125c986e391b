"""Do one task of rearrangement: from images, or by the same planner that knows the true poses."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Float

from osfcore.control.closed_loop import Episode, offsets
from osfcore.control.estimators import EpisodeParts, Estimators, SceneModels
from osfcore.control.events import EpisodeSettings, Event, Stepped
from osfcore.control.goal import GoalImage, nearest_symmetric_goal
from osfcore.errors import InvalidInput
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.experiments.factors import Factor, VariedWorld
from osfcore.experiments.rivals.nerf import with_nerfs
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.algorithm import AlgorithmSettings, run_algorithm
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.paper.stages import STAGES, PaperEstimators, StageName, with_paper_stages
from osfcore.planning.costs import PoseCost, PoseGoal
from osfcore.planning.mppi import MPPIPlanner, Rollout
from osfcore.planning.pushes import PushProposals
from osfcore.progress import Progress
from osfcore.world.scenes import Conditions
from osfcore.world.simulated_dynamics import SimulatedPushes
from osfcore.world.simulators import Simulator
from osfcore.world.tabletop import Tabletop

# Whose episodes are measured.
#
# Methods:
#     ours         the loop as it ships.
#     overhead     the same, but it takes the light to be overhead: what estimating the light is worth.
#     known_light  the same with the true lights of scene and goal image: what knowing them would be worth.
#     nerf         the same with fields that know of no light (compositional NeRFs).
#     paper        the method as published; each of its stages can be replaced by ours.
#     foresight    visual foresight with FitVid: neither objects nor poses nor light.
#
# Stages of ours can be replaced by the truth, to find what each costs:
#     poses     true poses and light at each look.
#     goal      the goal's true poses.
#     dynamics  the simulator.


Method = Literal["ours", "overhead", "known_light", "nerf", "paper", "foresight"]
METHODS: tuple[Method, ...] = get_args(Method)
TruthName = Literal["poses", "goal", "dynamics"]
TRUTHS: tuple[TruthName, ...] = get_args(TruthName)
_SURE = 1e-3  # claimed deviation of a true pose [m or rad]
_OVERHEAD = Light(np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class Variant:
    """A method, what is replaced in it, and what it sees.

    Attributes:
        method: whose episodes.
        replaced: stages of the paper's method that are ours.
        truths: stages of ours that are replaced by the truth.
        views: cameras that it looks through.
        has_masks: whether the paper's method gets masks at every step, as in the paper's evaluation.
    """

    method: Method = "ours"
    replaced: frozenset[StageName] = frozenset()
    truths: frozenset[TruthName] = frozenset()
    views: int = 4
    has_masks: bool = False

    @property
    def fields(self) -> str:
        """Whose fields it has: one of `images.FIELD_METHODS`."""
        return "paper" if self.published("fields") else "nerf" if self.method == "nerf" else "ours"

    def published(self, stage: StageName) -> bool:
        """Return whether a stage is the paper's."""
        return self.method == "paper" and stage not in self.replaced

    def name(self) -> str:
        """Return the name of its files: the method, then what differs from it."""
        views = f"{self.views}views" if self.views != Variant().views else ""
        true = (f"true_{truth}" for truth in sorted(self.truths))
        masks = "masks" if self.has_masks else ""
        return "-".join(part for part in (self.method, *sorted(self.replaced), *true, views, masks) if part)


class LoopParts(NamedTuple):
    """Models and estimators of a closed loop."""

    models: SceneModels
    estimators: Estimators


@dataclass(frozen=True)
class TrueEstimators(Estimators):
    """Estimators that return the truth of the scene, but not of the goal.

    Attributes:
        truth: returns the true state.
    """

    truth: Callable[[], SceneState] = field(kw_only=True)

    def first_frame(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator
    ) -> Iterator[EstimateStep]:
        """Return the truth."""
        yield _true_step(self.truth())

    def later_frame(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        usual: Float[np.ndarray, "N"] | None = None,
    ) -> Iterator[EstimateStep]:
        """Return the truth."""
        yield _true_step(self.truth())


def _true_step(state: SceneState) -> EstimateStep:
    sure = np.full(len(state.names), _SURE)
    estimate = EstimatedState(state, sure, sure, _SURE, ("",) * len(sure), "")
    return EstimateStep(Progress(1, 1, "Told the truth"), "done", state, estimate=estimate)


class SimulatedModel(SimulatedPushes):
    """The simulator as a dynamics model.

    Args:
        assets: meshes.
        names: of the scene's objects.
        simulator: which.
    """

    device = torch.device("cpu")

    def __init__(self, assets: AssetLibrary, names: tuple[str, ...], simulator: Simulator) -> None:
        super().__init__({name: assets.load(name) for name in names}, simulator)
        self.names = names


def check_variant(variant: Variant) -> None:
    """Check that everything in a variant can be combined.

    Raises:
        InvalidInput: naming what cannot.
    """
    if variant.method not in METHODS:
        raise InvalidInput("method", repr(variant.method), f"one of {', '.join(METHODS)}")
    _check_choice("stages of ours", variant.replaced, STAGES, variant.method, "paper")
    if len(variant.replaced) == len(STAGES):
        raise InvalidInput("stages of ours", "all of them", "some; method ours is what replaces all")
    _check_choice("stages replaced by the truth", variant.truths, TRUTHS, variant.method, "ours")
    if variant.has_masks and not (variant.published("estimation") and variant.published("planning")):
        allowed = "left out: only the paper's estimation and planning use them"
        raise InvalidInput("masks at every step", "given", allowed)
    most = Variant().views
    if not 1 <= variant.views <= most:
        raise InvalidInput("number of views", variant.views, f"between 1 and {most}")
    if variant.views != most and variant.method == "foresight":
        allowed = "left out with method foresight, which has the goal's view"
        raise InvalidInput("number of views", variant.views, allowed)


def _check_choice(what: str, chosen: Iterable[str], among: Sequence[str], method: str, needed: str) -> None:
    chosen = sorted(chosen)
    for one in chosen:
        if one not in among:
            raise InvalidInput(what, one, ", ".join(among))
    if chosen and method != needed:
        raise InvalidInput(what, ", ".join(chosen), f"given with method {needed} alone")


def loop_parts(
    variant: Variant,
    models: SceneModels,
    fields: FieldLibrary,
    data_dir: Path | None,
    lights: tuple[Light, Light] = (_OVERHEAD, _OVERHEAD),
) -> LoopParts:
    """Return the parts of a method's loop; truths come to them when its world is there.

    Args:
        variant: of any method but foresight.
        models: ours, of the task's objects.
        fields: library of the fields.
        data_dir: whose files come before the installed ones.
        lights: true ones of scene and goal image, for the method that knows them.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    match variant.method:
        case "overhead":
            return LoopParts(models, Estimators.with_known_lights(_OVERHEAD, _OVERHEAD))
        case "known_light":
            return LoopParts(models, Estimators.with_known_lights(*lights))
        case "nerf":  # no light changes what its fields show, so none is looked for
            estimators = Estimators.with_known_lights(_OVERHEAD, _OVERHEAD)
            return LoopParts(with_nerfs(models, fields, data_dir), estimators)
        case "paper":
            stages = frozenset(STAGES) - variant.replaced
            estimators = PaperEstimators() if "estimation" in stages else Estimators()
            return LoopParts(with_paper_stages(models, stages, fields, data_dir), estimators)
        case _:
            return LoopParts(models, Estimators())


@dataclass(frozen=True, eq=False, slots=True)
class TrueState:
    """The true state, which the loop must not see, at an instant that the loop has just estimated."""

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

    @staticmethod
    def of(world: Tabletop, goal: GoalImage) -> Ended:
        """Return how a table is now, under the camera of its goal image."""
        image = world.render((goal.camera,), with_pusher=False).images[0]
        return Ended(world.truth(), image, goal.image)


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
    """Run the whole loop; yields the truth before each `Stepped`, and last how it ended.

    Args:
        task: the method sees its goal image alone.
        assets: meshes, for the simulator.
        parts: of the loop.
        settings: of the loop; planning as published uses the number of steps alone.
        rng: of estimates and plans.
        factor: how the world differs from what is taken for granted.
        variant: names who plans, what is replaced by the truth, and how many cameras there are.
        published: how planning as published samples.
    """
    variant = variant or Variant()
    cameras = default_cameras()[: variant.views]
    with contextlib.ExitStack() as stack:
        factor = factor or Factor()
        varied = VariedWorld(assets, factor, rng.spawn(1)[0], cameras=cameras)
        world = stack.enter_context(contextlib.closing(varied))
        goal = world.goal_image(task.goal, goal_camera())
        world.restore(task.start)
        models, estimators = parts.models, parts.estimators
        if "dynamics" in variant.truths:
            simulated = SimulatedModel(assets, tuple(models.shapes), factor.conditions.simulator)
            stack.enter_context(contextlib.closing(simulated))
            models = replace(models, dynamics=simulated)
        if "poses" in variant.truths:
            estimators = TrueEstimators(estimators.first, estimators.later, estimators.goal, truth=world.truth)
        if variant.published("planning"):
            how = AlgorithmSettings(settings.steps, published or GaussianPlanSettings(), variant.has_masks)
            events = run_algorithm(world, models, goal, how, estimators, rng)
        else:
            target = PoseGoal(task.goal.names, task.goal.poses) if "goal" in variant.truths else goal
            events = Episode(world, models, target, settings, rng, parts=EpisodeParts(estimators)).run()
        for event in events:
            if isinstance(event, Stepped):
                yield TrueState(world.truth())
            yield event
        yield Ended.of(world, goal)


def run_told_the_truth(
    task: RearrangementTask,
    assets: AssetLibrary,
    models: SceneModels,
    settings: EpisodeSettings,
    rng: np.random.Generator,
    *,
    knows_pushes: bool,
    simulator: Simulator,
) -> Ended:
    """Run the same planner with true poses until the goal is reached or all steps are done.

    Args:
        task: with the true goal.
        assets: meshes, for the simulator.
        models: of which only shapes, symmetries and pushes play a part.
        settings: of which only steps, plans and what counts as arrived play a part.
        rng: of the plans.
        knows_pushes: whether the simulator is its dynamics, and not the learned model.
        simulator: what moves the objects.
    """
    with contextlib.ExitStack() as stack:
        world = stack.enter_context(contextlib.closing(Tabletop(assets, conditions=Conditions(simulator=simulator))))
        rollout: Rollout = models.pushes.rollout
        if knows_pushes:
            simulated = SimulatedModel(assets, task.start.names, simulator)
            rollout = stack.enter_context(contextlib.closing(simulated)).rollout
        world.restore(task.goal)
        camera = goal_camera()
        goal = GoalImage(camera, world.render((camera,), with_pusher=False).images[0])
        world.restore(task.start)
        planner = MPPIPlanner(rollout, PushProposals(models.shapes, models.pushes.rollout), settings.plan)
        target, left = PoseGoal.of(task.start, {name: task.goal.pose(name) for name in task.moved}), settings.steps
        while left > 0:
            state = world.truth()
            target = nearest_symmetric_goal(target, state, models.symmetries)
            far, turned = offsets(target, state)
            if far.max() <= settings.reached_m and turned.max() <= settings.reached_rad:
                break
            planner.settings = replace(settings.plan, horizon=min(settings.plan.horizon, left))
            for _ in planner.plan(state, target, PoseCost(target), rng):
                pass
            actions = planner.nominal(min(settings.replan_every, left))
            for action in actions:
                world.act(action)
            planner.shift(len(actions))
            left -= len(actions)
        return Ended.of(world, goal)
