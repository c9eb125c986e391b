import asyncio
import contextlib
import io

import numpy as np
import pytest

from app.viewer.nodes.waypoints import MOST, SPACING_M, Waypoints
from app.viewer.viewer import LoopbackViser
from osfcore.geometry.workspace import PUSHER_REACH_M


@pytest.fixture
def server():
    with contextlib.redirect_stdout(io.StringIO()):
        server = LoopbackViser(host="127.0.0.1", port=0, verbose=False)
        yield server
        server.stop()


def test_handles_are_laid_shown_and_dragged(server):
    dragged = []
    waypoints = Waypoints(server, lambda: dragged.append(True))
    waypoints.lay(np.array([0.3, 0.0]), np.pi / 2)
    np.testing.assert_allclose(waypoints.places(2), [[0.3, SPACING_M], [0.3, 2 * SPACING_M]], atol=1e-9)
    waypoints.lay(np.array([0.3, 0.0]), 0.0)
    assert waypoints.places(MOST).max() == PUSHER_REACH_M
    assert not any(handle.visible for handle in waypoints._handles)
    waypoints.show(3)
    assert [handle.visible for handle in waypoints._handles] == [True] * 3 + [False] * (MOST - 3)
    (drag,) = waypoints._handles[0]._impl_aux.update_cb
    asyncio.run(drag(None))
    assert dragged == [True]
