from dataclasses import replace

import numpy as np
import pytest

from app.episodes.look_pictures import SIDE, LookPictures
from osfcore.control.events import Finished, Looking, Observed
from osfcore.control.goal import GoalImage
from osfcore.estimation.steps import EstimateStep
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.progress import Progress
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import PLANNING, SceneBatch
from tests.app.processes.conftest import BOX


@pytest.fixture(scope="module")
def renderer(fields_dir):
    fields = FieldLibrary(fields_dir)
    return SceneRenderer({BOX: fields.load(BOX)}, fields.load_table())


@pytest.fixture
def now_s():
    return [0.0]


@pytest.fixture
def pictures(renderer, state, now_s):
    """Of an episode whose table and goal look like the state."""
    camera = goal_camera(SIDE)
    image = renderer.render(SceneBatch.of(replace(state, pusher=None)), (camera,)).rgb[0, 0]
    pictures = LookPictures(renderer, GoalImage(camera, image), lambda: now_s[0])
    cameras = default_cameras(SIDE)
    images = renderer.render(SceneBatch.of(state), cameras).rgb[0]
    seen = Observed(0, Observation(cameras, images, state.names, None, state.pusher, 0.0))
    assert pictures.drawn(seen) is seen
    return pictures


def looking(state, look="first"):
    return Looking(0, look, EstimateStep(Progress(1, 2, ""), "light", state))


def moved(state, *by_m):
    return replace(state, poses=Pose(state.poses.position + by_m, state.poses.quaternion))


@pytest.mark.parametrize(
    ("look", "cameras"), [("first", default_cameras()), ("search", default_cameras()), ("goal", (goal_camera(),))]
)
def test_the_difference_falls_to_almost_nothing_as_the_estimate_nears_the_truth(pictures, now_s, state, look, cameras):
    differences = []
    for shift in (0.08, 0.02, 0.0):
        now_s[0] += 1
        event = pictures.drawn(looking(moved(state, shift, 0, 0), look))
        differences.append(event.difference)
        assert set(event.rendered) == {camera.name for camera in cameras}
        assert {image.shape for image in event.rendered.values()} == {(SIDE, SIDE, 3)}
    assert differences[0] > differences[1] > differences[2]
    assert differences[2] < 0.03


def test_what_was_not_looked_at_yet_is_not_in_the_picture(renderer, pictures, state):
    without = pictures.drawn(looking(moved(state, 0, 0, -1)))
    for camera in default_cameras(SIDE):
        bare = renderer.render(SceneBatch.of(state.reordered(())), (camera,), quality=PLANNING).rgb[0, 0]
        np.testing.assert_allclose(without.rendered[camera.name] / 255, bare, atol=0.01)


def test_steps_in_between_show_the_latest_picture_of_the_same_look(pictures, state):
    first = pictures.drawn(looking(state))
    assert pictures.drawn(looking(moved(state, 0.1, 0, 0))).rendered is first.rendered
    assert set(pictures.drawn(looking(state, "goal")).rendered) == {goal_camera().name}


def test_quick_looks_and_other_events_stay_as_they_are(pictures, state):
    quick = looking(state, "next")
    assert pictures.drawn(quick) is quick
    over = Finished(3, "reached", "There.", state)
    assert pictures.drawn(over) is over
