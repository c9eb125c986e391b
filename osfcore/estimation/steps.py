"""Results of estimators and of checks of a photo's content. Importing this module loads no model."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.estimation.camera_response import ImageModel
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.progress import Progress

UNPLACED_BELOW_M = -0.5  # an object that was not looked at yet is put far below the table
Stage = Literal["orientations", "light", "objects", "together", "polish", "done"]


@dataclass(frozen=True, eq=False, slots=True)
class EstimateStep:
    """One iteration of an estimator.

    Attributes:
        progress: how far the work has come.
        stage: the part of the method that is running.
        state: the best scene so far.
        candidates: poses `T_world_object` that were tried, a batch of (C, N): C candidates for each of N objects.
        lights: unit vectors toward the lights that were tried; None while the light is held.
        sigma: overall step size of the search, relative to the beginning of the stage.
        losses: loss of each object, in the units of the stage.
        loss: loss of the whole scene, in the units of the stage.
        estimate: the result; None before the last step.
        image_model: exposure, encoding, ambient light and table colour of the images. Only in the last step, and None
            if they are the usual ones.
    """

    progress: Progress
    stage: Stage
    state: SceneState
    candidates: Pose | None = None
    lights: Float[np.ndarray, "C 3"] | None = None
    sigma: float = 1.0
    losses: tuple[float, ...] = ()
    loss: float = float("nan")
    estimate: EstimatedState | None = None
    image_model: ImageModel | None = None


def all_but_last(steps: Iterator[EstimateStep]) -> Generator[EstimateStep, None, EstimateStep]:
    """Yield all steps of an estimate but the last one, and return that."""
    before = next(steps)
    for step in steps:
        yield before
        before = step
    return before


Verdict = Literal["shown", "doubtful", "others", "bare", "elsewhere"]


@dataclass(frozen=True, slots=True)
class ContentCheck:
    """Result of a check of a photo's content.

    Attributes:
        verdict: "shown" if the photo shows the objects, "doubtful" if it may, "others" if it shows something else,
            "bare" if nothing stands out from the table, "elsewhere" if it does not show the table as its camera would.
        colours: share of the photo's colours that belong to the objects, times the share of the objects' colours that
            the photo has.
        template: log of the factor by which the photometric loss grows without the object that is seen best. It is 0
            if the colours were enough to decide, or the photo does not show the table.
    """

    verdict: Verdict
    colours: float = 0.0
    template: float = 0.0
