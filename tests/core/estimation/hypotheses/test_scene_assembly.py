from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses import (
    OUT_OF_VIEW,
    TemplateMatches,
    assemble_scene,
    count_of_scenes,
    reassign_poses,
    with_pose,
)
from osfcore.estimation.objective import views_of
from osfcore.geometry.cameras import goal_camera
from tests.core.estimation.scenes import apart, observe, params_of


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
