import numpy as np
import pytest

from osfcore.estimation.camera_response import linear_of_srgb
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import Scene
from tests.support.ellipsoid import ALBEDO, HALF, ellipsoid_field, ellipsoid_normals


@pytest.fixture(scope="session")
def light():
    return Light(np.array([1.0, -0.5, 0.8]))


@pytest.fixture(scope="session")
def assert_solid(light):
    """Checks that vertices lie on the solid, and that their colours are its albedo, or its radiance under the light."""

    def check(points, colours, is_lit):
        np.testing.assert_allclose(np.linalg.norm(points / HALF, axis=1), 1, atol=0.05)
        cosine = np.maximum(ellipsoid_normals(points) @ light.direction, 0)
        shade = 0.25 + 0.75 * cosine if is_lit else np.ones(len(points))
        np.testing.assert_allclose(colours, linear_of_srgb(shade[:, None] * np.array(ALBEDO)), atol=0.06)

    return check


@pytest.fixture(scope="session")
def solid():
    return ellipsoid_field()


@pytest.fixture(scope="session")
def scene(light):
    """A scanned object and two fields whose names differ in one character, four cameras and one off centre."""
    quaternions = quaternion_exp(np.array([[0, 0, 0.4], [1.2, 0.3, -0.5], [0, 0, 0]]))
    poses = Pose(np.array([[0.05, -0.1, 0.095], [-0.1, 0.02, 0.05], [0.1, 0.1, 0.04]]), quaternions)
    names = ("006_mustard_bottle", "solid 1", "solid_1")
    return Scene(SceneState(names, poses, light, np.array([0.0, 0.1, 0.062])), default_cameras(64))


@pytest.fixture(scope="session")
def shapes(library, solid):
    return {"006_mustard_bottle": library.load("006_mustard_bottle").mesh, "solid 1": solid, "solid_1": solid}
