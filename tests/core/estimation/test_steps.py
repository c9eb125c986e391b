import dataclasses

import numpy as np
import pytest

from osfcore.estimation.steps import EstimateStep
from osfcore.progress import Progress
from tests.core.render.scenes import state


def test_a_step_needs_no_more_than_progress_and_a_guess():
    step = EstimateStep(Progress(1, 3, "Looking"), "objects", state({"ball": (0, 0, 0.05)}))
    assert step.candidates is step.lights is step.estimate is None
    assert step.losses == ()
    assert step.sigma == 1
    assert np.isnan(step.loss)
    with pytest.raises(dataclasses.FrozenInstanceError):
        step.sigma = 2.0
