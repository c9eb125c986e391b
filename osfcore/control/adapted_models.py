"""Models and pictures that agree: what the first frame tells of exposure, response, ambient light and table is kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from osfcore.control.goal import GoalImage
from osfcore.estimation.goal_image import estimate_goal
from osfcore.estimation.goal_refinement import GoalImageConfig
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.photometry.image_model import ImageModel
from osfcore.estimation.photometry.scaled_fields import adapted
from osfcore.estimation.steps import EstimateStep, all_but_last
from osfcore.geometry.states import Observation, SceneState


@dataclass(frozen=True, eq=False, slots=True)
class AdaptedModels:
    """Models of the objects in a scene, and how pictures are made to look as these do.

    Attributes:
        models: fields and table, with the scene's ambient light and albedo.
        image_model: of the pictures; None for those that fields were made for.
    """

    models: ObjectModels
    image_model: ImageModel | None = None

    def to(self, image_model: ImageModel | None, names: tuple[str, ...]) -> AdaptedModels:
        """These, which must not be adapted yet, for pictures of another kind.

        Args:
            image_model: of the pictures; None leaves everything as it is.
            names: of the objects that are needed.
        """
        return self if image_model is None else AdaptedModels(adapted(self.models, names, image_model), image_model)

    def normalized(self, observation: Observation) -> Observation:
        """Pictures as these models show them."""
        return observation if self.image_model is None else self.image_model.normalized(observation)

    def normalized_goal(self, goal: GoalImage) -> GoalImage:
        """A goal image likewise."""
        return goal if self.image_model is None else replace(goal, image=self.normalized(goal.observed(())).images[0])


def estimate_goal_image(
    usual: AdaptedModels,
    scene: AdaptedModels,
    goal: GoalImage,
    prior: SceneState,
    config: GoalImageConfig | None = None,
    shares: Mapping[str, float] | None = None,
) -> Iterator[EstimateStep]:
    """The goal image as the scene's cameras would take it and, should that be doubtful, as fields were made for.

    Args:
        usual: models that are not adapted.
        scene: models for the pictures of the first frame.
        goal: one view.
        prior: how the objects lie now.
        config: how much work to do.
        shares: by object, its residual in the first frame as a share of its level, see `goal_allowance`.
    """
    best = yield from all_but_last(_estimated(scene, goal, prior, config, shares))
    if scene.image_model is not None and not _is_trusted(best):
        yield replace(best, estimate=None)
        other = yield from all_but_last(_estimated(usual, goal, prior, config, shares))
        best = other if _is_trusted(other) else best
    yield best


def _estimated(
    fitting: AdaptedModels,
    goal: GoalImage,
    prior: SceneState,
    config: GoalImageConfig | None,
    shares: Mapping[str, float] | None,
) -> Iterator[EstimateStep]:
    seen = fitting.normalized_goal(goal).observed(prior.names)
    for step in estimate_goal(fitting.models, seen, prior, config, shares):
        yield step if step.estimate is None else replace(step, image_model=fitting.image_model)


def _is_trusted(step: EstimateStep) -> bool:
    return step.estimate is not None and step.estimate.trusted
