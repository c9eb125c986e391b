"""The job that estimates poses and light from an observation: reported step by step, with all steps kept in a file.

Its inputs lie in the job's folder: `inputs/observation`, and `inputs/prior.json` where an earlier estimate is needed.
It leaves `steps.jsonl`, one line a step, and `state.json`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.estimation.steps import EstimateStep
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import Observation, SceneState
from osfcore.io.files import writing
from osfcore.io.json_codec import decode
from osfcore.io.scene_file import StateJson, read_estimated, state_to_json, write_estimated
from osfcore.paper.method import Method
from osfcore.random_streams import Stream, stream_rng

from ..job import INPUTS
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from osfcore.estimation.objective import ObjectModels

    from ..context import JobContext

Mode = Literal["first", "next", "goal"]
OBSERVATION, PRIOR, TRUTH = "observation", "prior.json", "truth.json"
STEPS, STATE = "steps.jsonl", "state.json"


class Source(JobParams):
    """Where an observation came from: a scene as it was, or a file that was sent."""

    scene: str | None
    revision: int | None = None
    file_name: str | None = None


class EstimateParams(JobParams):
    """What is estimated, and how; earlier versions had one method."""

    mode: Mode
    method: Method = "ours"
    seed: int
    of: Source
    names: tuple[str, ...]
    cameras: tuple[str, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Estimating:
    """How far an estimate is.

    Attributes:
        done: units finished.
        total: units in all.
        note: what is being done, for a person.
        step: how many steps there were.
        stage: which part of the method is at work; None before the first step.
        losses: of each object, in the units of the stage.
        loss: of the whole, likewise; None where only the objects are looked at.
        trusted: whether the result may be acted on; None until it is there.
        view: the step itself.
    """

    done: int
    total: int
    note: str
    step: int = 0
    stage: str | None = None
    losses: tuple[float | None, ...] = ()
    loss: float | None = None
    trusted: bool | None = None
    view: EstimateStep | None = None


def estimate_job(params: EstimateParams, place: JobContext) -> Iterator[Estimating]:
    """Estimate what was observed.

    Raises:
        OsfError: if the observation does not fit the mode, an object has no field, or the disk refuses.
    """
    from osfcore.io.observation_file import read_observation

    yield Estimating(0, 0, "Loading fields, half a minute the first time")
    inputs = place.folder / INPUTS
    observation = read_observation(inputs / OBSERVATION)
    prior = None if params.mode == "first" else read_estimated(inputs / PRIOR).state
    models = load_models(place.data_dir, observation.names, params.method)
    rng = stream_rng(params.seed, Stream.FIRST_FRAME)
    for number, step in enumerate(steps_of(params.mode, models, observation, prior, rng, params.method), 1):
        trusted = None if step.estimate is None else step.estimate.trusted
        losses, loss = tuple(_number(loss) for loss in step.losses), _number(step.loss)
        at = step.progress
        progress = Estimating(at.done, at.total, at.note, number, step.stage, losses, loss, trusted, step)
        _keep(place.folder / STEPS, progress, step.state)
        if step.estimate is not None:
            write_estimated(place.folder / STATE, step.estimate)
        yield progress


def load_models(data_dir: Path, names: tuple[str, ...], method: Method = "ours") -> ObjectModels:
    """The fields of some objects and the table, ready to be rendered.

    Args:
        data_dir: whose fields come before the installed ones.
        names: of the objects.
        method: whose fields, ours or those as published.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a field is broken.
    """
    from osfcore.estimation.objective import ObjectModels

    library = FieldLibrary(data_dir)
    if method == "paper":
        from osfcore.paper.stages import load_paper_appearance

        return load_paper_appearance(names, library, data_dir)
    return ObjectModels({name: library.load(name) for name in names}, library.load_table())


def steps_of(
    mode: Mode,
    models: ObjectModels,
    observation: Observation,
    prior: SceneState | None,
    rng: np.random.Generator,
    method: Method = "ours",
) -> Iterator[EstimateStep]:
    """The estimator that a mode asks for, which begins to work when its first step is taken.

    Args:
        mode: "next" or "goal"; without a prior it plays no part.
        models: fields of the objects and the table.
        observation: with masks for a first frame; of one view for a goal.
        prior: where "next" begins, or how the objects of a goal lie now; None for a first frame.
        rng: of the searches; a goal needs none.
        method: ours, or CMA-ES alone as published.

    Raises:
        InvalidInput: for a goal as published, which only compares goal images with renderings.
    """
    check_method(mode, method)
    if method == "paper":
        from osfcore.paper.stages import PaperEstimators as Estimators
    else:
        from osfcore.control.estimators import Estimators

    estimators = Estimators()
    if prior is None:
        return estimators.first_frame(models, observation, rng)
    if mode == "goal":
        from osfcore.estimation.goal_image import estimate_goal

        return estimate_goal(models, observation, prior)
    return estimators.later_frame(models, observation, prior, rng)


def check_method(mode: Mode, method: Method) -> None:
    """Refuse a mode that a method does not have.

    Raises:
        InvalidInput: for a goal as published, which only compares goal images with renderings.
    """
    if mode == "goal" and method == "paper":
        allowed = "ours for a goal image: the paper compares it with renderings and never estimates it"
        raise InvalidInput("method", method, allowed)


def read_steps(path: Path) -> tuple[dict[str, Any], ...]:
    """What was reported of each step so far, with "guess", a scene without cameras; nothing before the first one.

    Raises:
        CorruptFile: if the file is damaged.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1]  # the last one may be in the making
        return tuple(json.loads(line) for line in lines)
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, RecursionError) as error:
        raise CorruptFile(path, "it is no list of an estimate's steps") from error


def state_of_step(step: dict[str, Any]) -> SceneState:
    """The best scene of a step that was read."""
    return decode(StateJson, step["guess"], "guess").state()


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def _keep(path: Path, progress: Estimating, state: SceneState) -> None:
    names = ("done", "total", "note", "step", "stage", "losses", "loss")
    line = json.dumps({**{name: getattr(progress, name) for name in names}, "guess": state_to_json(state)})
    with writing(path), path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")


ESTIMATE = JobKind(
    "estimate", "estimate", estimate_job, EstimateParams, preloads=("osfcore.control.estimators",), ends_at_once=True
)
