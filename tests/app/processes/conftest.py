"""A data directory with fields that need no training, and a state to render."""

import numpy as np
import pytest

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from tests.app.processes.fields import write_box, write_exact_table

BOX = "003_cracker_box"
SIZE_M = np.array([0.1, 0.06, 0.08])
ALBEDO = (0.7, 0.2, 0.1)


@pytest.fixture(scope="package")
def fields_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fields")
    write_exact_table(folder)
    write_box(folder, BOX, SIZE_M, ALBEDO)
    return folder


@pytest.fixture
def state():
    """A box that stands on the table, lit from above and the side."""
    pose = Pose(np.array([[0.05, -0.02, SIZE_M[2] / 2]]), np.array([[1.0, 0, 0, 0]]))
    return SceneState((BOX,), pose, Light(np.array([0.5, 0.2, 1.0])), np.array([-0.2, 0.1, PUSHER_CENTRE_Z_M]))
