"""Builds the steps that an estimator yields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.search.gauss_newton import GaussNewtonState
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose
from osfcore.progress import Progress


class StepReporter:
    """Builds the steps of one estimation and counts them.

    Args:
        total: steps that are expected; may grow.
    """

    def __init__(self, total: int) -> None:
        self.done, self.total = 0, total

    def step(
        self,
        stage: Stage,
        note: str,
        params: SceneParameters,
        tried: Sequence[Pose] = (),
        losses: Sequence[float] = (),
        sigma: float = 1.0,
        lights: Float[np.ndarray, "C 3"] | None = None,
        loss: float = float("nan"),
    ) -> EstimateStep:
        """The next step.

        Args:
            stage: which part of the method is at work.
            note: what it does, for a person.
            params: the best scene so far.
            tried: poses of each object; shown if there are some of every object, as many as of the fewest.
            losses: of each object.
            sigma: the search's overall step.
            lights: directions that were tried.
            loss: of the whole.
        """
        self.done = min(self.done + 1, self.total)
        candidates = None
        count = min((len(poses.position) for poses in tried), default=0) if len(tried) == len(params.names) else 0
        if count:
            candidates = Pose(
                np.stack([poses.position[:count] for poses in tried], 1),
                np.stack([poses.quaternion[:count] for poses in tried], 1),
            )
        progress = Progress(self.done, self.total, note)
        return EstimateStep(progress, stage, params.state(), candidates, lights, sigma, tuple(losses), loss)

    def refinement(self, note: str, at: GaussNewtonState) -> EstimateStep:
        """The next step, of Gauss-Newton."""
        return self.step("polish", note, at.params, losses=at.losses[:-1].tolist(), loss=float(at.losses[-1]))

    def finish(self, at: GaussNewtonState, estimate: EstimatedState) -> EstimateStep:
        """The last step, with the result."""
        self.done = self.total - 1
        step = self.refinement("Done" if estimate.trusted else estimate.reason, at)
        return replace(step, stage="done", estimate=estimate)
