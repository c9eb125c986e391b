"""How a closed loop estimates: its three estimators with their configurations; and its parts that can be replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.dynamics_model import DynamicsModel
from osfcore.dynamics.graph import read_network
from osfcore.dynamics.rollout import PushModel, load_shapes, network_path
from osfcore.dynamics.shapes import ObjectShape
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.estimation.goal_image import GoalImageConfig
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.states import Observation, SceneState
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.planning.costs import Cost
from osfcore.planning.parts import CostInputs, Planner, PlannerInputs, mppi
from osfcore.plugins import PartKind


@dataclass(frozen=True)
class Estimators:
    """The estimators of ours; others derive from it.

    Attributes:
        first: of the first frame.
        later: of all frames after it.
        goal: of the goal image, and of the search for lost objects.
    """

    first: FirstFrameConfig = field(default_factory=FirstFrameConfig)
    later: TrackingConfig = field(default_factory=TrackingConfig)
    goal: GoalImageConfig = field(default_factory=GoalImageConfig)

    def first_frame(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator
    ) -> Iterator[EstimateStep]:
        """Poses and light of the first frame, which has masks."""
        return estimate_first(models, observation, rng, self.first)

    def later_frame(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        usual: Float[np.ndarray, "N"] | None = None,
    ) -> Iterator[EstimateStep]:
        """Poses and light of a frame without masks, from the last estimate or what was predicted from it."""
        return estimate_next(models, observation, expected, rng, self.later, usual=usual)

    @staticmethod
    def with_known_lights(light: Light, goal_light: Light) -> Estimators:
        """Estimators of poses alone, which take the lights of scene and goal image for known."""
        held, goal_held = (tuple(float(x) for x in one.direction) for one in (light, goal_light))
        return Estimators(
            FirstFrameConfig(held_light=held),  # pyright: ignore[reportArgumentType]
            TrackingConfig(lamp_above=np.inf),
            GoalImageConfig(held_light=goal_held),  # pyright: ignore[reportArgumentType]
        )


ESTIMATOR = PartKind("estimator", ("first_frame", "later_frame"))


# By name, how to make estimators from the data directory.
ESTIMATORS: Mapping[str, Callable[[Path], Estimators]] = {"ours": lambda _data_dir: Estimators()}


@dataclass(frozen=True, slots=True)
class EpisodeParts:
    """Parts of a closed loop that can be replaced.

    Attributes:
        estimators: how everything is estimated.
        planner: makes what decides about actions.
        cost: makes what compares futures, anew for each plan; None for what the settings say.
    """

    estimators: Estimators = field(default_factory=Estimators)
    planner: Callable[[PlannerInputs], Planner] = mppi
    cost: Callable[[CostInputs], Cost] | None = None


# Models of an episode's objects: fields, dynamics, shapes, symmetries.


@dataclass(frozen=True, slots=True)
class SceneModels:
    """Models of the objects, loaded before the first image.

    Attributes:
        appearance: how objects and table look.
        dynamics: what pushes do.
        pushes: the network that proposals are drawn by, whatever predicts them.
        shapes: of the objects, by name.
        symmetries: which of their orientations look the same; none for those left out.
    """

    appearance: ObjectModels
    dynamics: DynamicsModel
    pushes: PushModel
    shapes: Mapping[str, ObjectShape]
    symmetries: Mapping[str, Symmetry]


def load_scene_models(
    names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary, data_dir: Path | None, device: str = "cpu"
) -> SceneModels:
    """Load the models of some objects.

    Args:
        names: of the objects.
        fields: library of their fields.
        assets: library of their symmetries.
        data_dir: whose weights and convex parts come before the installed ones.
        device: that computes.

    Raises:
        UnknownName: if one has no field.
        CorruptFile: if a file is broken.
    """
    shapes = load_shapes(data_dir, fields, names)
    pushes = PushModel(read_network(network_path(data_dir)), shapes, device)
    symmetries = {name: assets.info(name).symmetry for name in names}
    loaded, table = {name: fields.load(name) for name in names}, fields.load_table()
    appearance = ObjectModels(loaded, table, device=device, symmetries=symmetries)
    return SceneModels(appearance, pushes, pushes, shapes, symmetries)
