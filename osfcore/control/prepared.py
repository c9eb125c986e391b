"""Estimates that were made in advance, and a check that they still explain the images.

An example comes with estimates of its first frame and of its goal image, which saves half a minute. An estimate is used
only if its residuals in the present images are about as small as in the images that it was made from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.uncertainty import expected_residuals
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.json_codec import Entry, decode, encode
from osfcore.io.scene_file import EstimateJson
from osfcore.progress import Progress

_WORSE, _NOISE = 1.2, 0.004  # by how much a residual may exceed the former one: a factor, and [radiance]


@dataclass(frozen=True, eq=False, slots=True)
class PreparedLook:
    """An estimate, and how well it explained the images that it was made from.

    Attributes:
        estimate: estimate of poses and light.
        residuals: residual of each object in those images [radiance], see `expected_residuals`.
    """

    estimate: EstimatedState
    residuals: Float[np.ndarray, "N"]

    @staticmethod
    def of(models: ObjectModels, observation: Observation, estimate: EstimatedState) -> PreparedLook:
        """Store an estimate from an observation together with its residuals there."""
        return PreparedLook(estimate, expected_residuals(models, observation, estimate.state))

    def explains(self, models: ObjectModels, observation: Observation) -> bool:
        """Return whether the estimate fits this observation about as well as the one that it was made from."""
        state = self.estimate.state
        if state.names != observation.names:
            return False
        now = expected_residuals(models, observation, state)
        return bool(np.all(now <= _WORSE * self.residuals + _NOISE))


@dataclass(frozen=True, eq=False, slots=True)
class PreparedLooks:
    """Estimates of a table and its goal image that were made in advance.

    Attributes:
        first: estimate of the first frame.
        goal: estimate of the goal image.
    """

    first: PreparedLook
    goal: PreparedLook

    def step(self, look: str, models: ObjectModels, observation: Observation) -> EstimateStep | None:
        """Return the estimate for "first" or "goal" if it explains the images; else None."""
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
    """Convert to plain lists and numbers."""
    looks = {
        name: _LookJson(estimate=EstimateJson.of_estimate(look.estimate), residuals=look.residuals.round(6).tolist())
        for name, look in (("first", prepared.first), ("goal", prepared.goal))
    }
    return encode(_LooksJson(**looks))


def prepared_from_json(data: object) -> PreparedLooks:
    """Read from parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    looks = decode(_LooksJson, data, "prepared looks")
    return PreparedLooks(looks.first.look(), looks.goal.look())
