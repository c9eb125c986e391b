"""Estimates that were made beforehand, and whether they explain what is seen now as well as what was seen then.

An example comes with the estimates of its first frame and of its goal image, so that it need not be looked at for
half a minute. They are used only where they fit: residuals of the fields rendered there are compared with those
of then.
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
    """An estimate and how well it explained the images that it was made from.

    Attributes:
        estimate: estimate of poses and light.
        residuals: RMS of each object there [radiance], see `expected_residuals`.
    """

    estimate: EstimatedState
    residuals: Float[np.ndarray, "N"]

    @staticmethod
    def of(models: ObjectModels, observation: Observation, estimate: EstimatedState) -> PreparedLook:
        """Keep an estimate of an observation, and how well it explains it, for later."""
        return PreparedLook(estimate, expected_residuals(models, observation, estimate.state))

    def explains(self, models: ObjectModels, observation: Observation) -> bool:
        """Decide whether it fits an observation of these objects about as well as the one that it was made from."""
        state = self.estimate.state
        if state.names != observation.names:
            return False
        now = expected_residuals(models, observation, state)
        return bool(np.all(now <= _WORSE * self.residuals + _NOISE))


@dataclass(frozen=True, eq=False, slots=True)
class PreparedLooks:
    """Estimates that were made beforehand of a table and its goal image.

    Attributes:
        first: estimate of the first frame.
        goal: of the goal image.
    """

    first: PreparedLook
    goal: PreparedLook

    def step(self, look: str, models: ObjectModels, observation: Observation) -> EstimateStep | None:
        """Return the result of a look, "first" or "goal", if it explains what is seen; else None."""
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
