"""Results of estimators and of checks of a photo's content; apart from them, so that importing it loads no model."""

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
    """One iteration.

    Attributes:
        progress: how far the work is.
        stage: which part of the method is at work.
        state: the best scene so far.
        candidates: poses that were tried, C for each of N objects; (C, N) batches.
        lights: directions toward the light that were tried, C x 3; None while it is held.
        sigma: the search's overall step, 1 when a stage begins.
        losses: of each object, in the units of the stage.
        loss: of the whole, likewise.
        estimate: the result; only in the last step.
        image_model: with it, of pictures that fields were not made for; None for usual pictures.
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
    """Pass on the steps of an estimate but for the last one, which is returned."""
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
        verdict: "shown" if the objects are in it, "doubtful" if they may be, "others" if something else is, "bare" if
            nothing stands out from the table, "elsewhere" if it does not show the table as its camera would.
        colours: share of the photo's colours that are the objects', times the share of theirs that is found in it.
        template: log of the factor by which the photometric loss grows without the object that is seen best; 0
            where the colours sufficed, or the photo shows no such table.
    """

    verdict: Verdict
    colours: float = 0.0
    template: float = 0.0
