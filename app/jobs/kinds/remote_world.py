"""The page's table as a world: what an episode in a job's process sees and does there."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from app.processes.messages.scene_messages import Act, ObserveScene, SceneRecord, TakeView
from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import check_action
from osfcore.io.observation_file import read_observation

_FOLDER = ".seen"
Ask = Callable[[Act | ObserveScene | TakeView], Any]


class RemoteWorld:
    """A scene of the service, by way of the process that simulates it.

    Images come as the cameras' 8-bit PNGs, as a robot's would.

    Args:
        ask: has something done with the scene, and waits for the answer.
        scene: identifier.
        folder: for images on their way; exists.
    """

    def __init__(self, ask: Ask, scene: str, folder: Path) -> None:
        self._ask, self._scene, self._folder = ask, scene, folder
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
        place = self._folder / _FOLDER
        shutil.rmtree(place, ignore_errors=True)
        self.record = self._ask(ObserveScene(self._scene, place, goal=False, masks=masks))
        observation = read_observation(place)
        shutil.rmtree(place, ignore_errors=True)
        return observation

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold the pusher velocity (vx, vy, 0) [m/s] for 0.2 s.

        Raises:
            InvalidInput: if the action is outside its limits; the world is unchanged.
            ProcessUnavailable: if the simulation is not there now.
        """
        self.record = self._ask(Act(self._scene, (check_action(action),)))

    def close(self) -> None:
        """Remove images on their way. Calling it again does nothing."""
        shutil.rmtree(self._folder / _FOLDER, ignore_errors=True)

    def truth(self) -> SceneState:
        """Where everything truly was, at the last moment that was told; for reports, never for the loop."""
        record = self.record or self._ask(Act(self._scene, ()))
        self.record = record
        return record.state

    def photo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """What a camera would see now, the pusher included, at its size."""
        data = self._ask(TakeView(self._scene, camera))
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            return np.asarray(image.convert("RGB"), np.float32) / 255
