"""The distant white light, and the shares of ambient and diffuse light in the image model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, finite_vector

AMBIENT = 0.25
DIFFUSE = 0.75
MIN_LIGHT_ELEVATION_DEG = 5.0


@dataclass(frozen=True, eq=False, slots=True)
class Light:
    """A distant, parallel, white light. Only its direction can be observed.

    Attributes:
        position: 1 m from the table's centre, toward the light [m]; any other length is brought to 1.
    """

    position: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        """Bring the position to unit length and refuse lights at or below the table."""
        position = finite_vector(self.position, 3, "light position [m]")
        length = np.linalg.norm(position)
        if not length > 1e-9:
            raise InvalidInput("light position [m]", position.tolist(), "away from the table's centre")
        position = position / length
        elevation_deg = float(np.rad2deg(np.arcsin(np.clip(position[2], -1, 1))))
        if elevation_deg < MIN_LIGHT_ELEVATION_DEG - 1e-6:
            raise InvalidInput("light elevation [deg]", f"{elevation_deg:.1f}", f"at least {MIN_LIGHT_ELEVATION_DEG:g}")
        object.__setattr__(self, "position", position)

    @staticmethod
    def from_angles(azimuth_rad: float, elevation_rad: float) -> Light:
        """A light at an azimuth from +x toward +y and an elevation above the table [rad]."""
        c = np.cos(elevation_rad)
        return Light(np.array([c * np.cos(azimuth_rad), c * np.sin(azimuth_rad), np.sin(elevation_rad)]))

    @staticmethod
    def random(rng: np.random.Generator, min_elevation_deg: float = 10.0) -> Light:
        """A light drawn uniformly (by solid angle) from the hemisphere above `min_elevation_deg`."""
        z = rng.uniform(np.sin(np.deg2rad(min_elevation_deg)), 1.0)
        return Light.from_angles(rng.uniform(-np.pi, np.pi), float(np.arcsin(z)))

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the table's centre toward the light."""
        return self.position

    def angle_to(self, other: Light) -> float:
        """The angle between the directions of two lights [rad]."""
        return float(np.arccos(np.clip(self.direction @ other.direction, -1, 1)))
