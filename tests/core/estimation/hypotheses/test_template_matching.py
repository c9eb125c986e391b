from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses import TemplateMatches, match_templates, scene_errors, table_errors, without_objects
from osfcore.estimation.objective import views_of
from osfcore.estimation.search import lit_table_level
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.poses import rotate, rotation_angle
from tests.core.estimation.scenes import BOTTLE, BOX, lying, observe, params_of, scene, shipped_models

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
