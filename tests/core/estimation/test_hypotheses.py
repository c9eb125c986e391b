from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses import (
    OUT_OF_VIEW,
    SceneAssembly,
    TemplateMatches,
    compare_orientations,
    count_of_scenes,
    match_templates,
    reassign_poses,
    scene_errors,
    side_hypotheses,
    table_errors,
    without_objects,
    yaw_hypotheses,
)
from osfcore.estimation.objective import QUALITY, views_of
from osfcore.estimation.search import GaussNewtonState, lit_table_level
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from tests.support.posed_scenes import BOTTLE, BOX, apart, lying, observe, own_views, params_of, scene, shipped_models
from tests.support.rendered_scenes import state

# Orientation hypotheses


@pytest.fixture(scope="module")
def coarse(models, truth):
    return own_views(models, params_of(truth), default_cameras(48)[:3])


@pytest.fixture(scope="module")
def fine(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


@pytest.mark.parametrize("hypotheses", [yaw_hypotheses, side_hypotheses])
def test_an_object_that_lies_otherwise_is_turned_back(models, truth, coarse, fine, hypotheses):
    right = params_of(truth)
    others = hypotheses(models, right, 0)
    wrong = right.with_pose(0, others[int(np.argmax(rotation_angle(others.quaternion, right.quaternions[0])))])
    before = GaussNewtonState.at(wrong)
    at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, hypotheses(models, wrong, 0))
    shift, turn, _ = apart(at.params, truth)
    assert shift[0] < 0.002
    assert turn[0] < np.deg2rad(2)
    assert ratio > 1.5
    np.testing.assert_array_equal(at.params.positions[1], wrong.positions[1])


def test_the_right_pose_stays(models, truth, coarse, fine):
    before = GaussNewtonState.at(params_of(truth))
    flips = yaw_hypotheses(models, before.params, 0)
    for others, least in ((flips, 1.5), (truth.poses[[0, 0]], np.inf)):  # poses like its own are no rivals
        at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, others)
        assert at is before
        assert ratio >= least


def test_a_ball_of_one_colour_is_a_close_call(plain):
    """It looks alike however it lies, up to the noise of the images."""
    params = params_of(state({"ball": (0, 0, 0.05)}, (0, 0.6, 0.8)))
    views = own_views(plain, params, default_cameras(48)[:2])
    noise = np.random.default_rng(0).normal(0, 0.02, views.images.shape).astype(np.float32)
    views = replace(views, images=views.images + noise)
    at, others = GaussNewtonState.at(params), yaw_hypotheses(plain, params, 0)
    _, ratio = compare_orientations(plain, views, views, views, at, 0, others)
    assert 1 <= ratio < 1.05


# Template matching


def image_of(models, state, side=48, camera=None):
    return views_of(observe(models, state, [camera or goal_camera(96)], masks=False), side)


def ways(models, name, number):
    """An object as it lies, turned in any direction: orientations and heights of its origin."""
    resting = models.resting(name)
    own = np.arange(24) + number // 24 * 24
    heights = resting.heights[own] - rotate(resting.quaternions[own], resting.centre)[:, 2]
    return resting.quaternions[own], heights


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.18, 0.12), (0.0, 0.0), (0.05, -0.19)])
@pytest.mark.parametrize(("name", "number"), [(BOX, 30), (BOTTLE, 55)])
def test_an_object_is_found_wherever_it_lies(models, name, number, place):
    pose = lying(models, name, number, *place)
    for light in ((0.5, 0.3, 0.8), (-0.8, 0.1, 0.4)):
        found = match_templates(
            models, image_of(models, scene({name: pose}, light)), name, *ways(models, name, number), most=20
        )
        near = np.linalg.norm(found.poses.position - pose.position, axis=1) < 0.02
        alike = rotation_angle(found.poses.quaternion, pose.quaternion) < np.deg2rad(20)
        assert (near & alike)[:10].any()
        assert near[0]
        assert np.all(np.diff(found.scores) <= 0)


@pytest.mark.slow
def test_where_the_light_on_the_table_is_known_grey_things_are_not_table():
    name, light = "021_bleach_cleanser", np.array((-0.842, 0.483, 0.242))  # white, under a lamp at 14 deg
    bottle = shipped_models((name,))
    pose = lying(bottle, name, 2, 0.068, -0.051)
    views = image_of(bottle, scene({name: pose}, light), side=96)
    lit = lit_table_level(bottle, views)
    assert lit == pytest.approx(light[2] / np.linalg.norm(light), abs=0.01)
    drawn = views_of(observe(bottle, scene({name: pose}, light), [goal_camera(96)]), 96)
    on_bottle = drawn.masks[0, 0] > 0.9
    at_will, known = (table_errors(bottle, views, level) for level in (None, lit))
    assert known[on_bottle].mean() > 3 * at_will[on_bottle].mean()
    assert (known >= at_will - 1e-6).all()
    empty = image_of(bottle, scene({}, light), side=96)
    assert table_errors(bottle, empty, lit)[2:].max() < 1e-3
    found = match_templates(bottle, views, name, *ways(bottle, name, 2), most=20)
    assert np.linalg.norm(found.poses.position[0] - pose.position) < 0.02


@pytest.mark.slow
def test_what_a_known_scene_leaves_unexplained(models, truth):
    views = image_of(models, truth, side=96)
    names, params = truth.names, params_of(truth)
    missing = names.index(BOX)
    explained, unexplained = (scene_errors(models, views, g) for g in (params, without_objects(params, [missing])))
    assert explained.mean() < 0.3 * unexplained.mean()  # what is left are edges
    quaternions = truth.poses.quaternion[[missing]]
    heights = truth.poses.position[[missing], 2]
    found = match_templates(models, views, BOX, quaternions, heights, most=20, behind=unexplained)
    assert np.linalg.norm(found.poses.position[0] - truth.poses.position[missing]) < 0.02
    nothing_left = match_templates(models, views, BOX, quaternions, heights, most=20, behind=explained)
    assert nothing_left.scores.max() < 0.3 * found.scores[0]


@pytest.mark.parametrize("target", [(0, -3.0, 3.0), (3.0, 0.5, 0.5)])
def test_a_camera_that_looks_elsewhere_sees_nothing(models, target):
    camera = Camera.look_at("goal", (0, -0.45, 0.8), target, size=48)
    found = match_templates(models, image_of(models, scene({}), 48, camera), BOX, *ways(models, BOX, 30), most=20)
    assert len(found.scores) == len(found.poses.position) == 0


# Scene assembly


@pytest.fixture(scope="module")
def views(models, truth):
    seen = observe(models, truth, [goal_camera(64)], masks=False)
    return views_of(seen, 32), views_of(seen, 64)


@pytest.fixture(scope="module")
def empty(truth):
    """Nothing on the table, under a light that is far from the right one."""
    return without_objects(replace(params_of(truth), light=np.array([0.0, -0.6, 0.8])), (0, 1))


def sightings_at(truth, *shifts) -> list[TemplateMatches]:
    """Each object where it is, but for shifts [m], in this order."""
    scores = np.arange(len(shifts), 0.0, -1)
    return [
        TemplateMatches(Pose(one.position + np.array(shifts), np.tile(one.quaternion, (len(shifts), 1))), scores)
        for one in (truth.poses[0], truth.poses[1])
    ]


@pytest.mark.slow
def test_the_right_sightings_and_the_light_are_found_together(models, truth, views, empty):
    matches = sightings_at(truth, (0.07, 0, 0), (0, 0.05, 0), (0, 0, 0), (-0.1, 0.02, 0))
    steps = list(SceneAssembly(models, *views, matches).scenes(empty))
    assert len(steps) == count_of_scenes(2)
    assert np.all(np.diff([loss for _, loss in steps[:8]]) <= 0)  # the lights to begin with are more than these
    shift, turn, light = apart(steps[-1][0], params_of(truth))
    assert shift.max() == 0
    assert turn.max() < 1e-6
    assert np.rad2deg(light) < 5


@pytest.mark.slow
def test_one_that_stands_in_anothers_place_is_moved(models, truth, views, empty):
    own, other = truth.poses.position
    matches = sightings_at(truth, (0, 0, 0), other - own)
    matches[1] = sightings_at(truth, (0, 0, 0), own - other)[1]
    swapped = empty.with_pose(0, matches[0].poses[1]).with_pose(1, matches[1].poses[1])
    params, _ = list(SceneAssembly(models, *views, matches).scenes(swapped))[-1]
    assert apart(params, params_of(truth))[0].max() == 0


def test_what_hides_is_put_where_it_was_seen_and_what_explains_the_image_stays(models, truth, views):
    right, matches = params_of(truth), sightings_at(truth, (0.07, 0, 0), (0, 0, 0))
    params = reassign_poses(models, views[1], right.with_pose(1, OUT_OF_VIEW), matches)
    assert apart(params, right)[0].max() == 0
    assert reassign_poses(models, views[1], right, sightings_at(truth, (0.07, 0, 0), (0.01, 0, 0))) is right
