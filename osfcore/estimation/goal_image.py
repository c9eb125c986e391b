"""Goal images: one view, no masks, objects known by name, perhaps under another light than the scene.

Nothing says where the objects are, so templates are slid over the image (`sliding`), first of each object as it lies
now, since goals are mostly reached by pushing. Scenes are put together from the sightings (`assembly`), and the best is
refined as in the first frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses.orientation_hypotheses import compare_orientations, turned
from osfcore.estimation.hypotheses.scene_assembly import AWAY, assembled, count_of_scenes, reseated, without
from osfcore.estimation.hypotheses.template_matching import TemplateMatches, match_templates, scene_errors
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import FINE_SIDE, views_of
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.objective.resting_orientations import about_z
from osfcore.estimation.search.gauss_newton import PLANAR_PARAMETERS, GaussNewtonState, gauss_newton
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.estimation.uncertainty import gather, judged
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import Observation, SceneState
from osfcore.progress import Progress

_YAWS = 24
_SIGHTINGS = 300
_FINE_PLANAR = 2  # iterations on fine images while objects stay flat on the table
_SHOWN = 24
_CHALLENGES, _TURNED_RAD = 2, np.deg2rad(30.0)
_BESIDE_M = 0.04
_ROUNDS = 2  # in which doubted objects are put where they were seen: the first may stand in the second's place


@dataclass(frozen=True, slots=True)
class GoalImageConfig:
    """How much work a goal estimate is.

    Attributes:
        side: of the image that templates are slid over [px].
        planar_iterations: of the descent while objects stay flat on the table.
        free_iterations: of the descent over whole poses.
        widen_all: look again for every object, and in every way it can lie, also where none is doubted.
    """

    side: int = FINE_SIDE
    planar_iterations: int = 5
    free_iterations: int = 8
    widen_all: bool = False


def estimate_goal(
    models: ObjectModels, observation: Observation, prior: SceneState, effort: GoalImageConfig | None = None
) -> Iterator[EstimateStep]:
    """Find poses and light of a goal image; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one view without the pusher; masks play no part.
        prior: how the objects lie now; where they lie plays no part.
        effort: how much work to do.

    Raises:
        InvalidInput: if there is more than one view, or the prior is of other objects.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    if len(observation.cameras) != 1:
        raise InvalidInput("number of views of a goal", len(observation.cameras), "1")
    if set(prior.names) != set(observation.names):
        raise InvalidInput("objects of the prior", ", ".join(prior.names), ", ".join(observation.names))
    yield from _Goal(models, observation, prior, effort or GoalImageConfig()).steps()


class _Goal:
    """The state of one estimation between its steps."""

    def __init__(
        self, models: ObjectModels, observation: Observation, prior: SceneState, effort: GoalImageConfig
    ) -> None:
        self._models, self._effort, self._prior = models, effort, prior
        self._names = observation.names
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        self._middle = views_of(observation, FINE_SIDE // 2, samples=2)
        self._coarse = views_of(observation, FINE_SIDE // 2)
        self._rough = views_of(observation, FINE_SIDE // 4)
        self._slide = views_of(observation, effort.side)
        self._done = 0
        challenge = len(self._names) + effort.free_iterations
        self._descent = effort.planar_iterations + _FINE_PLANAR + _CHALLENGES * challenge
        self._pass = count_of_scenes(len(self._names)) + self._descent
        self._total = len(self._names) + self._pass + 1
        self._rivals: dict[int, float] = {}

    def steps(self) -> Iterator[EstimateStep]:
        sightings: list[TemplateMatches] = []
        for n, name in enumerate(self._names):
            sightings.append(self._as_it_lies(n))
            yield self._step("orientations", f"{name}: where it may be", self._first(sightings), sightings)
        guess = yield from self._assemble(self._first(sightings), sightings)
        at = yield from self._descend(guess, sightings)
        at = yield from self._reseat(at, sightings)
        bad = self._doubtful(at)
        if bad:
            at = yield from self._look_again(at, bad, sightings)
            bad = self._doubtful(at)
        if bad:
            at = yield from self._widen(at, bad, sightings)
        yield self._finish(at)

    def _doubtful(self, at: GaussNewtonState) -> list[int]:
        """Objects that do not fit, or hide where nothing tells how they lie."""
        doubts = self._judged(at, {}).doubts
        return [n for n, doubt in enumerate(doubts) if doubt or self._effort.widen_all]

    def _look_again(
        self, at: GaussNewtonState, bad: list[int], sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the Descent
        """Doubted objects are looked for in what the others leave unexplained, now that the light is known.

        Then a bare table is not free to be any grey, and what is as grey as a shadow stands out.
        """
        self._total += len(bad) + 1 + self._descent
        guess = without(at.guess, bad)
        behind = scene_errors(self._models, self._slide, guess)
        for n in bad:
            sightings[n] = self._as_it_lies(n, behind)
            yield self._step("orientations", f"{self._names[n]}: in what is unexplained", at.guess, sightings)
        for _ in range(_ROUNDS):
            guess = reseated(self._models, self._coarse, guess, sightings)
        yield self._step("together", "Doubted objects seen elsewhere", guess, sightings)
        at = yield from self._better(at, guess, sightings)
        return (yield from self._reseat(at, sightings))

    def _widen(
        self, at: GaussNewtonState, bad: list[int], sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the Descent
        """Doubted objects are looked for in every way they can lie."""
        self._total += len(bad) + self._pass
        behind = scene_errors(self._models, self._coarse, without(at.guess, bad))
        for n in bad:
            sightings[n] = self._any_way(n, behind)
            yield self._step("orientations", f"{self._names[n]}: lying in any way", at.guess, sightings)
        guess = yield from self._assemble(at.guess, sightings)
        at = yield from self._better(at, guess, sightings)
        return (yield from self._reseat(at, sightings))

    def _better(
        self, at: GaussNewtonState, guess: SceneParameters, sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the Descent
        """The descent from another guess, if it ends lower."""
        rivals = dict(self._rivals)
        other = yield from self._descend(guess, sightings)
        if other.losses[-1] < at.losses[-1]:
            return other
        self._rivals = rivals
        return at

    def _as_it_lies(self, n: int, behind: Float[np.ndarray, "h w"] | None = None) -> TemplateMatches:
        pose = self._prior.pose(self._names[n])
        turns = about_z(np.arange(_YAWS) * 2 * np.pi / _YAWS)
        quaternions = quaternion_multiply(turns, pose.quaternion[None])
        heights = np.full(_YAWS, pose.position[2])
        return match_templates(
            self._models, self._slide, self._names[n], quaternions, heights, most=_SIGHTINGS, behind=behind
        )

    def _any_way(self, n: int, behind: Float[np.ndarray, "h w"]) -> TemplateMatches:
        resting = self._models.resting(self._names[n])
        heights = resting.heights - rotate(resting.quaternions, resting.centre)[:, 2]
        return match_templates(
            self._models, self._coarse, self._names[n], resting.quaternions, heights, most=2 * _SIGHTINGS, behind=behind
        )

    def _first(self, sightings: list[TemplateMatches]) -> SceneParameters:
        """The best sighting of each object; those not seen, or not looked for yet, are away."""
        count = len(self._names)
        positions, quaternions = np.tile(AWAY.position, (count, 1)), np.tile(AWAY.quaternion, (count, 1))
        for n, found in enumerate(sightings):
            if len(found.scores):
                positions[n], quaternions[n] = found.positions[0], found.quaternions[0]
        return SceneParameters(self._names, positions, quaternions, self._prior.light.direction, None)

    def _assemble(
        self, guess: SceneParameters, sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the guess
        """The sightings that explain the image together."""
        for step in assembled(self._models, self._rough, self._coarse, guess, sightings):
            guess, loss = step
            yield self._step("together", "Which sightings explain the image together", guess, sightings, loss=loss)
        return guess

    def _descend(
        self, guess: SceneParameters, sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the last Descent
        e = self._effort
        at = GaussNewtonState.at(guess)
        for views, numbers, iterations in (
            (self._middle, PLANAR_PARAMETERS, e.planar_iterations),
            (self._fine, PLANAR_PARAMETERS, _FINE_PLANAR),
        ):
            for step in gauss_newton(
                self._models, views, at, iterations=iterations, numbers=numbers, light=self._middle
            ):
                at = step
                yield self._polishing("On the table", at)
        for _ in range(_CHALLENGES):
            before = at.guess.quaternions
            at = yield from self._challenge(at, sightings)
            if rotation_angle(before, at.guess.quaternions).max() < _TURNED_RAD:
                break  # nobody was turned round, so nobody else looks different now
        return at

    def _reseat(
        self, at: GaussNewtonState, sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the Descent
        """Objects where they were seen instead, if that explains the image better.

        A descent may have drawn an object into another's shadow or behind it, where it explains little and spoils
        little, while the place where it stands goes unexplained.
        """
        guess = reseated(self._models, self._coarse, at.guess, sightings)
        if guess is at.guess:
            return at
        self._total += 1 + self._descent
        yield self._step("together", "Objects seen elsewhere", guess, sightings)
        return (yield from self._better(at, guess, sightings))

    def _challenge(
        self, at: GaussNewtonState, sightings: list[TemplateMatches]
    ) -> Iterator[EstimateStep]:  # returns the Descent
        """Turn each object round where that explains the image better, and descend over whole poses.

        An object that is turned wrongly was drawn aside by that, so its sightings nearby are tried as well.
        """
        for n, name in enumerate(self._names):
            beside = sightings[n].near(at.guess.positions[n], _BESIDE_M)
            others = Pose.joined(turned(self._models, at.guess, n), beside.poses)
            at, self._rivals[n] = compare_orientations(
                self._models, self._middle, self._fine, self._fine, at, n, others
            )
            yield self._polishing(f"{name}: the other way round", at)
        at = replace(at, dampings=GaussNewtonState.at(at.guess).dampings)
        sweeps = self._effort.free_iterations
        for step in gauss_newton(
            self._models, self._fine, at, iterations=sweeps, light=self._middle, until_settled=True
        ):
            at = step
            yield self._polishing("The last millimetres", at)
        return at

    def _finish(self, at: GaussNewtonState) -> EstimateStep:
        estimate = self._judged(at, self._rivals)
        self._done = self._total - 1
        step = self._polishing("Done" if estimate.trusted else estimate.reason, at)
        return replace(step, stage="done", estimate=estimate)

    def _judged(self, at: GaussNewtonState, rivals: dict[int, float]) -> EstimatedState:
        """One view hardly tells how far away an object is; that it stands on the table does."""
        evidence, poses = gather(self._models, self._fine, at.guess), at.guess.state().poses
        lowest = np.array([self._models.resting(name).lowest(poses[n]) for n, name in enumerate(self._names)])
        return judged(at.guess, at.normals, evidence, rivals, lowest=lowest)

    def _polishing(self, note: str, at: GaussNewtonState) -> EstimateStep:
        return self._step("polish", note, at.guess, losses=at.losses[:-1].tolist(), loss=float(at.losses[-1]))

    def _step(
        self,
        stage: Stage,
        note: str,
        guess: SceneParameters,
        shown: list[TemplateMatches] | None = None,
        losses: list[float] | None = None,
        loss: float = float("nan"),
    ) -> EstimateStep:
        self._done = min(self._done + 1, self._total)
        candidates = None
        if shown and len(shown) == len(self._names):
            count = min(_SHOWN, *(len(s.scores) for s in shown))
            candidates = Pose(
                np.stack([s.positions[:count] for s in shown], 1), np.stack([s.quaternions[:count] for s in shown], 1)
            )
        progress = Progress(self._done, self._total, note)
        return EstimateStep(progress, stage, guess.state(), candidates, None, 1.0, tuple(losses or ()), loss)
