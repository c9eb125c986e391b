import numpy as np

from app.viewer.nodes.waypoints import MOST, SPACING_M, Waypoints
from osfcore.geometry.workspace import PUSHER_REACH_M


def test_handles_are_laid_shown_and_dragged(server, driver):
    dragged = []

    def visible():
        return [number for number in range(MOST) if driver.shows(f"/push/waypoints/{number}")]

    waypoints = Waypoints(server, lambda: dragged.append(True))
    waypoints.lay(np.array([0.3, 0.0]), np.pi / 2)
    np.testing.assert_allclose(waypoints.places(2), [[0.3, SPACING_M], [0.3, 2 * SPACING_M]], atol=1e-9)
    waypoints.lay(np.array([0.3, 0.0]), 0.0)
    assert waypoints.places(MOST).max() == PUSHER_REACH_M
    assert visible() == []
    waypoints.show(3)
    assert visible() == [0, 1, 2]
    driver.drag("/push/waypoints/0", None, None, "update")
    assert dragged == [True]
