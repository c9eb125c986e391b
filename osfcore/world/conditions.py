"""What a simulated tabletop is made of, where that differs from what a method takes for granted."""

from __future__ import annotations

from dataclasses import dataclass, field

from osfcore.errors import InvalidInput
from osfcore.geometry.spot_lamp import SpotLamp
from osfcore.world.imaging.optics import Lamp, TableSurface

_MAX_FACTOR = 100.0


@dataclass(frozen=True, eq=False, slots=True)
class Conditions:
    """Light, table and contacts of a world; the defaults are those that everything here is made for.

    Attributes:
        lamp: how strongly, and in which colour, the scene is lit.
        table: what the table looks like.
        friction_factor: on the friction of every object, hence between object and table, and object and pusher; between
            two objects it counts twice.
        mass_factor: on the mass and the moments of inertia of every object.
        spot: a near lamp in the place of the distant light, whatever is asked of that; None for the distant light.
    """

    lamp: Lamp = field(default_factory=Lamp)
    table: TableSurface = field(default_factory=TableSurface)
    friction_factor: float = 1.0
    mass_factor: float = 1.0
    spot: SpotLamp | None = None

    def __post_init__(self) -> None:
        """Check the factors.

        Raises:
            InvalidInput: if one is not positive, or beyond reason.
        """
        for what, factor in (("factor on friction", self.friction_factor), ("factor on mass", self.mass_factor)):
            if not 0 < factor <= _MAX_FACTOR:
                raise InvalidInput(what, factor, f"above 0 and at most {_MAX_FACTOR:g}")
