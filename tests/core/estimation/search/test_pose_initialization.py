from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import crop_to_masks, render_poses, views_of
from osfcore.estimation.search import OVERHEAD, RankedPoses, initial_poses, rank_poses
from osfcore.geometry.poses import quaternion_exp, rotation_angle
from tests.core.estimation.scenes import BOTTLE, BOX


@pytest.fixture(scope="module")
def parts(seen, models):
    views = views_of(seen, 64)
    return {name: crop_to_masks(views, number) for number, name in enumerate(seen.names)}


@pytest.fixture(scope="module")
def starts(models, parts):
    return {name: initial_poses(models, name, part) for name, part in parts.items()}


def centroid(weights):
    rows, columns = np.indices(weights.shape) + 0.5
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


@pytest.mark.parametrize("name", [BOX, BOTTLE])
def test_every_way_to_lie_is_ranked(models, starts, name):
    found, resting = starts[name], models.resting(name)
    assert len(found.positions) == len(found.quaternions) == len(found.losses) == len(resting.heights)
    assert np.all(np.diff(found.losses) >= 0)
    assert {tuple(q) for q in found.quaternions} == {tuple(q) for q in resting.quaternions}


@pytest.mark.parametrize("name", [BOX, BOTTLE])
def test_among_the_first_is_the_truth(truth, starts, name):
    found, pose = starts[name].best(12), truth.pose(name)
    turns = rotation_angle(found.quaternions, pose.quaternion)
    best = int(turns.argmin())
    assert turns[best] < np.deg2rad(10)
    assert np.linalg.norm(found.positions[best] - pose.position) < 0.012


def test_all_are_put_where_the_masks_are(models, parts, starts):
    part, found = parts[BOX], starts[BOX]
    look = render_poses(models, BOX, part, found.positions, found.quaternions, OVERHEAD)
    off = [
        np.linalg.norm(centroid(shown[v] * part.valid[v]) - centroid(part.mask[v] * part.valid[v]))
        for shown in look.opacity
        for v in range(len(part.cameras))
    ]
    assert np.median(off) < 2
    assert max(off) < 8


def test_one_view_is_enough(models, truth, parts):
    part = parts[BOX]
    single = replace(part, cameras=part.cameras[:1], rgb=part.rgb[:1], mask=part.mask[:1], valid=part.valid[:1],
                     area=part.area[:1])  # fmt: skip
    found, pose = initial_poses(models, BOX, single), truth.pose(BOX)
    turns = rotation_angle(found.quaternions, pose.quaternion)
    assert np.linalg.norm(found.positions[turns.argmin()] - pose.position) < 0.02
    assert turns.argmin() < len(turns) / 4


def test_under_the_right_light_the_truth_comes_first(models, truth, parts, starts):
    found, pose = starts[BOX], truth.pose(BOX)
    positions = np.concatenate([found.positions, pose.position[None]])
    quaternions = np.concatenate([found.quaternions, pose.quaternion[None]])
    order = rank_poses(models, BOX, parts[BOX], positions, quaternions, truth.light.direction)
    assert np.all(np.diff(order.losses) >= 0)
    assert rotation_angle(order.quaternions[0], pose.quaternion) < np.deg2rad(5)
    assert np.linalg.norm(order.positions[0] - pose.position) < 0.004
    assert pose.quaternion in order.quaternions[:3]


def test_the_best_and_the_distinct():
    angles = np.deg2rad([0, 10, 40, 50, 90, 20])
    turns = quaternion_exp(np.outer(angles, [0, 0, 1.0]))
    starts = RankedPoses(np.arange(18.0).reshape(6, 3), turns, np.arange(6.0))
    assert starts.best(2).losses.tolist() == [0, 1]
    assert starts.best(9).losses.tolist() == [0, 1, 2, 3, 4, 5]
    assert starts.distinct(2).losses.tolist() == [0, 2]
    assert starts.distinct(9).losses.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(starts.distinct(9).positions, starts.positions[[0, 2, 4]])
    turned = replace(starts, quaternions=-turns)  # which is the same orientation
    assert turned.distinct(9).losses.tolist() == [0, 2, 4]
