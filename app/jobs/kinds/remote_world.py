"""The page's table as a world: what an episode in a job's process sees and does there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from app.processes.messages.scene_messages import Act, JobCommand, ObservedScene, ObserveScene, SceneRecord, TakeView
from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import check_action

Ask = Callable[[JobCommand], Any]


class RemoteWorld:
    """A scene of the service, by way of the process that simulates it.

    The service stands in between: it stores each push, and lets a job change no scene but its own.

    Args:
        ask: has something done with the scene, and waits for the answer.
        scene: identifier.
    """

    def __init__(self, ask: Ask, scene: str) -> None:
        self._ask, self._scene = ask, scene
        self.record: SceneRecord | None = None  # the truth of the last moment; for reports, not for estimates

    def reset(self, seed: int) -> Observation:
        """Refuse: the scene is the page's.

        Raises:
            OsfError: always.
        """
        del seed
        raise OsfError("A scene of the service is reset by whoever made it, not by an episode.")

    def observe(self, *, masks: bool = False) -> Observation:
        """Images of all cameras.

        Raises:
            ProcessUnavailable: if the simulation is not there now.
        """
        seen: ObservedScene = self._ask(ObserveScene(self._scene, goal=False, masks=masks))
        self.record = seen.record
        return seen.observation

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold the pusher velocity (vx, vy, 0) [m/s] for 0.2 s.

        Raises:
            InvalidInput: if the action is outside its limits; the world is unchanged.
            ProcessUnavailable: if the simulation is not there now.
        """
        self.record = self._ask(Act(self._scene, (check_action(action),)))

    def close(self) -> None:
        """Do nothing: the scene is the page's."""

    def truth(self) -> SceneState:
        """Where everything truly was, at the last moment that was told; for reports, never for the loop."""
        record = self.record or self._ask(Act(self._scene, ()))
        self.record = record
        return record.state

    def photo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """What a camera would see now, the pusher included, at its size."""
        return self._ask(TakeView(self._scene, camera)).astype(np.float32) / 255
