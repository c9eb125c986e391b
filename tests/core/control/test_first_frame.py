"""First frame: first frame, prepared look."""

import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.closed_loop import Episode
from osfcore.control.events import EpisodeSettings, GoalFound, Looking, Noticed, Stepped
from osfcore.control.first_frame import (
    PreparedLook,
    PreparedLooks,
    estimate_first,
    prepared_from_json,
    prepared_to_json,
)
from osfcore.control.goal import GoalImage
from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import ImageModel, srgb_of_linear
from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.first_frame import estimate_first as estimate_usual
from osfcore.estimation.objective import views_of
from osfcore.estimation.photometry import adapted
from osfcore.estimation.search import check_table
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.planning.mppi import PlanSettings
from tests.core.control.scenes import CAN, sure, table
from tests.core.control.scenes import models as prepared_look_models
from tests.core.estimation.scenes import BOTTLE, BOX, NAMES, apart, lying, observe, scene, shipped_models

# First frames of pictures whose exposure, response, ambient light and table nobody tells.


BRICK = "061_foam_brick"
QUICK = FirstFrameConfig(2, 6, 2, 8, 2, 3, 2)
OTHER = ImageModel(np.array([0.75, 0.75, 0.75]), 1.8, np.array([0.5, 0.7, 0.9]))


@pytest.fixture(scope="module")
def models():
    return shipped_models()


@pytest.fixture(scope="module")
def truth(models):
    return scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)})


def steps_of(estimate, models, seen, config=QUICK):
    return list(estimate(models, seen, np.random.default_rng(0), config))


@pytest.mark.slow
def test_usual_pictures_are_estimated_as_ever_to_the_last_bit(models, truth):
    seen = observe(models, truth, default_cameras(48)[2:])
    ours, usual = (steps_of(estimate, models, seen)[-1].estimate for estimate in (estimate_first, estimate_usual))
    np.testing.assert_array_equal(ours.state.poses.position, usual.state.poses.position)
    np.testing.assert_array_equal(ours.state.light.direction, usual.state.light.direction)
    np.testing.assert_array_equal(ours.position_std, usual.position_std)


@pytest.mark.slow
def test_usual_pictures_have_no_image_model_of_their_own(models, truth):
    assert steps_of(estimate_first, models, observe(models, truth, default_cameras(48)[2:]))[-1].image_model is None


@pytest.mark.slow
def test_usual_pictures_of_one_plain_object_under_a_high_lamp_are_taken_for_usual():
    """No full shadow is seen, and a fit of exposure, ambient light and table explains the lamp in another way."""
    light, models = Light.from_angles(*np.deg2rad([-60, 72])).direction, shipped_models((BRICK,))
    alone = scene({BRICK: lying(models, BRICK, 30, 0.05, -0.08)}, light)
    seen = observe(models, alone, default_cameras(128))
    assert check_table(models, views_of(seen, 128)).verdict == "unclear"
    last = steps_of(estimate_first, models, seen, FirstFrameConfig())[-1]
    assert last.image_model is None
    assert np.rad2deg(last.estimate.state.light.angle_to(alone.light)) < 4
    assert last.estimate.trusted


@pytest.mark.slow
def test_poses_and_light_of_an_srgb_picture_of_another_table_at_another_exposure(models, truth):
    shown = observe(adapted(models, NAMES, OTHER), truth, default_cameras(96)[1:])
    linear = np.clip(shown.images * (OTHER.gain / OTHER.scale), 0, 1)
    steps = steps_of(estimate_first, models, replace(shown, images=srgb_of_linear(linear)))
    estimate = steps[-1].estimate
    shift, turn, light = apart(estimate.state, truth)
    assert shift.max() < 0.005
    assert np.rad2deg(turn).max() < 5
    assert np.rad2deg(light) < 5
    assert estimate.trusted, estimate.reason
    found = steps[-1].image_model
    assert found.encoding == "srgb"
    np.testing.assert_allclose([*found.gain, found.ambient], [*OTHER.gain, OTHER.ambient], rtol=0.15)
    done = [step.progress.done for step in steps]
    assert done == sorted(set(done))
    assert {step.progress.total for step in steps} == {done[-1]}
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]


@pytest.mark.slow
@pytest.mark.parametrize("wall", [0.05, 0.25, 0.6])
def test_half_of_the_light_is_no_srgb_whatever_lies_beyond_the_table(models, truth, wall):
    dim = ImageModel(np.full(3, 0.5), 1.0, np.ones(3), surroundings=np.full(3, wall))
    shown = observe(adapted(models, NAMES, dim), truth, default_cameras(96)[1:])
    last = steps_of(estimate_first, models, replace(shown, images=shown.images * 0.5))[-1]
    assert last.image_model.encoding == "linear"
    np.testing.assert_allclose(last.image_model.gain, 0.5, rtol=0.1)
    assert np.rad2deg(apart(last.estimate.state, truth)[2]) < 2


@pytest.mark.slow
def test_black_pictures_are_not_trusted(models, truth):
    seen = observe(models, truth, default_cameras(48)[2:])
    last = steps_of(estimate_first, models, replace(seen, images=np.zeros_like(seen.images)))[-1]
    assert not last.estimate.trusted


def test_masks_are_needed(models, truth):
    seen = observe(models, truth, default_cameras(48)[:1], masks=False)
    with pytest.raises(InvalidInput, match="masks of the first frame"):
        next(estimate_first(models, seen, np.random.default_rng(0)))


# Prepared look


KNOWN = prepared_look_models()
SMALL = EpisodeSettings(steps=1, plan=PlanSettings(samples=16, horizon=4))


@pytest.fixture
def world(library):
    world = table(library)
    yield world
    world.close()


@pytest.fixture
def goal(world):
    camera = goal_camera()
    return GoalImage(camera, world.render((camera,), with_pusher=False).images[0])


@pytest.fixture
def prepared(world, goal):
    truth, seen = world.truth(), world.observe()
    of_goal = sure(replace(truth, pusher=None))
    return PreparedLooks(
        PreparedLook.of(KNOWN.appearance, seen, sure(truth)),
        PreparedLook.of(KNOWN.appearance, goal.observed(truth.names), of_goal),
    )


def test_it_explains_what_it_was_made_from_and_nothing_else(world, prepared):
    assert prepared.first.explains(KNOWN.appearance, world.observe())
    pose = world.truth().pose(CAN)
    world.move_object(CAN, Pose(pose.position + [0.02, 0.0, 0.0], pose.quaternion))
    assert not prepared.first.explains(KNOWN.appearance, world.observe())


@pytest.mark.slow
def test_an_episode_takes_what_fits_and_looks_itself_for_the_rest(world, goal, prepared):
    """The can is moved after the preparation: the first frame is estimated anew, the goal image is not."""
    pose = world.truth().pose(CAN)
    world.move_object(CAN, Pose(pose.position + [0.0, 0.05, 0.0], pose.quaternion))
    episode = Episode(world, KNOWN, goal, SMALL, np.random.default_rng(0), prepared=prepared)
    looks, prepared_of = {"first": 0, "goal": 0, "next": 0}, []
    for event in episode.run():
        if isinstance(event, Noticed) and event.matter == "prepared":
            prepared_of.append(event.text)
        if isinstance(event, Looking):
            looks[event.look] += 1
        if isinstance(event, Stepped):
            break
        if isinstance(event, GoalFound):
            np.testing.assert_allclose(event.goal.pose(CAN).position, pose.position, atol=1e-6)
    assert looks["first"] > 5
    assert looks["goal"] == 1
    assert prepared_of == ["The estimate of the goal image was prepared with this example."]
    truth = world.truth()
    np.testing.assert_allclose(event.estimate.state.poses.position, truth.poses.position, atol=3e-3)


def test_it_is_the_same_once_written_and_read(prepared):
    read = prepared_from_json(json.loads(json.dumps(prepared_to_json(prepared))))
    for mine, theirs in ((prepared.first, read.first), (prepared.goal, read.goal)):
        np.testing.assert_allclose(mine.residuals, theirs.residuals, atol=1e-6)
        np.testing.assert_allclose(mine.estimate.state.poses.position, theirs.estimate.state.poses.position, atol=1e-12)
        assert mine.estimate.state.names == theirs.estimate.state.names


@pytest.mark.parametrize("spoil", [{"goal": None}, {"first": {"estimate": {}, "residuals": []}}])
def test_what_is_not_whole_is_refused(prepared, spoil):
    with pytest.raises(InvalidInput):
        prepared_from_json({**prepared_to_json(prepared), **spoil})


def test_as_many_residuals_as_objects_are_needed(prepared):
    data = prepared_to_json(prepared)
    data["first"]["residuals"] = [0.1]
    with pytest.raises(InvalidInput, match="residuals"):
        prepared_from_json(data)
