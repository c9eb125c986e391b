"""Random scenes by number: each is the same again without the others, to the last bit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from osfcore.errors import NoRoom
from osfcore.geometry.light import Light
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.conditions import Conditions
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop

HARSH_ELEVATION_DEG = 10.0
_LAYOUTS = 10  # arrangements that are tried where objects do not fit


@dataclass(frozen=True, slots=True)
class Draw:
    """What chance decided about a scene.

    Attributes:
        names: its objects.
        light: above the table.
        seed: of the arrangement.
    """

    names: tuple[str, ...]
    light: Light
    seed: int


def draw_scene(
    available: Sequence[str],
    count: int,
    seed: int,
    number: int,
    stream: Stream = Stream.SCENE,
    min_elevation_deg: float = HARSH_ELEVATION_DEG,
) -> Draw:
    """One of many random scenes; it does not depend on the others.

    Args:
        available: objects to choose from, `count` or more.
        count: objects in the scene.
        seed: of all the scenes.
        number: which of them.
        stream: that they are drawn from.
        min_elevation_deg: of their lights.
    """
    rng = stream_rng(seed, stream, number)
    light = Light.random(rng, min_elevation_deg)
    arrangement = int(rng.integers(1 << 31))
    chosen = rng.permutation(len(available))[:count]
    return Draw(tuple(available[int(i)] for i in chosen), light, arrangement)


@contextmanager
def opened(draw: Draw, library: AssetLibrary, conditions: Conditions | None = None) -> Iterator[Tabletop]:
    """The draw's scene as a world, for as long as it is needed, under the usual conditions or others."""
    world = Tabletop(library, request=SceneRequest(names=draw.names, light=draw.light), conditions=conditions)
    try:
        for attempt in range(_LAYOUTS):
            try:
                world.arrange(draw.seed + attempt)
                break
            except NoRoom:
                if attempt == _LAYOUTS - 1:
                    raise
        yield world
    finally:
        world.close()
