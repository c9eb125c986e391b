"""The first frame, whatever its pictures are like: exposure, response, ambient light and the table's colour are found.

Where the table looks as it is known (`check_table`), `osfcore.estimation.first_frame` does everything. Where no shadow
tells, it is asked first, and its answer taken if the loss at its end is low or the image model at its poses the usual
one: under a high lamp and beside one object exposure, ambient light and table explain each other. Otherwise an image
model is fitted first (`Calibrator`), with each object in the pose that fits its masks best at any brightness, once for
linear pictures and once for sRGB ones. What leaves less unexplained is tried first; the other one too if the loss at
its end is high or the estimate doubted: then the lower loss decides. Pictures and fields are made to agree, and the
usual estimator finds poses and lamp. From these the image model is searched for once more, and refined in turn with
poses and lamp (Gauss-Newton) until the lamp stands still.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.estimation.first_frame import FirstFrameConfig, check_masks, visible_part
from osfcore.estimation.first_frame import estimate_first as estimate_usual
from osfcore.estimation.objective import FINE_SIDE, ObjectModels, SceneParameters, views_of
from osfcore.estimation.photometry import Calibration, Calibrator, adapted
from osfcore.estimation.search import OVERHEAD, GaussNewtonState, StepReporter, check_table, gauss_newton, initial_poses
from osfcore.estimation.steps import EstimateStep, all_but_last
from osfcore.estimation.uncertainty import (
    AMBIGUOUS,
    estimate_with_uncertainty,
    evaluate_fit,
    expected_residuals,
    relative_allowance,
)
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.json_codec import Entry, decode, encode
from osfcore.io.scene_file import EstimateJson
from osfcore.progress import Progress

_COARSE_SIDE, _ROUGH_SIDE = FINE_SIDE // 2, FINE_SIDE // 4
_TINT = 0.1  # weight of the gains' spread over the colours: lamps are nearly white
_LEAST_GAIN, _MOST_GAIN = 0.05, 20.0  # beyond, pictures show nothing, or nothing else
_ROUNDS, _ITERATIONS = 3, 2  # of image model and poses in turn, at most; of Gauss-Newton in each
_STILL_RAD = np.deg2rad(1.0)  # a lamp that moves less in a round has been found
_SETTLED = 2e-4  # photometric loss; pictures decoded wrongly ended at 3e-4 and more


def estimate_first(
    models: ObjectModels, observation: Observation, rng: np.random.Generator, config: FirstFrameConfig | None = None
) -> Iterator[EstimateStep]:
    """Find all poses and the light; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one or more views with masks, of any exposure, linear or sRGB.
        rng: of the searches.
        config: how much work to do; under a held light pictures are taken for usual ones.

    Raises:
        InvalidInput: without masks, or if an object's masks are all empty.
        UnknownName: if an object has no field.
    """
    config = config or FirstFrameConfig()
    models.check(observation.names)
    check_masks(observation)
    can_adapt = models.can_change and config.held_light is None and len(observation.names) > 0
    verdict = check_table(models, views_of(observation, FINE_SIDE)).verdict if can_adapt else "usual"
    if verdict == "usual":
        yield from estimate_usual(models, observation, rng, config)
        return
    calibrator = Calibrator(models, observation.names)
    if verdict == "unclear":
        last = yield from all_but_last(estimate_usual(models, observation, rng, config))
        if _is_settled(last):
            yield last
            return
        assert last.estimate is not None
        params = SceneParameters.of(last.estimate.state, observation.pusher)
        views = views_of(observation, _COARSE_SIDE, samples=2)
        if calibrator.refine(views, params, 1.0, hold_light=True).model.is_usual:
            yield last
            return
    poses = _rough_poses(models, observation)
    both = (_calibrated(calibrator, observation, poses, encoding) for encoding in get_args(Encoding))
    found: list[EstimateStep] = []
    for one in sorted((one for one in both if one.is_sane), key=lambda one: one.loss):
        if found:  # and leaves much unexplained
            yield replace(found[0], estimate=None)
        found.append((yield from all_but_last(_steps(models, calibrator, one, rng, config))))
        if _is_settled(found[-1]):
            break
    if found:
        yield min(found, key=lambda last: (not _is_settled(last), last.loss))
    else:
        yield from estimate_usual(models, observation, rng, config)


def _is_settled(last: EstimateStep) -> bool:
    """Whether nothing speaks for another image model."""
    return last.loss < _SETTLED and last.estimate is not None and last.estimate.trusted


@dataclass(frozen=True, eq=False, slots=True)
class _Calibrated:
    """Pictures as a camera response makes them linear, and the image model that explains them."""

    encoding: Encoding
    observation: Observation
    found: Calibration

    @property
    def loss(self) -> float:
        return self.found.unexplained + _TINT * float(np.std(np.log(self.found.model.gain)))

    @property
    def is_sane(self) -> bool:
        gain = self.found.model.gain
        return bool(np.all((gain > _LEAST_GAIN) & (gain < _MOST_GAIN)))


def _rough_poses(models: ObjectModels, observation: Observation) -> SceneParameters:
    """Each object in the pose that fits its masks best, at any brightness; hardly the response's matter."""
    coarse = views_of(observation, _COARSE_SIDE)
    best = [initial_poses(models, name, visible_part(coarse, n)).best(1) for n, name in enumerate(observation.names)]
    positions, quaternions = (np.concatenate(a) for a in ([b.positions for b in best], [b.quaternions for b in best]))
    return SceneParameters(observation.names, positions, quaternions, OVERHEAD, observation.pusher)


def _calibrated(
    calibrator: Calibrator, observation: Observation, params: SceneParameters, encoding: Encoding
) -> _Calibrated:
    """The image model of pictures that are encoded so, from rough poses."""
    images = linear_from_encoded(observation.images, encoding).astype(np.float32)
    linear = replace(observation, images=images)
    found = calibrator.search(views_of(linear, _ROUGH_SIDE), views_of(linear, _COARSE_SIDE), params)
    return _Calibrated(encoding, linear, found)


def _steps(
    models: ObjectModels, calibrator: Calibrator, rough: _Calibrated, rng: np.random.Generator, config: FirstFrameConfig
) -> Iterator[EstimateStep]:
    """The usual estimator on pictures and models that agree, then both once more."""
    model, linear, more = rough.found.model, rough.observation, (_ROUNDS + 1) * _ITERATIONS
    usual = estimate_usual(adapted(models, linear.names, model), model.normalized(linear), rng, config)
    before = next(usual)
    for step in usual:
        progress = before.progress
        yield replace(before, progress=Progress(progress.done, progress.total + more, progress.note))
        before = step
    assert before.estimate is not None
    reporter = StepReporter(before.progress.total + more)
    reporter.done = before.progress.total - 1
    yield from _polished(models, calibrator, rough, before.estimate, reporter)


def _polished(
    models: ObjectModels, calibrator: Calibrator, rough: _Calibrated, estimate: EstimatedState, reporter: StepReporter
) -> Iterator[EstimateStep]:
    """Image model, poses and lamp in turn, until the lamp stands still.

    The image model is searched for once more first: the one that rough poses have led to may be far off.
    """
    linear = rough.observation
    at = GaussNewtonState.at(SceneParameters.of(estimate.state, linear.pusher))
    small, middle, fine = (views_of(linear, side, samples=2) for side in (_ROUGH_SIDE, _COARSE_SIDE, FINE_SIDE))
    found = calibrator.search(small, middle, at.params)
    for _ in range(_ROUNDS):
        before = at.params.light
        at = yield from _aligned(models, linear, found, at, reporter)
        if at.params.light @ before > np.cos(_STILL_RAD):
            break
        found = calibrator.refine(fine, at.params, found.model.ambient, hold_light=False)
    found = calibrator.refine(fine, at.params, found.model.ambient, hold_light=True)
    at = yield from _aligned(models, linear, found, at, reporter)
    model = replace(found.model, encoding=rough.encoding)
    sharp = views_of(found.model.normalized(linear), FINE_SIDE, samples=2)
    fit = evaluate_fit(adapted(models, linear.names, model), sharp, at.params)
    rivals = {n: 1.0 for n, doubt in enumerate(estimate.doubts) if doubt == AMBIGUOUS}
    sure = estimate_with_uncertainty(at.params, at.normals, fit, rivals, allowed=relative_allowance(fit))
    yield replace(reporter.finish(at, sure), image_model=model)


def _aligned(
    models: ObjectModels, linear: Observation, found: Calibration, at: GaussNewtonState, reporter: StepReporter
) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
    """Gauss-Newton on poses and lamp, from the calibration's lamp, with models and pictures made to agree by it."""
    fitting, normal = adapted(models, linear.names, found.model), found.model.normalized(linear)
    sharp, soft = (views_of(normal, side, samples=2) for side in (FINE_SIDE, _COARSE_SIDE))
    at = GaussNewtonState.at(replace(at.params, light=found.light))
    for step in gauss_newton(fitting, sharp, at, iterations=_ITERATIONS, light=soft):
        at = step
        yield reporter.refinement("Exposure and table", at)
    return at


# Estimates that were made beforehand, and whether they explain what is seen now as well as what was seen then.
#
# An example comes with the estimates of its first frame and of its goal image, so that it need not be looked at for
# half a minute. They are used only where they fit: residuals of the fields rendered there are compared with those
# of then.


_WORSE, _NOISE = 1.2, 0.004  # by how much a residual may exceed the former one: a factor, and [radiance]


@dataclass(frozen=True, eq=False, slots=True)
class PreparedLook:
    """An estimate and how well it explained the images that it was made from.

    Attributes:
        estimate: of poses and light.
        residuals: RMS of each object there [radiance], see `expected_residuals`.
    """

    estimate: EstimatedState
    residuals: Float[np.ndarray, "N"]

    @staticmethod
    def of(models: ObjectModels, observation: Observation, estimate: EstimatedState) -> PreparedLook:
        """What is known now of an observation, for later."""
        return PreparedLook(estimate, expected_residuals(models, observation, estimate.state))

    def explains(self, models: ObjectModels, observation: Observation) -> bool:
        """Whether it fits an observation of the same objects about as well as the one that it was made from."""
        state = self.estimate.state
        if state.names != observation.names:
            return False
        now = expected_residuals(models, observation, state)
        return bool(np.all(now <= _WORSE * self.residuals + _NOISE))


@dataclass(frozen=True, eq=False, slots=True)
class PreparedLooks:
    """What was found out beforehand about a table and its goal image.

    Attributes:
        first: of the first frame.
        goal: of the goal image.
    """

    first: PreparedLook
    goal: PreparedLook

    def step(self, look: str, models: ObjectModels, observation: Observation) -> EstimateStep | None:
        """The result of a look, "first" or "goal", if it explains what is seen; None if an estimator must find it."""
        prepared = self.first if look == "first" else self.goal
        if not prepared.explains(models, observation):
            return None
        estimate = prepared.estimate
        return EstimateStep(Progress(1, 1, "prepared with this example"), "done", estimate.state, estimate=estimate)


class _LookJson(Entry):
    estimate: EstimateJson
    residuals: list[float]

    def look(self) -> PreparedLook:
        estimate = self.estimate.estimate()
        if len(self.residuals) != len(estimate.state.names):
            raise InvalidInput("number of residuals", len(self.residuals), f"{len(estimate.state.names)}")
        return PreparedLook(estimate, np.array(self.residuals, float))


class _LooksJson(Entry):
    first: _LookJson
    goal: _LookJson


def prepared_to_json(prepared: PreparedLooks) -> dict[str, Any]:
    """As plain lists and numbers."""
    looks = {
        name: _LookJson(estimate=EstimateJson.of_estimate(look.estimate), residuals=look.residuals.round(6).tolist())
        for name, look in (("first", prepared.first), ("goal", prepared.goal))
    }
    return encode(_LooksJson(**looks))


def prepared_from_json(data: object) -> PreparedLooks:
    """Of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    looks = decode(_LooksJson, data, "prepared looks")
    return PreparedLooks(looks.first.look(), looks.goal.look())
