"""Worlds by name, and what each is made from; other packages offer more (`osfcore.plugins`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from osfcore.control.world_protocol import SimulatedWorld
from osfcore.objects.asset_library import AssetLibrary
from osfcore.plugins import PartKind
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop

WORLD = PartKind("world", ("reset", "observe", "act", "close", "truth", "render"))


@dataclass(frozen=True, eq=False, slots=True)
class WorldInputs:
    """What a world is made from.

    Attributes:
        library: where the objects' meshes are.
        request: what `reset` puts on the table.
    """

    library: AssetLibrary
    request: SceneRequest


def _simulated(given: WorldInputs) -> SimulatedWorld:
    return Tabletop(given.library, request=given.request)


WORLDS: Mapping[str, Callable[[WorldInputs], SimulatedWorld]] = {"simulated": _simulated}
