"""Estimates from goal images: one view without masks, of objects known by name, perhaps under another light.

1. The present scene is compared with the image. Objects that the image shows at their present poses stay.
2. Templates of the other objects are matched over the image, in their present resting orientations, since goals are
   mostly reached by pushing.
3. If doubts remain, templates of all objects are matched. Combinations of matches are ranked by their photometric loss
   under any light. Objects that are still doubtful are matched in other orientations (all in `hypotheses.py`).
4. Gauss-Newton refines the poses as in the first frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses import (
    SceneAssembly,
    TemplateMatches,
    compare_orientations,
    count_of_scenes,
    match_templates,
    reassign_poses,
    scene_errors,
    without_objects,
    yaw_hypotheses,
)
from osfcore.estimation.objective import FINE_SIDE, ObjectModels, SceneParameters, full_circle, loss_of, views_of
from osfcore.estimation.search import PLANAR_PARAMETERS, GaussNewtonState, StepReporter, gauss_newton, search_light
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.estimation.uncertainty import (
    SURE_RIVAL_RATIO,
    estimate_with_uncertainty,
    evaluate_fit,
    goal_allowance,
    misfits,
)
from osfcore.geometry.poses import Pose, quaternion_multiply, rotation_angle
from osfcore.geometry.states import EstimatedState, Observation, SceneState

_YAWS = 24
_MATCHES = 300
_SHOWN = 24
_BETTER = 0.98  # times the loss: what is less is no reason to look elsewhere
_ROUNDS = 2  # in which doubted objects are put where they were seen: the first may stand in the second's place
_FINE_PLANAR = 2  # iterations on fine images while objects stay flat on the table
_COMPARISONS, _TURNED_RAD = 2, np.deg2rad(30.0)
_BESIDE_M = 0.04


@dataclass(frozen=True, slots=True)
class GoalImageConfig:
    """Settings of `estimate_goal`.

    Attributes:
        side: longest side of the image that templates are matched in [px].
        planar_iterations: iterations of Gauss-Newton over position and yaw.
        free_iterations: iterations of Gauss-Newton over whole poses.
        widen_all: whether to match every object in all its resting orientations, and not only doubtful ones.
        held_light: unit vector toward a known light, which is then not estimated; None to estimate the light.
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
    shares: Mapping[str, float] | None = None,
) -> Iterator[EstimateStep]:
    """Estimate the poses and the light that one goal image shows.

    Args:
        models: models of the objects and the table.
        observation: one view without the pusher. Masks are ignored.
        prior: the present scene, or another guess. The resting orientations in it matter most; right positions and a
            right light save time.
        config: settings.
        shares: for each object, its residual in the present scene as a share of its brightness there, as
            `osfcore.estimation.uncertainty.relative_residuals` returns it.

    Returns:
        Steps of the search. The last one has `estimate`.

    Raises:
        InvalidInput: if there is more than one view, or the prior has other objects.
        UnknownName: if an object has no field.

    Example:
        >>> image = models.together.render(SceneBatch.of(state), [goal_camera()]).rgb[0, 0]
        >>> seen = GoalImage(goal_camera(), image).observed(state.names)
        >>> *_, last = estimate_goal(models, seen, prior=state)
        >>> error = last.estimate.state.pose(name).position - state.pose(name).position
        >>> bool(np.linalg.norm(error) < 0.003)  # [m]
        True
    """
    models.check(observation.names)
    if len(observation.cameras) != 1:
        raise InvalidInput("number of views of a goal", len(observation.cameras), "1")
    if set(prior.names) != set(observation.names):
        raise InvalidInput("objects of the prior", ", ".join(prior.names), ", ".join(observation.names))
    yield from _GoalImageEstimator(models, observation, prior, config or GoalImageConfig(), shares or {}).steps()


class _GoalImageEstimator:
    """One estimation; `steps` runs it."""

    def __init__(
        self,
        models: ObjectModels,
        observation: Observation,
        prior: SceneState,
        config: GoalImageConfig,
        shares: Mapping[str, float],
    ) -> None:
        self._models, self._config, self._prior = models, config, prior
        self._names = observation.names
        self._everything = range(len(observation.names))
        self._usual = np.array([shares.get(name, np.nan) for name in self._names])
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        self._middle = views_of(observation, FINE_SIDE // 2, samples=2)
        self._coarse = views_of(observation, FINE_SIDE // 2)
        self._rough = views_of(observation, FINE_SIDE // 4)
        self._slide = views_of(observation, config.side)
        self._is_held = config.held_light is not None
        self._light_views = None if self._is_held else self._middle  # in which the light is refined
        self._rivals: dict[int, float] = {}
        comparison = len(self._names) + config.free_iterations
        self._most_refinements = config.planar_iterations + _FINE_PLANAR + _COMPARISONS * comparison
        self._pass = count_of_scenes(len(self._names)) + self._most_refinements
        self._reporter = StepReporter(len(self._names) + _ROUNDS + self._most_refinements + 1)

    def steps(self) -> Iterator[EstimateStep]:
        at = yield from self._from_prior()
        if self._doubtful_objects(at):
            rivals = self._rivals
            other = yield from self._from_anywhere()
            at = self._better_of(at, other, rivals)
        yield self._reporter.finish(at, self._estimate(at, self._rivals))

    def _from_prior(self) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Keep objects that the image shows at their prior poses; match templates of the others."""
        params = self._relit(self._prior_guess())
        fit = evaluate_fit(self._models, self._fine, params)
        bad = misfits(fit, goal_allowance(fit, self._usual))
        matches = [TemplateMatches.none()] * len(self._names)
        params = without_objects(params, bad)
        behind = scene_errors(self._models, self._slide, params)
        for n in bad:
            matches[n] = self._match_prior_orientation(n, behind, params.light)
            yield self._step("orientations", f"{self._names[n]}: where it may be", params, matches)
        for _ in range(_ROUNDS if bad else 0):
            params = self._relit(reassign_poses(self._models, self._coarse, params, matches))
            yield self._step("together", "Objects that were moved", params, matches)
        at = yield from self._refined(params, matches, bad)
        return (yield from self._reassign(at, matches, bad))

    def _from_anywhere(self) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Match templates of all objects, and assemble scenes under any light."""
        self._reporter.total += len(self._names) + self._pass
        self._rivals = {}
        matches: list[TemplateMatches] = []
        for n, name in enumerate(self._names):
            matches.append(self._match_prior_orientation(n))
            yield self._step("orientations", f"{name}: where it may be", self._initial_guess(matches), matches)
        params = yield from self._assemble(self._initial_guess(matches), matches)
        at = yield from self._refined(params, matches, self._everything)
        at = yield from self._reassign(at, matches, self._everything)
        bad = self._doubtful_objects(at)
        if bad:
            at = yield from self._relocate_doubtful(at, bad, matches)
            bad = self._doubtful_objects(at)
        if bad:
            at = yield from self._widen_hypotheses(at, bad, matches)
        return at

    def _prior_guess(self) -> SceneParameters:
        poses = Pose.stacked([self._prior.pose(name) for name in self._names])
        held = self._config.held_light
        light = self._prior.light.direction if held is None else np.array(held)
        return SceneParameters(self._names, poses.position, poses.quaternion, light, None)

    def _relit(self, params: SceneParameters) -> SceneParameters:
        """Return the guess under the best light, if that fits better than its own light."""
        if self._is_held:
            return params
        other = replace(params, light=search_light(self._models, self._rough, self._coarse, params))
        return min(params, other, key=lambda one: loss_of(self._models, self._coarse, one))

    def _doubtful_objects(self, at: GaussNewtonState) -> list[int]:
        """Return the indices of objects that fit poorly, or whose pose the image does not determine."""
        if self._config.widen_all:
            return list(self._everything)
        sure = {n: ratio for n, ratio in self._rivals.items() if ratio >= SURE_RIVAL_RATIO}
        return [n for n, doubt in enumerate(self._estimate(at, sure).doubts) if doubt]

    def _relocate_doubtful(
        self, at: GaussNewtonState, bad: list[int], matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Match templates of doubtful objects again, where a rendering of the other objects does not explain the image.

        The estimated light gives the brightness of the table, so that grey objects differ from shadows.
        """
        self._reporter.total += len(bad) + 1 + self._most_refinements
        params = without_objects(at.params, bad)
        behind = scene_errors(self._models, self._slide, params)
        for n in bad:
            matches[n] = self._match_prior_orientation(n, behind, params.light)
            yield self._step("orientations", f"{self._names[n]}: in unexplained parts of the image", at.params, matches)
        for _ in range(_ROUNDS):
            params = reassign_poses(self._models, self._coarse, params, matches)
        yield self._step("together", "Doubted objects seen elsewhere", params, matches)
        at = yield from self._accept_if_better(at, params, matches, self._everything)
        return (yield from self._reassign(at, matches, self._everything))

    def _widen_hypotheses(
        self, at: GaussNewtonState, bad: list[int], matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Match templates of doubtful objects in all their resting orientations."""
        self._reporter.total += len(bad) + self._pass
        behind = scene_errors(self._models, self._coarse, without_objects(at.params, bad))
        for n in bad:
            name, resting = self._names[n], self._models.resting(self._names[n])
            matches[n] = match_templates(
                self._models, self._coarse, name, resting.quaternions, resting.origin_heights,
                most=2 * _MATCHES, behind=behind,
            )  # fmt: skip
            yield self._step("orientations", f"{name}: lying in any way", at.params, matches)
        params = yield from self._assemble(at.params, matches)
        at = yield from self._accept_if_better(at, params, matches, self._everything)
        return (yield from self._reassign(at, matches, self._everything))

    def _accept_if_better(
        self, at: GaussNewtonState, params: SceneParameters, matches: list[TemplateMatches], moved: Sequence[int]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Refine another guess; keep it if its loss is lower."""
        rivals = dict(self._rivals)
        other = yield from self._refined(params, matches, moved)
        return self._better_of(at, other, rivals)

    def _better_of(self, at: GaussNewtonState, other: GaussNewtonState, rivals: dict[int, float]) -> GaussNewtonState:
        """Return the guess with the lower loss, together with its rivals; the first one if both are equal."""
        here, there = (loss_of(self._models, self._fine, one.params) for one in (at, other))
        if there < here:
            return other
        self._rivals = rivals
        return at

    def _refined(
        self, params: SceneParameters, matches: list[TemplateMatches], moved: Sequence[int]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Refine positions and yaw on the table, then whole poses, by Gauss-Newton.

        Args:
            params: guess of the scene.
            matches: matches of each object. Those near the guess are compared with it.
            moved: indices of the objects whose positions and orientations are compared. The others are only refined.
        """
        at, note = GaussNewtonState.at(params), "On the table"
        for views, iterations in (self._middle, self._config.planar_iterations), (self._fine, _FINE_PLANAR):
            sweeps = gauss_newton(
                self._models, views, at,
                iterations=iterations, objects=moved, numbers=PLANAR_PARAMETERS, light=self._light_views,
            )  # fmt: skip
            at = yield from self._reporter.refinements(note, at, sweeps)
        for _ in range(_COMPARISONS):
            before = at.params.quaternions
            at = yield from self._compare_orientations(at, matches, moved)
            if rotation_angle(before, at.params.quaternions).max() < _TURNED_RAD:
                break  # no object was turned, so the others' losses have not changed
        return at

    def _compare_orientations(
        self, at: GaussNewtonState, matches: list[TemplateMatches], moved: Sequence[int]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Replace each object's orientation by a hypothesis of lower loss, if there is one; then refine whole poses.

        Matches nearby are tried as well, since a wrong orientation also shifts the position.
        """
        for n in moved:
            poses = matches[n].poses
            beside = poses[np.linalg.norm(poses.position - at.params.positions[n], axis=1) < _BESIDE_M]
            others = Pose.joined(yaw_hypotheses(self._models, at.params, n), beside)
            at, self._rivals[n] = compare_orientations(
                self._models, self._middle, self._fine, self._fine, at, n, others
            )
            yield self._reporter.refinement(f"{self._names[n]}: turned around", at)
        at, work = at.undamped(), self._config.free_iterations
        sweeps = gauss_newton(
            self._models, self._fine, at, iterations=work, light=self._light_views, until_settled=True
        )
        return (yield from self._reporter.refinements("Refining all poses", at, sweeps))

    def _estimate(self, at: GaussNewtonState, rivals: Mapping[int, float]) -> EstimatedState:
        """Return the estimate with its uncertainty. Heights are checked, since one view hardly shows depth.

        Args:
            at: where Gauss-Newton ended.
            rivals: for each object, ratio of the best loss of a different orientation to the loss of the chosen one.
        """
        fit, poses = evaluate_fit(self._models, self._fine, at.params), at.params.state().poses
        lowest = np.array([self._models.resting(name).lowest(poses[n]) for n, name in enumerate(self._names)])
        allowed = goal_allowance(fit, self._usual)
        return estimate_with_uncertainty(
            at.params, at.normals, fit, rivals, lowest=lowest, light_held=self._is_held, allowed=allowed
        )

    def _match_prior_orientation(
        self, n: int, behind: Float[np.ndarray, "h w"] | None = None, light: Float[np.ndarray, "3"] | None = None
    ) -> TemplateMatches:
        pose = self._prior.pose(self._names[n])
        quaternions = quaternion_multiply(full_circle(_YAWS), pose.quaternion[None])
        heights = np.full(_YAWS, pose.position[2])
        return match_templates(
            self._models, self._slide, self._names[n], quaternions, heights, most=_MATCHES, behind=behind, light=light
        )

    def _initial_guess(self, matches: list[TemplateMatches]) -> SceneParameters:
        """Return the best match of each object. Objects without a match are put out of view."""
        params = without_objects(self._prior_guess(), self._everything)
        for n, found in enumerate(matches):
            if len(found.scores):
                params = params.with_pose(n, found.poses[0])
        return params

    def _assemble(
        self, params: SceneParameters, matches: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the guess
        """Find the combination of matches with the lowest photometric loss."""
        for best, loss in SceneAssembly(self._models, self._rough, self._coarse, matches).scenes(params):
            params = best
            yield self._step("together", "Combining matches", params, matches, loss=loss)
        return params

    def _reassign(
        self, at: GaussNewtonState, matches: list[TemplateMatches], moved: Sequence[int]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Move objects to other matches if that lowers the loss after refinement.

        This leaves local minima, in which Gauss-Newton has moved an object behind another one or into its shadow.
        """
        params = reassign_poses(self._models, self._coarse, at.params, matches)
        here, there = (loss_of(self._models, self._coarse, one) for one in (at.params, params))
        if there > _BETTER * here:
            return at
        self._reporter.total += 1 + self._most_refinements
        yield self._step("together", "Objects seen elsewhere", params, matches)
        return (yield from self._accept_if_better(at, params, matches, moved))

    def _step(
        self,
        stage: Stage,
        note: str,
        params: SceneParameters,
        matches: list[TemplateMatches],
        loss: float = float("nan"),
    ) -> EstimateStep:
        return self._reporter.step(stage, note, params, [found.poses[:_SHOWN] for found in matches], loss=loss)
