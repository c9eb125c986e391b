"""Refinement of one guess of a goal image by Gauss-Newton, with the comparison of orientations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from osfcore.estimation.hypotheses.orientation_hypotheses import compare_orientations, yaw_hypotheses
from osfcore.estimation.hypotheses.template_matching import TemplateMatches
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import FINE_SIDE, views_of
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.search.gauss_newton import PLANAR_PARAMETERS, GaussNewtonState, gauss_newton
from osfcore.estimation.step_reporter import StepReporter
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.uncertainty import (
    SURE_RIVAL_RATIO,
    estimate_with_uncertainty,
    evaluate_fit,
    goal_allowance,
    misfits,
)
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import Observation

_FINE_PLANAR = 2  # iterations on fine images while objects stay flat on the table
_COMPARISONS, _TURNED_RAD = 2, np.deg2rad(30.0)
_BESIDE_M = 0.04


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


class GoalRefinement:
    """Refines guesses of one image.

    Args:
        models: fields of the objects and the table.
        observation: one view.
        config: how much work to do.
        usual: by object, what is usual for its residual, see `goal_allowance`; what is left out is not known.
    """

    def __init__(
        self, models: ObjectModels, observation: Observation, config: GoalImageConfig, usual: Mapping[str, float]
    ) -> None:
        self.models = models
        self.fine = views_of(observation, FINE_SIDE, samples=2)
        self.middle = views_of(observation, FINE_SIDE // 2, samples=2)
        self.rivals: dict[int, float] = {}
        self._usual = np.array([usual.get(name, np.nan) for name in observation.names])
        self._names, self._config = observation.names, config
        self._is_held = config.held_light is not None
        self._light_views = None if self._is_held else self.middle  # in which the light is refined

    @property
    def steps(self) -> int:
        """How many a refinement may take."""
        comparison = len(self._names) + self._config.free_iterations
        return self._config.planar_iterations + _FINE_PLANAR + _COMPARISONS * comparison

    def refined(
        self, params: SceneParameters, matches: Sequence[TemplateMatches], moved: Sequence[int], reporter: StepReporter
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Gauss-Newton over positions and yaw on the table, then over whole poses; returns where it ended.

        Args:
            params: the guess.
            matches: of each object; those nearby are compared.
            moved: numbers of the objects whose places and orientations are in question; the others are only refined.
            reporter: of the steps.
        """
        at = GaussNewtonState.at(params)
        for views, numbers, iterations in (
            (self.middle, PLANAR_PARAMETERS, self._config.planar_iterations),
            (self.fine, PLANAR_PARAMETERS, _FINE_PLANAR),
        ):
            for step in gauss_newton(
                self.models, views, at, iterations=iterations, objects=moved, numbers=numbers, light=self._light_views
            ):
                at = step
                yield reporter.refinement("On the table", at)
        for _ in range(_COMPARISONS):
            before = at.params.quaternions
            at = yield from self._compare_orientations(at, matches, moved, reporter)
            if rotation_angle(before, at.params.quaternions).max() < _TURNED_RAD:
                break  # no object was turned, so the others' losses have not changed
        return at

    def _compare_orientations(
        self, at: GaussNewtonState, matches: Sequence[TemplateMatches], moved: Sequence[int], reporter: StepReporter
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Replace each object's orientation by any hypothesis of lower loss, then refine all six degrees of freedom.

        A wrong orientation also shifts the position, so matches nearby are tried as well.
        """
        for n in moved:
            beside = matches[n].within(at.params.positions[n], _BESIDE_M)
            others = Pose.joined(yaw_hypotheses(self.models, at.params, n), beside.poses)
            at, self.rivals[n] = compare_orientations(self.models, self.middle, self.fine, self.fine, at, n, others)
            yield reporter.refinement(f"{self._names[n]}: the other way round", at)
        at = replace(at, dampings=GaussNewtonState.at(at.params).dampings)
        sweeps = self._config.free_iterations
        for step in gauss_newton(
            self.models, self.fine, at, iterations=sweeps, light=self._light_views, until_settled=True
        ):
            at = step
            yield reporter.refinement("The last millimetres", at)
        return at

    def doubted(self, at: GaussNewtonState) -> list[int]:
        """Numbers of the objects whose fit is poor, or whose pose the image does not determine."""
        sure = {n: ratio for n, ratio in self.rivals.items() if ratio >= SURE_RIVAL_RATIO}
        return [n for n, doubt in enumerate(self.estimate(at, sure).doubts) if doubt]

    def misfits(self, params: SceneParameters) -> list[int]:
        """Numbers of the objects that the image does not show where a guess has them."""
        fit = evaluate_fit(self.models, self.fine, params)
        return misfits(fit, goal_allowance(fit, self._usual))

    def estimate(self, at: GaussNewtonState, rivals: Mapping[int, float]) -> EstimatedState:
        """The estimate with its uncertainty; heights are checked, since one view hardly shows depth.

        Args:
            at: where Gauss-Newton ended.
            rivals: by object, the best loss of a different orientation over the loss of the one chosen.
        """
        fit, poses = evaluate_fit(self.models, self.fine, at.params), at.params.state().poses
        lowest = np.array([self.models.resting(name).lowest(poses[n]) for n, name in enumerate(self._names)])
        allowed = goal_allowance(fit, self._usual)
        return estimate_with_uncertainty(
            at.params, at.normals, fit, rivals, lowest=lowest, light_held=self._is_held, allowed=allowed
        )
