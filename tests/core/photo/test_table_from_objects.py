"""The table from how objects lie on it."""

import numpy as np
import pytest

from osfcore.estimation.objective import resting_orientations
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.photo.pose_loss import TablePrior
from osfcore.photo.poses import table_from_objects

T_CAMERA_WORLD = Pose(np.array([0.05, -0.02, 0.8]), quaternion_exp(np.array([2.3, 0.2, 0.1])))


@pytest.fixture(scope="module")
def resting(fields):
    return [resting_orientations(field) for field in fields.values()]


def standing(resting, number, x, y):
    turned = Pose(np.zeros(3), resting.quaternions[number])
    return T_CAMERA_WORLD @ Pose(np.array([x, y, -resting.lowest(turned)]), turned.quaternion)


def test_objects_that_stand_on_a_table_tell_where_it_is(resting):
    poses = [standing(r, k, 0.1 * k, -0.05 * k) for k, r in enumerate(resting)]
    found = table_from_objects([TablePrior(r) for r in resting], poses)
    assert found.supported == (0, 1)
    table = T_CAMERA_WORLD.apply(np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) * [1, 1, 0])
    np.testing.assert_allclose(found.T_world_camera.apply(table)[:, 2], 0, atol=3e-3)
    assert found.T_world_camera.position[2] > 0.3
    assert found.spread_deg < 2


def test_errors_of_the_poses_average_out(resting):
    rng = np.random.default_rng(1)
    both = [r for r in resting for _ in range(3)]
    poses = []
    for k, r in enumerate(both):
        turn = quaternion_exp(np.deg2rad(4) * rng.normal(size=3) / np.sqrt(3))
        pose = standing(r, k % 24, *rng.uniform(-0.2, 0.2, 2))
        poses.append(Pose(pose.position, quaternion_multiply(turn, pose.quaternion)))
    found = table_from_objects([TablePrior(r) for r in both], poses)
    up = found.T_world_camera.inverse().matrix()[:3, 2]
    true = T_CAMERA_WORLD.matrix()[:3, 2]
    assert np.rad2deg(np.arccos(up @ true)) < 4


def test_one_object_does_not_tell(resting):
    assert table_from_objects([TablePrior(resting[0])], [standing(resting[0], 0, 0, 0)]) is None
