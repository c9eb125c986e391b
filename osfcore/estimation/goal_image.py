"""Goal images: one view, no masks, objects known by name, perhaps under another light than the scene.

Templates of each object are matched over the image (`template_matching`), first in the resting orientation that it has
now, since goals are mostly reached by pushing. Combinations of matches are ranked by their photometric loss
(`scene_assembly`), and the best is refined by Gauss-Newton as in the first frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses.orientation_hypotheses import compare_orientations, yaw_hypotheses
from osfcore.estimation.hypotheses.scene_assembly import (
    OUT_OF_VIEW,
    assemble_scene,
    count_of_scenes,
    reassign_poses,
    without_objects,
)
from osfcore.estimation.hypotheses.template_matching import TemplateMatches, match_templates, scene_errors
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import FINE_SIDE, views_of
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.objective.resting_orientations import yaw_quaternions
from osfcore.estimation.search.gauss_newton import PLANAR_PARAMETERS, GaussNewtonState, gauss_newton
from osfcore.estimation.step_reporter import StepReporter
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.estimation.uncertainty import estimate_with_uncertainty, evaluate_fit
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import Observation, SceneState

_YAWS = 24
_MATCHES = 300
_FINE_PLANAR = 2  # iterations on fine images while objects stay flat on the table
_SHOWN = 24
_COMPARISONS, _TURNED_RAD = 2, np.deg2rad(30.0)
_BESIDE_M = 0.04
_ROUNDS = 2  # in which doubted objects are put where they were seen: the first may stand in the second's place


@dataclass(frozen=True, slots=True)
class GoalImageConfig:
    """How much work a goal estimate is.

    Attributes:
        side: of the image that templates are slid over [px].
        planar_iterations: of Gauss-Newton over position and yaw.
        free_iterations: of Gauss-Newton over whole poses.
        widen_all: match every object again in all resting orientations, also where none is doubted.
        held_light: unit vector toward a light that is not estimated; None to estimate it.
    """

    side: int = FINE_SIDE
    planar_iterations: int = 5
    free_iterations: int = 8
    widen_all: bool = False
    held_light: tuple[float, float, float] | None = None


def estimate_goal(
    models: ObjectModels,
    observation: Observation,
    prior: SceneState,
    config: GoalImageConfig | None = None,
    allowed: Mapping[str, float] | None = None,
) -> Iterator[EstimateStep]:
    """Find poses and light of a goal image; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one view without the pusher; masks play no part.
        prior: how the objects lie now; where they lie plays no part.
        config: how much work to do.
        allowed: by object, the residual below which its images are not doubted, see `allowed_residuals`.

    Raises:
        InvalidInput: if there is more than one view, or the prior is of other objects.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    if len(observation.cameras) != 1:
        raise InvalidInput("number of views of a goal", len(observation.cameras), "1")
    if set(prior.names) != set(observation.names):
        raise InvalidInput("objects of the prior", ", ".join(prior.names), ", ".join(observation.names))
    yield from _GoalImageEstimator(models, observation, prior, config or GoalImageConfig(), allowed or {}).steps()


class _GoalImageEstimator:
    """One estimation; `steps` runs it."""

    def __init__(
        self,
        models: ObjectModels,
        observation: Observation,
        prior: SceneState,
        config: GoalImageConfig,
        allowed: Mapping[str, float],
    ) -> None:
        self._allowed = np.array([allowed.get(name, 0.0) for name in observation.names])
        self._models, self._config, self._prior = models, config, prior
        self._names = observation.names
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        self._middle = views_of(observation, FINE_SIDE // 2, samples=2)
        self._coarse = views_of(observation, FINE_SIDE // 2)
        self._rough = views_of(observation, FINE_SIDE // 4)
        self._slide = views_of(observation, config.side)
        self._light_views = self._middle if config.held_light is None else None  # in which the light is refined
        comparison = len(self._names) + config.free_iterations
        self._refinement = config.planar_iterations + _FINE_PLANAR + _COMPARISONS * comparison  # steps
        self._pass = count_of_scenes(len(self._names)) + self._refinement
        self._reporter = StepReporter(len(self._names) + self._pass + 1)
        self._rivals: dict[int, float] = {}

    def steps(self) -> Iterator[EstimateStep]:
        matches: list[TemplateMatches] = []
        for n, name in enumerate(self._names):
            matches.append(self._match_prior_orientation(n))
            yield self._step("orientations", f"{name}: where it may be", self._initial_guess(matches), matches)
        params = yield from self._assemble(self._initial_guess(matches), matches)
        at = yield from self._refine(params, matches)
        at = yield from self._reassign(at, matches)
        bad = self._doubtful_objects(at)
        if bad:
            at = yield from self._relocate_doubtful(at, bad, matches)
            bad = self._doubtful_objects(at)
        if bad:
            at = yield from self._widen_hypotheses(at, bad, matches)
        yield self._finish(at)

    def _doubtful_objects(self, at: GaussNewtonState) -> list[int]:
        """Objects whose fit is poor or whose orientation the image does not determine."""
        doubts = self._with_uncertainty(at, {}).doubts
        return [n for n, doubt in enumerate(doubts) if doubt or self._config.widen_all]

    def _relocate_doubtful(
        self, at: GaussNewtonState, bad: list[int], matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Match templates of doubted objects again, against the errors of a rendering of the other objects.

        Under the estimated light the table's brightness is known, so grey objects differ from its shadows.
        """
        self._reporter.total += len(bad) + 1 + self._refinement
        params = without_objects(at.params, bad)
        behind = scene_errors(self._models, self._slide, params)
        for n in bad:
            matches[n] = self._match_prior_orientation(n, behind)
            yield self._step("orientations", f"{self._names[n]}: in what is unexplained", at.params, matches)
        for _ in range(_ROUNDS):
            params = reassign_poses(self._models, self._coarse, params, matches)
        yield self._step("together", "Doubted objects seen elsewhere", params, matches)
        at = yield from self._accept_if_better(at, params, matches)
        return (yield from self._reassign(at, matches))

    def _widen_hypotheses(
        self, at: GaussNewtonState, bad: list[int], matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Match templates of doubted objects in all of their resting orientations."""
        self._reporter.total += len(bad) + self._pass
        behind = scene_errors(self._models, self._coarse, without_objects(at.params, bad))
        for n in bad:
            matches[n] = self._match_any_orientation(n, behind)
            yield self._step("orientations", f"{self._names[n]}: lying in any way", at.params, matches)
        params = yield from self._assemble(at.params, matches)
        at = yield from self._accept_if_better(at, params, matches)
        return (yield from self._reassign(at, matches))

    def _accept_if_better(
        self, at: GaussNewtonState, params: SceneParameters, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Refine another guess; keep the result if its loss is lower."""
        rivals = dict(self._rivals)
        other = yield from self._refine(params, matches)
        if other.losses[-1] < at.losses[-1]:
            return other
        self._rivals = rivals
        return at

    def _match_prior_orientation(self, n: int, behind: Float[np.ndarray, "h w"] | None = None) -> TemplateMatches:
        pose = self._prior.pose(self._names[n])
        turns = yaw_quaternions(np.arange(_YAWS) * 2 * np.pi / _YAWS)
        quaternions = quaternion_multiply(turns, pose.quaternion[None])
        heights = np.full(_YAWS, pose.position[2])
        return match_templates(
            self._models, self._slide, self._names[n], quaternions, heights, most=_MATCHES, behind=behind
        )

    def _match_any_orientation(self, n: int, behind: Float[np.ndarray, "h w"]) -> TemplateMatches:
        resting = self._models.resting(self._names[n])
        heights = resting.heights - rotate(resting.quaternions, resting.centre)[:, 2]
        return match_templates(
            self._models, self._coarse, self._names[n], resting.quaternions, heights, most=2 * _MATCHES, behind=behind
        )

    def _initial_guess(self, matches: list[TemplateMatches]) -> SceneParameters:
        """The best match of each object; objects without one are out of view."""
        count = len(self._names)
        positions, quaternions = np.tile(OUT_OF_VIEW.position, (count, 1)), np.tile(OUT_OF_VIEW.quaternion, (count, 1))
        for n, found in enumerate(matches):
            if len(found.scores):
                positions[n], quaternions[n] = found.positions[0], found.quaternions[0]
        held = self._config.held_light
        light = self._prior.light.direction if held is None else np.array(held)
        return SceneParameters(self._names, positions, quaternions, light, None)

    def _assemble(
        self, params: SceneParameters, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the guess
        """The combination of matches with the lowest photometric loss."""
        for step in assemble_scene(self._models, self._rough, self._coarse, params, matches):
            params, loss = step
            yield self._step("together", "Which matches explain the image together", params, matches, loss=loss)
        return params

    def _refine(
        self, params: SceneParameters, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Gauss-Newton over positions and yaw on the table, then over whole poses."""
        at = GaussNewtonState.at(params)
        for views, numbers, iterations in (
            (self._middle, PLANAR_PARAMETERS, self._config.planar_iterations),
            (self._fine, PLANAR_PARAMETERS, _FINE_PLANAR),
        ):
            for step in gauss_newton(
                self._models, views, at, iterations=iterations, numbers=numbers, light=self._light_views
            ):
                at = step
                yield self._reporter.refinement("On the table", at)
        for _ in range(_COMPARISONS):
            before = at.params.quaternions
            at = yield from self._compare_orientations(at, matches)
            if rotation_angle(before, at.params.quaternions).max() < _TURNED_RAD:
                break  # no object was turned, so the others' losses have not changed
        return at

    def _reassign(
        self, at: GaussNewtonState, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Move objects to other matches of theirs if that lowers the loss after refinement.

        Gauss-Newton may have drawn an object into another's shadow or behind it, a local minimum.
        """
        params = reassign_poses(self._models, self._coarse, at.params, matches)
        if params is at.params:
            return at
        self._reporter.total += 1 + self._refinement
        yield self._step("together", "Objects seen elsewhere", params, matches)
        return (yield from self._accept_if_better(at, params, matches))

    def _compare_orientations(
        self, at: GaussNewtonState, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Replace each object's orientation by any hypothesis of lower loss, then refine all six degrees of freedom.

        A wrong orientation also shifts the position, so matches nearby are tried as well.
        """
        for n, name in enumerate(self._names):
            beside = matches[n].within(at.params.positions[n], _BESIDE_M)
            others = Pose.joined(yaw_hypotheses(self._models, at.params, n), beside.poses)
            at, self._rivals[n] = compare_orientations(
                self._models, self._middle, self._fine, self._fine, at, n, others
            )
            yield self._reporter.refinement(f"{name}: the other way round", at)
        at = replace(at, dampings=GaussNewtonState.at(at.params).dampings)
        sweeps = self._config.free_iterations
        for step in gauss_newton(
            self._models, self._fine, at, iterations=sweeps, light=self._light_views, until_settled=True
        ):
            at = step
            yield self._reporter.refinement("The last millimetres", at)
        return at

    def _finish(self, at: GaussNewtonState) -> EstimateStep:
        estimate = self._with_uncertainty(at, self._rivals)
        return self._reporter.finish(at, estimate)

    def _with_uncertainty(self, at: GaussNewtonState, rivals: dict[int, float]) -> EstimatedState:
        """The estimate with its uncertainty; heights are checked, since one view hardly shows depth."""
        fit, poses = evaluate_fit(self._models, self._fine, at.params), at.params.state().poses
        lowest = np.array([self._models.resting(name).lowest(poses[n]) for n, name in enumerate(self._names)])
        held = self._config.held_light is not None
        return estimate_with_uncertainty(
            at.params, at.normals, fit, rivals, lowest=lowest, light_held=held, allowed=self._allowed
        )

    def _step(
        self,
        stage: Stage,
        note: str,
        params: SceneParameters,
        matches: list[TemplateMatches],
        loss: float = float("nan"),
    ) -> EstimateStep:
        return self._reporter.step(stage, note, params, [found.poses[:_SHOWN] for found in matches], loss=loss)
