import numpy as np
from scipy.spatial.transform import Rotation

from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from osfcore.photo.pose_loss import PoseLoss, draw, object_windows, surfels_of
from osfcore.photo.poses import distinct, moved, poses_around, poses_from_mask, super_fibonacci
from tests.core.photo.conftest import NAME


def test_super_fibonacci_rotations_are_everywhere():
    spiral = super_fibonacci(3000)
    np.testing.assert_allclose(np.linalg.norm(spiral, axis=1), 1, atol=1e-12)
    asked = Rotation.random(200, random_state=1).as_quat(scalar_first=True)
    nearest = np.array([rotation_angle(spiral, q).min() for q in asked])
    assert np.rad2deg(nearest.max()) < 20


def test_outlines_are_put_where_the_mask_is(fields, taken):
    loss = PoseLoss(object_windows([taken.photo], NAME, 44), surfels_of(fields[NAME], 0.004))
    poses = poses_from_mask(loss, super_fibonacci(50))
    window = loss.windows[0]
    shown = draw(loss.surfels, window, poses)[0] >= 0
    areas = shown.sum(axis=(1, 2)) / window.mask.sum()
    assert np.all(np.abs(areas - 1) < 0.25)
    rows, columns = np.mgrid[: window.size[0], : window.size[1]] + 0.5
    centres = np.stack([(shown * a).sum(axis=(1, 2)) / shown.sum(axis=(1, 2)) for a in (columns, rows)], axis=1)
    assert np.abs(centres - window.centroid).max() < 2


def test_steps_are_taken_along_the_cameras_axes(taken):
    window = object_windows([taken.photo], NAME, 44)[0]
    steps = np.array([[0.01, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.2, 0]])
    poses = moved(taken.pose, window, steps)
    np.testing.assert_allclose(poses.position[0] - taken.pose.position, [0.01, 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses.position[1], taken.pose.position, atol=1e-12)
    np.testing.assert_allclose(rotation_angle(poses.quaternion[1], taken.pose.quaternion), 0.2, atol=1e-12)


def test_the_given_pose_is_among_those_around_it(taken):
    window = object_windows([taken.photo], NAME, 44)[0]
    poses = poses_around(taken.pose, window, 20, np.random.default_rng(0))
    np.testing.assert_allclose(poses.position[0], taken.pose.position, atol=1e-12)


def test_distinct_poses_are_the_best_and_differ():
    angles = np.array([0.0, 0.05, 0.5, 1.0, 1.02])
    turns = quaternion_exp(np.stack([angles, 0 * angles, 0 * angles], axis=1))
    losses = np.array([0.3, 0.1, 0.5, 0.2, 0.4])
    assert distinct(Pose(np.zeros((5, 3)), turns), losses, 3, 10.0) == [1, 3, 2]
