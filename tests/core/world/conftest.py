import contextlib

import pytest

from osfcore.geometry.cameras import default_cameras
from osfcore.world.tabletop import Tabletop


@pytest.fixture
def tables(library):
    """Makes tables, with the scene of a seed if one is given, and closes them."""
    with contextlib.ExitStack() as stack:

        def make(seed: int | None = None, **given) -> Tabletop:
            table = stack.enter_context(contextlib.closing(Tabletop(library, cameras=default_cameras(48), **given)))
            if seed is not None:
                table.arrange(seed)
            return table

        yield make
