import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import (
    Pose,
    planar_turn,
    quaternion_conjugate,
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
def test_poses_form_a_group(a, b, c):
    assert_same_pose((a @ b) @ c, a @ (b @ c))
    assert_same_pose(a @ Pose.identity(), a)
    assert_same_pose(a @ a.inverse(), Pose.identity())


@given(a=poses, b=poses, point=vectors)
def test_acting_is_multiplying_matrices(a, b, point):
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)
    assert_same_pose(Pose.from_matrix(a.matrix()), a)


@given(a=turns, b=turns, v=vectors)
def test_quaternions_agree_with_scipy(a, b, v):
    ra, rb = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    np.testing.assert_allclose(rotate(a, v), ra.apply(v), atol=1e-9)
    np.testing.assert_allclose(quaternion_to_matrix(quaternion_multiply(a, b)), (ra * rb).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(rotation_angle(a, b), (ra.inv() * rb).magnitude(), atol=1e-6)


@given(v=vectors.filter(lambda v: np.linalg.norm(v) < np.pi - 1e-3))
def test_log_undoes_exp(v):
    np.testing.assert_allclose(quaternion_log(quaternion_exp(v)), v, atol=1e-9)


@given(q=turns)
def test_conjugate_and_matrix_are_inverses(q):
    assert rotation_angle(quaternion_multiply(q, quaternion_conjugate(q)), np.array([1.0, 0, 0, 0])) < 1e-9
    back = quaternion_from_matrix(quaternion_to_matrix(q))
    assert back[0] >= 0
    assert rotation_angle(back, q) < 1e-6


@given(q=turns)
def test_opposite_quaternions_are_the_same_rotation(q):
    assert rotation_angle(q, -q) < 1e-9


def test_batches_broadcast():
    batch = Pose(np.arange(6.0).reshape(2, 3), quaternion_exp(np.array([[0, 0, 0.5], [0.2, 0, 0]])))
    one = batch[1]
    assert_same_pose((one @ batch)[0], one @ batch[0])
    np.testing.assert_allclose(one.apply(np.zeros((5, 3))), np.tile(one.position, (5, 1)), atol=1e-12)
    assert Pose.identity(4).matrix().shape == (4, 4, 4)


def test_nearly_unit_quaternions_are_normalised_exactly():
    assert np.linalg.norm(unit_quaternion(np.array([1.0004, 0, 0, 0]))) == 1


@given(turn=turns)
def test_unit_quaternions_come_back_bit_by_bit(turn):
    np.testing.assert_array_equal(unit_quaternion(turn), turn)


@pytest.mark.parametrize("bad", [[2.0, 0, 0, 0], [0.0, 0, 0, 0], [np.nan, 0, 0, 1], [1.0, 0, 0]])
@pytest.mark.wrong_arrays
def test_other_quaternions_are_refused(bad):
    with pytest.raises(InvalidInput, match="quaternion"):
        unit_quaternion(np.array(bad))


def test_batches_are_joined_along_the_first_axis():
    one, two = Pose.identity(2), Pose(np.ones((1, 3)), np.array([[0.0, 1.0, 0.0, 0.0]]))
    both = Pose.joined(one, two)
    np.testing.assert_array_equal(both.position, [[0, 0, 0], [0, 0, 0], [1, 1, 1]])
    np.testing.assert_array_equal(both.quaternion[:, 1], [0, 0, 1])


@pytest.mark.parametrize("yaw", [-3.0, -0.1, 0.0, 1.5])
def test_a_turn_about_the_vertical_is_told_and_a_tilt_is_not_one(yaw):
    before = quaternion_exp(np.array([0.4, -1.0, 0.3]))
    after = quaternion_multiply(quaternion_exp(np.array([0.0, 0.0, yaw])), before)
    assert planar_turn(before, after) == pytest.approx(yaw, abs=1e-9)
    assert planar_turn(before, quaternion_multiply(quaternion_exp(np.array([0.2, 0.0, 0.0])), after)) is None
