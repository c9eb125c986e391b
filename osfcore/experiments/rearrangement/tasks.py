"""What planning is measured on: scenes at rest, some objects of which shall lie elsewhere (paper, section 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from osfcore.errors import NoRoom
from osfcore.experiments.estimation.tasks import opened
from osfcore.experiments.fields.composite_scenes import draw_scene
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.goal_layouts import draw_goal

_LAYOUTS = 30  # of a task, until one has room for where its objects shall go


def mpc_task(
    library: AssetLibrary, available: Sequence[str], objects: int, seed: int, number: int
) -> RearrangementTask:
    """One of many tasks, which does not depend on the others; in turn one, two and three objects move.

    Args:
        library: meshes of the objects.
        available: objects to choose from.
        objects: in the scene; no more than these move.
        seed: of all the tasks.
        number: which of them, from 0.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit.
    """
    draw = draw_scene(available, objects, seed, number)
    count = 1 + number % min(objects, 3)
    for layout in range(_LAYOUTS):
        rng = np.random.default_rng([seed, number, layout])
        with opened(replace(draw, seed=int(rng.integers(1 << 31))), library) as world:
            start = world.truth()
            found = draw_goal(world, count, rng)
        if found is not None:
            return RearrangementTask(number, start, *found)
    raise NoRoom(draw.names, _LAYOUTS)
