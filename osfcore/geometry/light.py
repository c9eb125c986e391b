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
    """A distant white light with parallel rays. Images show only its direction.

    Attributes:
        position: point in the direction of the light, seen from the table's centre [m]. It is scaled to a length of
            1 m.

    Raises:
        InvalidInput: if the position is zero, not finite, or less than 5 degrees above the table.

    Example:
        >>> Light(np.array([0.0, 3.0, 4.0])).direction
        array([0. , 0.6, 0.8])
    """

    position: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        """Bring the position to unit length and refuse lights at or below the table."""
        position = finite_vector(self.position, 3, "light position [m]")
        length = np.linalg.norm(position)
        if not length > 1e-9:
            raise InvalidInput("light position [m]", position.tolist(), "away from the table's centre")
        position = position / length
        _check_elevation(position, "light elevation [deg]")
        object.__setattr__(self, "position", position)

    @staticmethod
    def from_angles(azimuth_rad: float, elevation_rad: float) -> Light:
        """Return the light at an azimuth [rad], from +x toward +y, and an elevation above the table [rad]."""
        c = np.cos(elevation_rad)
        return Light(np.array([c * np.cos(azimuth_rad), c * np.sin(azimuth_rad), np.sin(elevation_rad)]))

    @staticmethod
    def random(rng: np.random.Generator, min_elevation_deg: float = 10.0) -> Light:
        """Draw a light above `min_elevation_deg`, uniformly by solid angle."""
        z = rng.uniform(np.sin(np.deg2rad(min_elevation_deg)), 1.0)
        return Light.from_angles(rng.uniform(-np.pi, np.pi), float(np.arcsin(z)))

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the table's centre toward the light."""
        return self.position

    def angle_to(self, other: Light) -> float:
        """Return the angle between the directions of two lights [rad]."""
        return float(np.arccos(np.clip(self.direction @ other.direction, -1, 1)))


def _check_elevation(direction: Float[np.ndarray, "3"], what: str) -> None:
    elevation_deg = float(np.rad2deg(np.arcsin(np.clip(direction[2], -1, 1))))
    if elevation_deg < MIN_LIGHT_ELEVATION_DEG - 1e-6:
        raise InvalidInput(what, f"{elevation_deg:.1f}", f"at least {MIN_LIGHT_ELEVATION_DEG:g}")


# A lamp at a finite distance that looks at a point: light falls off with distance and with the angle to its axis.
#
# A surface with normal n at a point x sees it along l = (p - x) / r, r = |p - x|, and sends out
#
#     radiance = albedo * (ambient + diffuse * visible * max(n . l, 0) * spot * (d0 / r)^2)
#
# with d0 the lamp's distance from the table's centre: as it moves away along its direction, it becomes the distant
# light of the same direction. With a the angle between its axis and the way to x, and s = (outer - a) / (outer -
# inner) cut to [0, 1], spot = s^2 (3 - 2 s): 1 inside the inner cone, 0 outside the outer one, a smooth step in the
# penumbra between.


MIN_LAMP_DISTANCE_M = 0.15
MIN_PENUMBRA_RAD = 1e-6  # divisor where the cone has no penumbra


@dataclass(frozen=True, eq=False, slots=True)
class SpotLamp:
    """A white lamp with a cone.

    Attributes:
        position: in the world [m].
        aim: the point that it looks at [m].
        inner_deg: half-angle of the cone of full light.
        outer_deg: half-angle of the cone beyond which it sheds no light.
    """

    position: Float[np.ndarray, "3"]
    aim: Float[np.ndarray, "3"]
    inner_deg: float
    outer_deg: float

    def __post_init__(self) -> None:
        """Check the place, the aim and the cone.

        Raises:
            InvalidInput: if it is too near, too low, looks nowhere or has no sound cone.
        """
        object.__setattr__(self, "position", finite_vector(self.position, 3, "position of the lamp [m]"))
        object.__setattr__(self, "aim", finite_vector(self.aim, 3, "point that the lamp looks at [m]"))
        if self.distance < MIN_LAMP_DISTANCE_M:
            allowed = f"at least {MIN_LAMP_DISTANCE_M:g}"
            raise InvalidInput("distance of the lamp from the table's centre [m]", f"{self.distance:.3f}", allowed)
        _check_elevation(self.direction, "elevation of the lamp above the table, seen from its centre [deg]")
        if not np.linalg.norm(self.aim - self.position) > 1e-6:
            raise InvalidInput("point that the lamp looks at [m]", self.aim.tolist(), "away from the lamp itself")
        if not 0 < self.inner_deg <= self.outer_deg <= 90:
            what = "half-angles of the lamp's inner and outer cone [deg]"
            raise InvalidInput(what, f"{self.inner_deg:g} and {self.outer_deg:g}", "0 < inner <= outer <= 90")

    @property
    def distance(self) -> float:
        """Distance from the table's centre [m]."""
        return float(np.linalg.norm(self.position))

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the table's centre toward the lamp."""
        return self.position / self.distance

    @property
    def axis(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the lamp toward the point it looks at."""
        way = self.aim - self.position
        return way / np.linalg.norm(way)

    @property
    def cone_rad(self) -> tuple[float, float]:
        """The inner and the outer half-angle [rad]."""
        return float(np.deg2rad(self.inner_deg)), float(np.deg2rad(self.outer_deg))

    @property
    def distant(self) -> Light:
        """The distant light of the same direction, which the lamp becomes as it moves away."""
        return Light(self.position)

    def toward(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        """Return the unit vectors from points [m] toward the lamp."""
        way = self.position - points
        return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)

    def falloff(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
        """Return the falloff with distance at points [m], (d0 / r)^2: 1 at the table's centre."""
        squared = np.sum((self.position - points) ** 2, axis=-1)
        return np.asarray(self.distance**2 / np.maximum(squared, 1e-18))

    def spot_factor(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
        """Return the share of the light that the cone sends toward points [m]."""
        inner, outer = self.cone_rad
        angle = np.arccos(np.clip(-self.toward(points) @ self.axis, -1, 1))
        s = np.clip((outer - angle) / max(outer - inner, MIN_PENUMBRA_RAD), 0, 1)
        return np.asarray(s**2 * (3 - 2 * s))
