"""The table's plane from points, and what it tells of poses."""

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import resting_orientations
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.photo.pose_loss import TablePrior
from osfcore.photo.poses import table_from_points
from tests.core.photo.conftest import NAME


@pytest.mark.parametrize("seed", range(5))
def test_points_on_the_table_get_height_zero_despite_outliers(seed):
    rng = np.random.default_rng(seed)
    T_camera_world = Pose(np.array([0.1, 0, 0.8]), quaternion_exp(np.array([2.4, 0.2 * rng.normal(), 0.1])))
    flat = np.concatenate([rng.uniform(-0.3, 0.3, (500, 2)), rng.normal(0, 1e-3, (500, 1))], axis=1)
    points = np.concatenate([T_camera_world.apply(flat), rng.uniform(-0.3, 1, (200, 3))])
    found = table_from_points(points, rng)
    assert np.abs(found.apply(points[:500])[:, 2]).max() < 6e-3
    assert found.position[2] > 0.3  # the camera is above


def test_points_everywhere_are_no_table():
    with pytest.raises(InvalidInput, match="points on one plane"):
        table_from_points(np.random.default_rng(0).uniform(-1, 1, (500, 3)), np.random.default_rng(0))


@pytest.fixture(scope="module")
def lying(fields):
    resting = resting_orientations(fields[NAME])
    pose = Pose(np.zeros(3), resting.quaternions[0])
    return TablePrior(resting), Pose(np.array([0.1, 0.2, -resting.lowest(pose)]), resting.quaternions[0])


def batch(*poses):
    return Pose(np.stack([p.position for p in poses]), np.stack([p.quaternion for p in poses]))


def test_what_stands_on_the_table_pays_nothing_and_the_rest_a_bounded_price(lying):
    prior, pose = lying
    high = Pose(pose.position + [0, 0, 0.3], pose.quaternion)
    leaning = Pose(
        pose.position + [0, 0, 0.3], quaternion_multiply(quaternion_exp(np.array([0.7, 0, 0])), pose.quaternion)
    )
    penalties = prior.penalties(batch(pose, high, leaning))
    assert penalties[0] < 0.1
    np.testing.assert_allclose(penalties[1:], [100 + penalties[0], 200], rtol=0.1)


def test_a_gauss_newton_step_brings_it_back_to_the_table(lying):
    prior, pose = lying
    turn = quaternion_exp(np.array([0.03, -0.05, 0.4]))
    moved = Pose(pose.position + [0, 0, 6e-3], quaternion_multiply(turn, pose.quaternion))
    before = prior.penalties(batch(moved))[0]
    for _ in range(3):
        normal, right = prior.normal_equations(moved)
        step = np.linalg.solve(normal + 1e-6 * np.eye(6), right)
        moved = Pose(moved.position + step[:3], quaternion_multiply(quaternion_exp(step[3:]), moved.quaternion))
    assert prior.penalties(batch(moved))[0] < 0.05 * before
