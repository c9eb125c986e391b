import numpy as np
import torch

from osfcore.geometry import poses
from osfcore.geometry import torch_rotations as rotations

rng = np.random.default_rng(0)
VECTORS = np.concatenate([rng.normal(size=(50, 3)), 1e-6 * rng.normal(size=(5, 3)), np.zeros((1, 3)), 20 * np.eye(3)])
QUATERNIONS = poses.quaternion_exp(VECTORS)
OTHERS = QUATERNIONS[rng.permutation(len(QUATERNIONS))]


def tensor(array) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(array))


def test_products_rotations_and_matrices_are_those_of_poses():
    q, p = tensor(QUATERNIONS), tensor(OTHERS)
    v = rng.normal(size=(len(QUATERNIONS), 3))
    np.testing.assert_allclose(rotations.multiply(q, p), poses.quaternion_multiply(QUATERNIONS, OTHERS), atol=1e-12)
    np.testing.assert_allclose(rotations.matrix(q), poses.quaternion_to_matrix(QUATERNIONS), atol=1e-12)
    np.testing.assert_allclose(rotations.rotate(q, tensor(v)), poses.rotate(QUATERNIONS, v), atol=1e-12)


def test_exponential_is_that_of_poses_and_smooth_at_zero():
    found = rotations.exponential(tensor(VECTORS)).numpy()
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(poses.rotation_angle(found, QUATERNIONS), 0, atol=1e-7)
    vector = torch.zeros(4, 3, requires_grad=True)
    rotations.exponential(vector)[:, 1:].sum().backward()
    torch.testing.assert_close(vector.grad, torch.full((4, 3), 0.5))


def test_facing_takes_a_direction_to_x_and_keeps_the_vertical():
    angles = torch.linspace(-3, 3, 7)
    direction = torch.stack([angles.cos(), angles.sin(), torch.zeros(7)], dim=1)
    frame = rotations.facing(direction[:, :2])
    torch.testing.assert_close((frame @ direction[..., None])[..., 0], torch.eye(3)[:1].expand(7, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(frame @ frame.transpose(1, 2), torch.eye(3).expand(7, 3, 3), atol=1e-6, rtol=0)
    assert torch.equal(frame[:, 2], torch.eye(3)[2].expand(7, 3))
