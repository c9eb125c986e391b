"""What a tabletop with a pusher must offer, so that a real robot can stand in for the simulator."""

from typing import Protocol

import numpy as np
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState


class World(Protocol):
    """A table with objects, cameras and one pusher that follows velocities.

    The simulator (`osfcore.world.tabletop.Tabletop`) is one implementation. Nothing here tells poses or depth: whoever
    plans has to see.
    """

    def reset(self, seed: int) -> Observation:
        """Put a scene on the table: the same for the same seed where the world can (a robot may ask a person)."""
        ...

    def observe(self, *, masks: bool = False) -> Observation:
        """Take an image with every camera, with object masks on demand (a robot may have none: then None)."""
        ...

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold the pusher velocity (vx, vy, 0) [m/s] for `STEP_S` [s].

        Raises:
            InvalidInput: if the action is outside its limits; the world is unchanged.
        """
        ...

    def close(self) -> None:
        """Release what the world holds. Calling it again does nothing."""
        ...


class SimulatedWorld(World, Protocol):
    """A world that knows the truth, which reports tell; nothing that estimates or plans asks for it."""

    def truth(self) -> SceneState:
        """Where everything truly is."""
        ...

    def render(self, cameras: tuple[Camera, ...], *, masks: bool = False, with_pusher: bool = True) -> Observation:
        """What any cameras would see now."""
        ...
