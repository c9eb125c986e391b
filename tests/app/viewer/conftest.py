"""The drawing of a running service, with a scene of two objects."""

import numpy as np
import pytest

from tests.app.conftest import until

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"


@pytest.fixture
def drawing(live):
    return live.services.viewer._drawing


@pytest.fixture
def shown(live, drawing):
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "objects": [BOX, BOTTLE]})
    until(lambda: set(drawing._bodies) == {BOX, BOTTLE})
    yield scene
    live.request("DELETE", f"/api/scenes/{scene['id']}")


def agrees(drawing, scene):
    """Whether what is drawn is where the scene says."""
    bodies = drawing._bodies
    told = {o["name"]: o for o in scene["objects"]}
    return (
        set(told) == set(bodies)
        and all(np.allclose(bodies[n].position, o["position"], atol=1e-5) for n, o in told.items())
        and all(np.allclose(bodies[n].wxyz, o["quaternion"], atol=1e-5) for n, o in told.items())
        and np.allclose(drawing._pusher.position, scene["pusher"]["position"], atol=1e-5)
        and np.allclose(drawing._cube.position, scene["light"]["position"], atol=1e-5)
        and np.allclose(drawing._lamp.position, scene["light"]["position"], atol=1e-5)
    )
