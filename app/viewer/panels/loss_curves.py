"""Losses of an estimate as curves; stages have units of their own, so each is drawn relative to its largest loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from osfcore.estimation.steps import EstimateStep


@dataclass(frozen=True, slots=True)
class LossCurves:
    """What the losses were.

    Attributes:
        names: of the objects.
        rows: of each step its stage, and the losses of the objects and of the whole; NaN where there is none.
    """

    names: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float, ...]], ...] = field(default=())

    def with_step(self, step: EstimateStep) -> LossCurves:
        """The curves with one more step."""
        missing = [float("nan")] * (len(self.names) - len(step.losses))
        return LossCurves(self.names, (*self.rows, (step.stage, (*step.losses, *missing, step.loss))))

    def drawn(self) -> tuple[Float[np.ndarray, "P"], ...]:
        """Number of the step, then each object's curve, then that of the whole; NaN between stages."""
        count = len(self.names) + 1
        numbers: list[float] = []
        values: list[Sequence[float]] = []
        start = 0
        for end in range(1, len(self.rows) + 1):
            if end < len(self.rows) and self.rows[end][0] == self.rows[start][0]:
                continue
            stage = np.array([losses for _, losses in self.rows[start:end]])
            numbers += [*range(start + 1, end + 1), end + 0.5]
            values += [*_relative(stage)]
            values.append([float("nan")] * count)
            start = end
        table = np.array(values).reshape(-1, count)
        return np.array(numbers), *(table[:, n] for n in range(count))


def _relative(losses: Float[np.ndarray, "P K"]) -> Float[np.ndarray, "P K"]:
    """Losses of one stage as shares of each curve's largest."""
    most = np.where(np.isfinite(losses), losses, 0.0).max(axis=0)
    return losses / np.maximum(most, 1e-300)
