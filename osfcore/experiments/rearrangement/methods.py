"""Whose episodes are measured.

Methods:
    ours         the loop as it ships.
    overhead     the same, but it takes the light to be overhead: what estimating the light is worth.
    known_light  the same, told the true lights of scene and goal image: what knowing them would be worth.
    nerf         the same with fields that know of no light (compositional NeRFs).
    paper        the method as published; each of its stages can be replaced by ours.
    foresight    visual foresight with FitVid: neither objects nor poses nor light.

Stages of ours can be replaced by the truth, to find what each costs:
    poses     true poses and light at each look.
    goal      the goal's true poses.
    dynamics  the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float

from osfcore.control.estimators import Estimators
from osfcore.control.scene_models import SceneModels
from osfcore.errors import InvalidInput
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.experiments.rivals.nerf import with_nerfs
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.light import Light
from osfcore.geometry.states import Observation, SceneState
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.stages import STAGES, PaperEstimators, StageName, with_paper_stages
from osfcore.progress import Progress
from osfcore.world.simulated_dynamics import SimulatedPushes

Method = Literal["ours", "overhead", "known_light", "nerf", "paper", "foresight"]
METHODS: tuple[Method, ...] = get_args(Method)
TruthName = Literal["poses", "goal", "dynamics"]
TRUTHS: tuple[TruthName, ...] = get_args(TruthName)
_SURE = 1e-3  # claimed deviation of a true pose [m or rad]


@dataclass(frozen=True, slots=True)
class Variant:
    """What is measured of a method, and what it sees.

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
        """Whose fields it has: one of `image_methods.FIELD_METHODS`."""
        return "paper" if self.published("fields") else "nerf" if self.method == "nerf" else "ours"

    def published(self, stage: StageName) -> bool:
        """Whether a stage is the paper's."""
        return self.method == "paper" and stage not in self.replaced

    def name(self) -> str:
        """Of its files: the method, then what differs from it."""
        views = f"{self.views}views" if self.views != Variant().views else ""
        true = (f"true_{truth}" for truth in sorted(self.truths))
        masks = "masks" if self.has_masks else ""
        return "-".join(part for part in (self.method, *sorted(self.replaced), *true, views, masks) if part)


@dataclass(frozen=True, slots=True)
class LoopParts:
    """What a closed loop is made of.

    Attributes:
        models: of the objects.
        estimators: how everything is estimated.
    """

    models: SceneModels
    estimators: Estimators


@dataclass(frozen=True)
class TrueEstimators(Estimators):
    """Estimators that are told the truth of the scene, but not of the goal.

    Attributes:
        truth: tells the true state.
    """

    truth: Callable[[], SceneState] = field(kw_only=True)

    def first_frame(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator
    ) -> Iterator[EstimateStep]:
        """The truth."""
        yield _true_step(self.truth())

    def later_frame(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        usual: Float[np.ndarray, "N"] | None = None,
    ) -> Iterator[EstimateStep]:
        """The truth."""
        yield _true_step(self.truth())


def _true_step(state: SceneState) -> EstimateStep:
    sure = np.full(len(state.names), _SURE)
    estimate = EstimatedState(state, sure, sure, _SURE, ("",) * len(sure), "")
    return EstimateStep(Progress(1, 1, "Told the truth"), "done", state, estimate=estimate)


class SimulatedModel(SimulatedPushes):
    """The simulator as a `DynamicsModel`.

    Args:
        assets: meshes.
        names: of the scene's objects.
    """

    device = torch.device("cpu")

    def __init__(self, assets: AssetLibrary, names: tuple[str, ...]) -> None:
        super().__init__({name: assets.load(name) for name in names})
        self.names = names


def check_variant(variant: Variant) -> None:
    """Refuse what cannot be combined.

    Raises:
        InvalidInput: naming it.
    """
    if variant.method not in METHODS:
        raise InvalidInput("method", repr(variant.method), f"one of {', '.join(METHODS)}")
    _check_choice("stages of ours", variant.replaced, STAGES, variant.method, "paper")
    if len(variant.replaced) == len(STAGES):
        raise InvalidInput("stages of ours", "all of them", "some; method ours is what replaces all")
    _check_choice("stages replaced by the truth", variant.truths, TRUTHS, variant.method, "ours")
    if variant.has_masks and not (variant.published("estimation") and variant.published("planning")):
        raise InvalidInput(
            "masks at every step", "given", "left out: only the paper's estimation and planning use them"
        )
    most = Variant().views
    if not 1 <= variant.views <= most:
        raise InvalidInput("number of views", variant.views, f"between 1 and {most}")
    if variant.views != most and variant.method == "foresight":
        raise InvalidInput(
            "number of views", variant.views, "left out with method foresight, which has the goal's view"
        )


def _check_choice(what: str, chosen: Iterable[str], among: Iterable[str], method: str, needed: str) -> None:
    chosen, among = sorted(chosen), tuple(among)
    for one in chosen:
        if one not in among:
            raise InvalidInput(what, one, ", ".join(among))
    if chosen and method != needed:
        raise InvalidInput(what, ", ".join(chosen), f"given with method {needed} alone")


def loop_parts(
    variant: Variant, models: SceneModels, task: RearrangementTask, fields: FieldLibrary, data_dir: Path | None
) -> LoopParts:
    """What a method's loop is made of; truths come to it when its world is there.

    Args:
        variant: of any method but foresight.
        models: ours, of the task's objects.
        task: of which a method is told the lights at most.
        fields: library of the fields.
        data_dir: whose files come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    overhead = Light(np.array([0.0, 0.0, 1.0]))
    match variant.method:
        case "overhead":
            return LoopParts(models, Estimators.with_known_lights(overhead, overhead))
        case "known_light":
            return LoopParts(models, Estimators.with_known_lights(task.start.light, task.goal.light))
        case "nerf":  # no light changes what its fields show, so none is looked for
            given = Estimators.with_known_lights(overhead, overhead)
            return LoopParts(with_nerfs(models, fields, data_dir), given)
        case "paper":
            stages = frozenset(STAGES) - variant.replaced
            estimators = PaperEstimators() if "estimation" in stages else Estimators()
            return LoopParts(with_paper_stages(models, stages, fields, data_dir), estimators)
        case _:
            return LoopParts(models, Estimators())


def told_truths(
    parts: LoopParts, truths: frozenset[TruthName], truth: Callable[[], SceneState], assets: AssetLibrary
) -> LoopParts:
    """The same with stages replaced by the truth; the goal's is the caller's matter.

    Args:
        parts: of our loop.
        truths: which.
        truth: tells the true state.
        assets: meshes for the simulator.
    """
    models, estimators = parts.models, parts.estimators
    if "dynamics" in truths:
        models = replace(models, dynamics=SimulatedModel(assets, tuple(models.shapes)))
    if "poses" in truths:
        estimators = TrueEstimators(estimators.first, estimators.later, estimators.goal, truth=truth)
    return LoopParts(models, estimators)
