"""What people do to the pictures of a scene to see whether the program notices: dim the light, cover a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from osfcore.geometry.states import Observation

DIMMED = 0.45


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What is done to a scene's pictures, until its episode ends, it is put back, or the simulation starts again.

    Attributes:
        brightness: factor of all radiance, ambient light included, as a dimmed lamp in a dark room has it.
        covered: names of cameras that see black.
    """

    brightness: float = 1.0
    covered: frozenset[str] = frozenset()

    def apply(self, observation: Observation) -> Observation:
        """The observation as it is with this."""
        if self == Disturbance():
            return observation
        images = observation.images * np.float32(self.brightness)
        for view, camera in enumerate(observation.cameras):
            if camera.name in self.covered:
                images[view] = 0
        return replace(observation, images=images)


class Disturbances:
    """What is done to each scene now."""

    def __init__(self) -> None:
        self._of: dict[str, Disturbance] = {}

    def toggle(self, scene: str, camera: str | None) -> Disturbance:
        """Cover a camera, or dim the light for None; undo it where that, or any camera, is so already."""
        now = self._of.get(scene, Disturbance())
        if camera is None:
            then = replace(now, brightness=DIMMED if now.brightness == 1.0 else 1.0)
        else:
            then = replace(now, covered=frozenset() if now.covered else frozenset({camera}))
        self._of[scene] = then
        return then

    def forget(self, scene: str) -> bool:
        """Back to what is there; tells whether that is another picture."""
        return self._of.pop(scene, Disturbance()) != Disturbance()

    def apply(self, scene: str, observation: Observation) -> Observation:
        """An observation of a scene as its cameras see it."""
        return self._of.get(scene, Disturbance()).apply(observation)
