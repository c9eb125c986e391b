import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import (
    Pose,
    fibonacci_sphere,
    planar_turn,
    quaternion_exp,
    quaternion_from_matrix,
    quaternion_log,
    quaternion_multiply,
    quaternion_to_matrix,
    rotate,
    rotation_angle,
    unit_quaternion,
)

vectors = arrays(float, 3, elements=st.floats(-2, 2))
turns = vectors.map(quaternion_exp)
poses = st.builds(Pose, vectors, turns)


def assert_same_pose(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-9)


@given(a=poses, b=poses, c=poses)
@settings(max_examples=40)
def test_poses_form_a_group(a, b, c):
    assert_same_pose((a @ b) @ c, a @ (b @ c))
    assert_same_pose(a @ Pose.identity(), a)
    assert_same_pose(a @ a.inverse(), Pose.identity())


@given(a=poses, b=poses, point=vectors)
@settings(max_examples=40)
def test_acting_is_multiplying_matrices(a, b, point):
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)
    assert_same_pose(Pose.from_matrix(a.matrix()), a)


@given(a=turns, b=turns, v=vectors)
@settings(max_examples=40)
def test_quaternions_agree_with_scipy(a, b, v):
    ra, rb = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    np.testing.assert_allclose(rotate(a, v), ra.apply(v), atol=1e-9)
    np.testing.assert_allclose(quaternion_to_matrix(quaternion_multiply(a, b)), (ra * rb).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(rotation_angle(a, b), (ra.inv() * rb).magnitude(), atol=1e-6)
    assert rotation_angle(a, -a) < 1e-9
    back = quaternion_from_matrix(quaternion_to_matrix(a))
    assert back[0] >= 0
    assert rotation_angle(back, a) < 1e-6


@given(v=vectors.filter(lambda v: np.linalg.norm(v) < np.pi - 1e-3))
@settings(max_examples=40)
def test_log_undoes_exp(v):
    np.testing.assert_allclose(quaternion_log(quaternion_exp(v)), v, atol=1e-9)


def test_batches_broadcast_and_are_joined():
    batch = Pose(np.arange(6.0).reshape(2, 3), quaternion_exp(np.array([[0, 0, 0.5], [0.2, 0, 0]])))
    one = batch[1]
    assert_same_pose((one @ batch)[0], one @ batch[0])
    np.testing.assert_allclose(one.apply(np.zeros((5, 3))), np.tile(one.position, (5, 1)), atol=1e-12)
    assert_same_pose(Pose.joined(Pose.identity(3), batch)[3:], batch)
    assert_same_pose(Pose.stacked([batch[0], one]), batch)


@given(turn=turns)
@settings(max_examples=40)
def test_unit_quaternions_come_back_bit_by_bit_and_others_are_normalised_or_refused(turn):
    np.testing.assert_array_equal(unit_quaternion(turn), turn)
    assert np.linalg.norm(unit_quaternion(turn * 1.0004)) == pytest.approx(1, abs=1e-15)
    for bad in (2 * turn, 0 * turn, np.nan * turn):
        with pytest.raises(InvalidInput):
            unit_quaternion(bad)


@pytest.mark.parametrize("count", [1, 50, 1000])
def test_a_fibonacci_sphere_is_spread_evenly(count):
    directions = fibonacci_sphere(count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=2 / count)
    if count > 1:  # each has a neighbour at about the distance of an even spread
        nearest = np.arccos(np.clip(directions @ directions.T - 2 * np.eye(count), -1, 1)).min(axis=1)
        assert np.ptp(nearest * np.sqrt(count)) < 1.5
        assert nearest.min() * np.sqrt(count) > 2.5


@pytest.mark.parametrize("yaw", [-3.0, -0.1, 0.0, 1.5])
def test_a_turn_about_the_vertical_is_found_and_a_tilt_is_none(yaw):
    before = quaternion_exp(np.array([0.4, -1.0, 0.3]))
    after = quaternion_multiply(quaternion_exp(np.array([0.0, 0.0, yaw])), before)
    assert planar_turn(before, after) == pytest.approx(yaw, abs=1e-9)
    assert planar_turn(before, quaternion_multiply(quaternion_exp(np.array([0.2, 0.0, 0.0])), after)) is None
