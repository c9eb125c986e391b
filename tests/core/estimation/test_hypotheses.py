"""Hypotheses: orientation hypotheses, template matching, scene assembly."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses import (
    OUT_OF_VIEW,
    TemplateMatches,
    assemble_scene,
    compare_orientations,
    count_of_scenes,
    match_templates,
    reassign_poses,
    scene_errors,
    side_hypotheses,
    table_errors,
    with_pose,
    without_objects,
    yaw_hypotheses,
)
from osfcore.estimation.objective import QUALITY, SceneParameters, views_of
from osfcore.estimation.search import GaussNewtonState, lit_table_level
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.poses import rotate, rotation_angle
from tests.core.estimation.scenes import BOTTLE, BOX, apart, lying, observe, own_views, params_of, scene, shipped_models

# Orientation hypotheses


@pytest.fixture(scope="module")
def coarse(models, truth):
    return own_views(models, params_of(truth), default_cameras(48)[:3])


@pytest.fixture(scope="module")
def fine(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


@pytest.fixture(scope="module")
def flips(models, truth):
    """Ways in which the box is turned about the vertical."""
    return yaw_hypotheses(models, params_of(truth), 0)


def flipped(params, flips) -> SceneParameters:
    return with_pose(params, 0, flips[11])  # half a turn


def test_turned_in_place_about_the_vertical(models, truth, flips):
    assert len(flips.position) == 23
    centre = models.resting(truth.names[0]).centre
    pose = truth.poses[0]
    np.testing.assert_allclose(
        rotate(flips.quaternion, centre) + flips.position, np.tile(pose.apply(centre), (23, 1)), atol=1e-12
    )
    angles = np.rad2deg(rotation_angle(flips.quaternion, pose.quaternion))
    np.testing.assert_allclose(np.sort(angles), np.sort([15 * min(k, 24 - k) for k in range(1, 24)]), atol=1e-6)
    up = rotate(flips.quaternion * [1, -1, -1, -1], np.array([0, 0, 1.0]))
    np.testing.assert_allclose(up, np.tile(up[0], (23, 1)), atol=1e-12)


def test_tipped_in_place_onto_each_other_side(models, truth):
    """Each pose rests on the table, on another side, and half of them are the others turned by 180 deg."""
    resting, pose = models.resting(truth.names[0]), truth.poses[0]
    sides = side_hypotheses(models, params_of(truth), 0)
    assert len(sides.position) >= 2
    middle = rotate(sides.quaternion, resting.centre) + sides.position
    np.testing.assert_allclose(middle[:, :2], np.tile(pose.apply(resting.centre)[:2], (len(middle), 1)), atol=1e-12)
    for side in sides:
        assert abs(resting.lowest(side)) < 3e-3  # the axis of half a turn is about the longest one
    up, now = (rotate(q * [1, -1, -1, -1], np.array([0, 0, 1.0])) for q in (sides.quaternion, pose.quaternion))
    assert (up @ now < np.cos(np.deg2rad(10))).all()
    half = len(sides.position) // 2
    np.testing.assert_allclose(up[:half], up[half:], atol=1e-12)
    between = rotation_angle(sides.quaternion[:half], sides.quaternion[half:])
    np.testing.assert_allclose(between, np.pi, atol=1e-6)


def test_an_object_on_its_other_side_is_tipped_over(models, truth, coarse, fine):
    right = params_of(truth)
    tipped = side_hypotheses(models, right, 0)
    farthest = int(np.argmax(rotation_angle(tipped.quaternion, right.quaternions[0])))
    wrong = with_pose(right, 0, tipped[farthest])
    at, ratio = compare_orientations(
        models, coarse, coarse, fine, GaussNewtonState.at(wrong), 0, side_hypotheses(models, wrong, 0)
    )
    shift, turn, _ = apart(at.params, truth)
    assert shift[0] < 0.002
    assert turn[0] < np.deg2rad(2)
    assert ratio > 1.5


def test_a_flipped_object_is_turned_round(models, truth, coarse, fine, flips):
    wrong = flipped(params_of(truth), flips)
    at, ratio = compare_orientations(
        models, coarse, coarse, fine, GaussNewtonState.at(wrong), 0, yaw_hypotheses(models, wrong, 0)
    )
    shift, turn, _ = apart(at.params, truth)
    assert shift[0] < 0.002
    assert turn[0] < np.deg2rad(2)
    assert ratio > 1.5
    np.testing.assert_array_equal(at.params.positions[1], wrong.positions[1])


def test_the_right_pose_stays(models, truth, coarse, fine, flips):
    before = GaussNewtonState.at(params_of(truth))
    at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, flips)
    assert at is before
    assert ratio > 1.5


def test_a_ball_of_one_colour_is_a_close_call(plain):
    """It looks alike however it lies, up to the noise of the images."""
    params = SceneParameters(
        ("ball",), np.array([[0, 0, 0.05]]), np.array([[1.0, 0, 0, 0]]), np.array([0, 0.6, 0.8]), None
    )
    views = own_views(plain, params, default_cameras(48)[:2])
    noise = np.random.default_rng(0).normal(0, 0.02, views.images.shape).astype(np.float32)
    views = replace(views, images=views.images + noise)
    _, ratio = compare_orientations(
        plain, views, views, views, GaussNewtonState.at(params), 0, yaw_hypotheses(plain, params, 0)
    )
    assert 1 <= ratio < 1.05


def test_poses_much_like_its_own_are_no_rivals(models, truth, coarse, fine):
    before = GaussNewtonState.at(params_of(truth))
    at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, truth.poses[[0, 0]])
    assert at is before
    assert ratio == np.inf


# Template matching


SLOW = pytest.mark.slow


def image_of(models, state, side=48, camera=None):
    return views_of(observe(models, state, [camera or goal_camera(96)], masks=False), side)


def ways(models, name, number):
    """An object as it lies, turned in any direction: orientations and heights of its origin."""
    resting = models.resting(name)
    own = np.arange(24) + number // 24 * 24
    heights = resting.heights[own] - rotate(resting.quaternions[own], resting.centre)[:, 2]
    return resting.quaternions[own], heights


@pytest.mark.parametrize(
    "place", [(0.18, 0.12), *(pytest.param(place, marks=SLOW) for place in ((0.0, 0.0), (-0.2, 0.05), (0.05, -0.19)))]
)
@pytest.mark.parametrize(("name", "number"), [(BOX, 30), (BOTTLE, 55)])
def test_an_object_is_found_wherever_it_lies(models, name, number, place):
    pose = lying(models, name, number, *place)
    for light in ((0.5, 0.3, 0.8), (-0.8, 0.1, 0.4)):
        found = match_templates(
            models, image_of(models, scene({name: pose}, light)), name, *ways(models, name, number), most=20
        )
        near = np.linalg.norm(found.positions - pose.position, axis=1) < 0.02
        alike = rotation_angle(found.quaternions, pose.quaternion) < np.deg2rad(20)
        assert (near & alike)[:10].any()
        assert near[0]


def test_sightings_are_in_order_differ_and_stay_at_their_heights(models, truth):
    views = image_of(models, truth)
    quaternions, heights = ways(models, BOX, 30)
    found = match_templates(models, views, BOX, quaternions, heights, most=30)
    assert 1 < len(found.scores) == len(found.positions) == len(found.quaternions) <= 30
    assert np.all(np.diff(found.scores) <= 0)
    assert np.abs(found.positions[:, None, 2] - heights).min(axis=1).max() < 1e-9
    for k in range(len(found.scores)):
        for o in range(k):
            distance = np.linalg.norm(found.positions[k] - found.positions[o])
            turn = rotation_angle(found.quaternions[k], found.quaternions[o])
            assert distance > 0.02 or turn > np.deg2rad(20) - 1e-9


def test_a_bare_table_has_no_errors_in_whatever_light(models):
    for light in ((0, 0, 1.0), (0.7, 0.2, 0.3)):
        assert table_errors(models, image_of(models, scene({}, light)))[1:].max() < 1e-3  # the first row is its edge
    shadow = image_of(models, scene({BOX: lying(models, BOX, 30, 0, 0)}, (0.3, 0, 1)))
    errors = table_errors(models, shadow)
    assert errors.max() > 0.01
    dim = replace(shadow, images=shadow.images * np.float32(0.8))
    np.testing.assert_allclose(table_errors(models, dim)[errors < 1e-4], 0, atol=2e-4)


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
    assert np.linalg.norm(found.positions[0] - pose.position) < 0.02


def test_what_a_known_scene_leaves_unexplained(models, truth):
    views = image_of(models, truth, side=96)
    names, params = truth.names, params_of(truth)
    missing = names.index(BOX)
    explained, unexplained = (scene_errors(models, views, g) for g in (params, without_objects(params, [missing])))
    assert explained.mean() < 0.3 * unexplained.mean()  # what is left are edges
    quaternions = truth.poses.quaternion[[missing]]
    heights = truth.poses.position[[missing], 2]
    found = match_templates(models, views, BOX, quaternions, heights, most=20, behind=unexplained)
    assert np.linalg.norm(found.positions[0] - truth.poses.position[missing]) < 0.02
    nothing_left = match_templates(models, views, BOX, quaternions, heights, most=20, behind=explained)
    assert nothing_left.scores.max() < 0.3 * found.scores[0]


@pytest.mark.parametrize("target", [(0, -3.0, 3.0), (3.0, 0.5, 0.5), (0, -2.0, 0.0)])
def test_a_camera_that_looks_elsewhere_sees_nothing(models, target):
    camera = Camera.look_at("goal", (0, -0.45, 0.8), target, size=48)
    found = match_templates(models, image_of(models, scene({}), 48, camera), BOX, *ways(models, BOX, 30), most=20)
    assert len(found.scores) == len(found.positions) == len(found.quaternions) == 0


def test_a_camera_among_the_objects_sees_what_is_before_it(models):
    camera = Camera.look_at("goal", (0.05, -0.05, 0.1), (0.0, 0.2, 0.0), size=32, fov_y_deg=70)
    state = scene({BOX: lying(models, BOX, 30, 0.0, 0.2)})
    found = match_templates(models, image_of(models, state, 32, camera), BOX, *ways(models, BOX, 30), most=100)
    near = np.linalg.norm(found.positions - state.poses.position[0], axis=1)
    assert near.min() < 0.04


def test_some_of_the_sightings():
    positions = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.1, 0, 0]])
    found = TemplateMatches(positions, np.tile([1.0, 0, 0, 0], (3, 1)), np.array([3.0, 2.0, 1.0]))
    np.testing.assert_array_equal(found.within(np.array([0.01, 0, 0]), 0.02).scores, [3, 2])
    np.testing.assert_array_equal(found.subset(np.array([2, 0])).scores, [1, 3])
    np.testing.assert_array_equal(found.pose(1).position, found.poses[1].position)
    assert len(found.within(np.array([1.0, 0, 0]), 0.1).scores) == 0


# Scene assembly


@pytest.fixture(scope="module")
def views(models, truth):
    seen = observe(models, truth, [goal_camera(64)], masks=False)
    return views_of(seen, 32), views_of(seen, 64)


@pytest.fixture(scope="module")
def empty(truth):
    """Nothing on the table, under a light that is far from the right one."""
    params = replace(params_of(truth), light=np.array([0.0, -0.6, 0.8]))
    return with_pose(with_pose(params, 0, OUT_OF_VIEW), 1, OUT_OF_VIEW)


def sightings_at(truth, *shifts) -> list[TemplateMatches]:
    """Each object where it is, but for shifts [m], in this order."""
    found = []
    for position, quaternion in zip(truth.poses.position, truth.poses.quaternion, strict=True):
        positions = position + np.array(shifts)
        found.append(TemplateMatches(positions, np.tile(quaternion, (len(shifts), 1)), np.arange(len(shifts), 0.0, -1)))
    return found


def test_the_right_sightings_and_the_light_are_found_together(models, truth, views, empty):
    matches = sightings_at(truth, (0.07, 0, 0), (0, 0.05, 0), (0, 0, 0), (-0.1, 0.02, 0))
    params, _ = list(assemble_scene(models, *views, empty, matches))[-1]
    shift, turn, light = apart(params, params_of(truth))
    assert shift.max() == 0
    assert turn.max() < 1e-6
    assert np.rad2deg(light) < 5


def test_one_that_stands_in_anothers_place_is_moved(models, truth, views, empty):
    own, other = truth.poses.position
    matches = sightings_at(truth, (0, 0, 0), other - own)
    matches[1] = sightings_at(truth, (0, 0, 0), own - other)[1]
    swapped = with_pose(with_pose(empty, 0, matches[0].pose(1)), 1, matches[1].pose(1))
    params, _ = list(assemble_scene(models, *views, swapped, matches))[-1]
    assert apart(params, params_of(truth))[0].max() == 0


def test_losses_fall_within_each_part_and_the_count_is_known(models, truth, views, empty):
    steps = list(assemble_scene(models, *views, empty, sightings_at(truth, (0.03, 0, 0), (0, 0, 0))))
    assert len(steps) == count_of_scenes(2)
    rough = [loss for _, loss in steps[:8]]  # the lights to begin with are more than these
    assert np.all(np.diff(rough) <= 0)


@pytest.mark.slow
def test_what_nobody_sighted_stays_away(models, truth, views, empty):
    matches = [sightings_at(truth, (0, 0, 0))[0], TemplateMatches(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0))]
    params, _ = list(assemble_scene(models, *views, empty, matches))[-1]
    np.testing.assert_array_equal(params.positions[1], OUT_OF_VIEW.position)
    np.testing.assert_array_equal(params.positions[0], truth.poses.position[0])


def test_what_hides_is_put_where_it_was_seen(models, truth, views):
    matches = sightings_at(truth, (0.07, 0, 0), (0, 0, 0))
    hidden = with_pose(params_of(truth), 1, OUT_OF_VIEW)
    params = reassign_poses(models, views[1], hidden, matches)
    assert apart(params, params_of(truth))[0].max() == 0


def test_what_explains_the_image_stays(models, truth, views):
    right = params_of(truth)
    assert reassign_poses(models, views[1], right, sightings_at(truth, (0.07, 0, 0), (0.01, 0, 0))) is right
