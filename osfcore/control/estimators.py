"""The estimators of a closed loop, its parts that can be replaced, and the models of its objects."""

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
    """The estimators of an episode. Derive from this class to replace some of them.

    Attributes:
        first: settings of the first frame.
        later: settings of all later frames.
        goal: settings of the goal image, and of the search for lost objects.
    """

    first: FirstFrameConfig = field(default_factory=FirstFrameConfig)
    later: TrackingConfig = field(default_factory=TrackingConfig)
    goal: GoalImageConfig = field(default_factory=GoalImageConfig)

    def first_frame(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator
    ) -> Iterator[EstimateStep]:
        """Estimate poses and light from the first frame, which has masks."""
        return estimate_first(models, observation, rng, self.first)

    def later_frame(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        usual: Float[np.ndarray, "N"] | None = None,
    ) -> Iterator[EstimateStep]:
        """Estimate poses and light from a frame without masks, starting at an expected state (see `estimate_next`)."""
        return estimate_next(models, observation, expected, rng, self.later, usual=usual)

    @staticmethod
    def with_known_lights(light: Light, goal_light: Light) -> Estimators:
        """Return estimators that estimate poses only, with known lights of the scene and the goal image."""
        held, goal_held = (tuple(float(x) for x in one.direction) for one in (light, goal_light))
        return Estimators(
            FirstFrameConfig(held_light=held),  # pyright: ignore[reportArgumentType]
            TrackingConfig(lamp_above=np.inf),
            GoalImageConfig(held_light=goal_held),  # pyright: ignore[reportArgumentType]
        )


ESTIMATOR = PartKind("estimator", ("first_frame", "later_frame"))


# Factories of estimators by name; they take the data directory.
ESTIMATORS: Mapping[str, Callable[[Path], Estimators]] = {"ours": lambda _data_dir: Estimators()}


@dataclass(frozen=True, slots=True)
class EpisodeParts:
    """Parts of an episode that can be replaced.

    Attributes:
        estimators: the estimators.
        planner: factory of the planner.
        cost: factory of the cost, called for each plan; None for the cost that the episode's settings name.

    Example:
        >>> parts = EpisodeParts(cost=lambda given: PoseCost(given.goal, arm_m=0))  # rotations do not count
    """

    estimators: Estimators = field(default_factory=Estimators)
    planner: Callable[[PlannerInputs], Planner] = mppi
    cost: Callable[[CostInputs], Cost] | None = None


# Models of an episode's objects: fields, dynamics, shapes, symmetries.


@dataclass(frozen=True, slots=True)
class SceneModels:
    """All models of the objects that an episode needs. `load_scene_models` makes them.

    Attributes:
        appearance: models of how the objects and the table look.
        dynamics: model of what pushes do, which the planner predicts with.
        pushes: learned dynamics model from which pushes are proposed. It may differ from `dynamics`.
        shapes: shapes of the objects, by name.
        symmetries: orientations of each object that look the same, by name; none for objects that are left out.

    Example:
        >>> scene_models = load_scene_models((name,), fields, assets, None)
        >>> scene_models.symmetries[name].kind
        'none'
    """

    appearance: ObjectModels
    dynamics: DynamicsModel
    pushes: PushModel
    shapes: Mapping[str, ObjectShape]
    symmetries: Mapping[str, Symmetry]


def load_scene_models(
    names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary, data_dir: Path | None, device: str = "cpu"
) -> SceneModels:
    """Load all models of some objects that an episode needs.

    Args:
        names: names of the objects.
        fields: library of their fields.
        assets: library of their symmetries.
        data_dir: DATA_DIR; its trained dynamics model and convex parts are used instead of the shipped ones.
        device: "cpu", or "cuda" for a GPU.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a file is broken.

    Example:
        >>> load_scene_models((name,), fields, assets, None).pushes.names
        ('006_mustard_bottle',)
    """
    shapes = load_shapes(data_dir, fields, names)
    pushes = PushModel(read_network(network_path(data_dir)), shapes, device)
    symmetries = {name: assets.info(name).symmetry for name in names}
    loaded, table = {name: fields.load(name) for name in names}, fields.load_table()
    appearance = ObjectModels(loaded, table, device=device, symmetries=symmetries)
    return SceneModels(appearance, pushes, pushes, shapes, symmetries)
