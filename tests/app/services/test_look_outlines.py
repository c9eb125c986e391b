import numpy as np
import pytest

from app.services.look_outlines import TRIED, Outliner
from osfcore.control.events import Looking
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.progress import Progress

NAMES = ("006_mustard_bottle", "003_cracker_box")
TURN = np.array([1.0, 0.0, 0.0, 0.0])


def state(*positions):
    return SceneState(
        NAMES, Pose(np.array(positions), np.tile(TURN, (len(NAMES), 1))), Light.from_angles(0.5, 0.7), None
    )


def looking(where, look="first", candidates=None, loss=0.25):
    return Looking(0, look, EstimateStep(Progress(3, 4, ""), "light", where, candidates, loss=loss))


@pytest.fixture
def outliner(library):
    return Outliner(library)


def test_outlines_hold_all_that_the_mesh_projects_to(outliner, library):
    where = state([0.1, 0.05, 0.1], [-0.1, 0.0, 0.1])
    drawn = outliner.outlines(looking(where))
    assert set(drawn.cameras) == {camera.name for camera in default_cameras()}
    for camera in default_cameras():
        for entry in drawn.cameras[camera.name]:
            vertices = where.pose(entry.name).apply(library.load(entry.name).mesh.vertices.astype(float))
            pixels = camera.project(vertices) / (camera.width, camera.height)
            low, high = np.min(entry.best, axis=0), np.max(entry.best, axis=0)
            np.testing.assert_allclose(low, pixels.min(axis=0), atol=0.01)
            np.testing.assert_allclose(high, pixels.max(axis=0), atol=0.01)


def test_a_goal_is_outlined_in_its_image_only(outliner):
    drawn = outliner.outlines(looking(state([0, 0, 0.1], [0.1, 0.1, 0.1]), "goal"))
    assert set(drawn.cameras) == {goal_camera().name}


def test_some_candidates_are_outlined_and_what_was_not_looked_at_is_not(outliner):
    rng = np.random.default_rng(0)
    tried = Pose(rng.uniform(-0.1, 0.1, (40, 2, 3)) + [0, 0, 0.1], np.tile(TURN, (40, 2, 1)))
    drawn = outliner.outlines(looking(state([0, 0, 0.1], [0, 0, -1.0]), candidates=tried))
    first, second = drawn.cameras["0"]
    assert len(first.tried) == TRIED
    assert len(first.best) >= 3
    assert second.best == ()


def test_share_loss_and_light_are_told(outliner):
    drawn = outliner.outlines(looking(state([0, 0, 0.1], [0.1, 0, 0.1])))
    assert (drawn.share, drawn.loss, drawn.stage, drawn.is_over) == (0.75, 0.25, "light", False)
    assert drawn.light_deg == pytest.approx(np.rad2deg([0.5, 0.7]))
    assert outliner.outlines(looking(state([0, 0, 0.1], [0.1, 0, 0.1]), loss=float("nan"))).loss is None


def test_an_object_without_a_mesh_is_a_small_cube(outliner):
    odd = SceneState(("nobody",), Pose(np.array([[0, 0, 0.1]]), TURN[None]), Light.from_angles(0, 1), None)
    (entry,) = outliner.outlines(Looking(0, "goal", EstimateStep(Progress(1, 1, ""), "done", odd))).cameras["goal"]
    assert 0.01 < np.ptp(np.array(entry.best), axis=0).max() < 0.2
