"""What a data set is made of, and what it came to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.export.lerobot.conventions import ACTION, ENVIRONMENT, IMAGES, STATE


@dataclass(frozen=True, eq=False, slots=True)
class LeRobotEpisode:
    """An episode of T actions, each with what was known before it.

    Attributes:
        task: what should be done, in words.
        actions: velocities (vx, vy) [m/s].
        pusher: its places [m].
        environment: environment states; None to leave them out.
        images: linear RGB by name, such as "camera_0"; all of one size with even sides.
    """

    task: str
    actions: Float[np.ndarray, "T 2"]
    pusher: Float[np.ndarray, "T 2"]
    environment: Float[np.ndarray, "T D"] | None = None
    images: Mapping[str, UInt8[np.ndarray, "T h w 3"]] = field(default_factory=dict)

    @property
    def vectors(self) -> dict[str, np.ndarray]:
        """All but images, by key."""
        told = {ACTION: self.actions, STATE: self.pusher, ENVIRONMENT: self.environment}
        return {key: rows.astype(np.float32) for key, rows in told.items() if rows is not None}

    @property
    def videos(self) -> dict[str, np.ndarray]:
        """Images, by key."""
        return {f"{IMAGES}.{name}": images for name, images in self.images.items()}


@dataclass(frozen=True, slots=True)
class DatasetSize:
    """What a data set holds: episodes, frames (one for each action) and different tasks."""

    episodes: int
    frames: int
    tasks: int
