import numpy as np
import pytest

from osfcore.control import closed_loop as module
from osfcore.control.closed_loop import AdaptedModels, estimate_goal_image
from osfcore.control.goal import GoalImage
from osfcore.estimation.camera_response import ImageModel
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.progress import Progress
from tests.core.control.scenes import LIGHT, NAMES, models, sure

OTHER = ImageModel(np.full(3, 0.5), 1.0, np.array([0.5, 0.6, 0.7]), "srgb")
STATE = SceneState(NAMES, Pose(np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))), LIGHT, None)


@pytest.fixture(scope="module")
def usual():
    return AdaptedModels(models().appearance)


@pytest.fixture
def goal():
    camera = goal_camera()
    return GoalImage(camera, np.full((camera.height, camera.width, 3), 0.5, np.float32))


def test_models_for_usual_pictures_are_left_as_they_are(usual, goal):
    assert usual.to(None, NAMES) is usual
    assert usual.normalized_goal(goal) is goal


def estimated(monkeypatch, usual, scene, goal, *, trusts):
    """What is found where an estimator trusts only these models, and what it was given."""
    given = []

    def steps(models, seen, *_):
        given.append((models, seen.images[0]))
        found = sure(STATE, ("", "") if models is trusts else ("it differs", ""))
        yield EstimateStep(Progress(1, 2, "Looking"), "together", STATE)
        yield EstimateStep(Progress(2, 2, "Done"), "done", STATE, estimate=found)

    monkeypatch.setattr(module, "estimate_goal", steps)
    told = list(estimate_goal_image(usual, scene, goal, STATE, None))
    assert [step.estimate is None for step in told] == [True] * (len(told) - 1) + [False]
    return told[-1], given


def test_a_goal_image_is_taken_as_the_first_frame_was(monkeypatch, usual, goal):
    scene = usual.to(OTHER, NAMES)
    last, given = estimated(monkeypatch, usual, scene, goal, trusts=scene.models)
    assert last.image_model is OTHER
    ((_, image),) = given
    np.testing.assert_array_equal(image, scene.normalized_goal(goal).image)


def test_a_goal_image_that_the_cameras_would_not_take_is_tried_as_a_usual_one(monkeypatch, usual, goal):
    scene = usual.to(OTHER, NAMES)
    last, given = estimated(monkeypatch, usual, scene, goal, trusts=usual.models)
    assert last.image_model is None
    assert last.estimate.trusted
    np.testing.assert_array_equal(given[1][1], goal.image)


def test_a_goal_image_that_nothing_explains_stays_the_cameras_own(monkeypatch, usual, goal):
    last, _ = estimated(monkeypatch, usual, usual.to(OTHER, NAMES), goal, trusts=None)
    assert last.image_model is OTHER
    assert last.estimate.reason


def test_usual_pictures_are_looked_at_once(monkeypatch, usual, goal):
    last, given = estimated(monkeypatch, usual, usual, goal, trusts=None)
    assert (last.image_model, len(given)) == (None, 1)
