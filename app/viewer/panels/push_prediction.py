"""A predicted push, what came of its execution, and when a change of the scene makes it outdated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from app.processes.scene_messages import SceneRecord
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState


@dataclass(frozen=True, eq=False, slots=True)
class PushPrediction:
    """A push that was predicted, and perhaps executed.

    Attributes:
        record: the scene from which it starts.
        actions: that are tried.
        rollouts: what they were predicted to lead to.
        took_s: time that predicting took [s].
        truth: the way things truly went, as far as it has been executed; empty before.
        is_executed: whether exactly these actions, all of them, were executed.
    """

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    rollouts: Rollouts
    took_s: float
    truth: tuple[SceneState, ...] = ()
    is_executed: bool = False

    @property
    def last_revision(self) -> int:
        """Of the scene once it has been executed: the simulation counts actions."""
        return self.record.revision + len(self.actions)

    def after(
        self, record: SceneRecord, states: tuple[SceneState, ...], executing: PushPrediction | None
    ) -> PushPrediction | None:
        """What is left of it after a change: it outlives the execution of its own actions, and nothing else.

        Args:
            record: the scene after the change.
            states: the way there.
            executing: whose actions are being executed now.
        """
        if record.revision <= self.record.revision:
            return self
        is_own = executing is not None and executing.rollouts is self.rollouts
        if is_own and record.revision <= self.last_revision:
            truth = (*(self.truth or (self.record.state,)), *states, record.state)
            return replace(self, truth=truth, is_executed=record.revision == self.last_revision)
        return self if self.is_executed and record.revision == self.last_revision else None
