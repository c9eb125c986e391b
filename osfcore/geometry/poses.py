"""Rigid poses and unit quaternions (w, x, y, z) on numpy arrays with any leading batch shape.

`T_world_object` maps object coordinates to world coordinates; poses compose by matching subscripts:
`T_world_camera @ T_camera_object`. Conversions from matrices and rotation vectors are scipy's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from osfcore.errors import InvalidInput

QUATERNION_NORM_TOLERANCE = 1e-3
_ROUNDING = 8 * np.finfo(float).eps
UPRIGHT_RAD = 0.08  # of tilt: more is another side of an object


def quaternion_multiply(
    a: Float[np.ndarray, "*#batch 4"], b: Float[np.ndarray, "*#batch 4"]
) -> Float[np.ndarray, "*out 4"]:
    """Hamilton product a b: the rotation b followed by the rotation a. Batches broadcast."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """The inverse rotation of a unit quaternion."""
    return np.asarray(q) * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Float[np.ndarray, "*#batch 4"], v: Float[np.ndarray, "*#batch 3"]) -> Float[np.ndarray, "*out 3"]:
    """Rotate vectors by unit quaternions. Batches broadcast."""
    q, v = np.asarray(q), np.asarray(v)
    u = q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + q[..., :1] * t + np.cross(u, t)


def quaternion_to_matrix(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but 0. Written out: rendering asks for them all the time."""
    q = np.asarray(q, float)
    w, x, y, z = np.moveaxis(q, -1, 0)
    s = 2 / (q * q).sum(axis=-1)
    matrix = np.empty((*q.shape[:-1], 3, 3))
    matrix[..., 0, 0], matrix[..., 1, 1] = 1 - s * (y * y + z * z), 1 - s * (x * x + z * z)
    matrix[..., 2, 2] = 1 - s * (x * x + y * y)
    matrix[..., 0, 1], matrix[..., 1, 0] = s * (x * y - w * z), s * (x * y + w * z)
    matrix[..., 0, 2], matrix[..., 2, 0] = s * (x * z + w * y), s * (x * z - w * y)
    matrix[..., 1, 2], matrix[..., 2, 1] = s * (y * z - w * x), s * (y * z + w * x)
    return matrix


def quaternion_from_matrix(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions with w >= 0 of rotation matrices."""
    m = np.array(matrix, float)
    q = Rotation.from_matrix(m.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True)
    return q.reshape(*m.shape[:-2], 4)


def quaternion_exp(rotation_vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions of rotation vectors (axis times angle) [rad]."""
    r = np.array(rotation_vector, float)
    return Rotation.from_rotvec(r.reshape(-1, 3)).as_quat(scalar_first=True).reshape(*r.shape[:-1], 4)


def quaternion_log(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3"]:
    """Rotation vectors [rad] with an angle of at most pi; the inverse of `quaternion_exp`."""
    q = np.array(q, float)
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(*q.shape[:-1], 3)


def rotation_angle(
    a: Float[np.ndarray, "*#batch 4"], b: Float[np.ndarray, "*#batch 4"]
) -> Float[np.ndarray | np.float64, "*out"]:
    """Return the angle of the rotation between two orientations [rad], in [0, pi].

    q and -q are the same orientation.

    Args:
        a: unit quaternions (w, x, y, z).
        b: unit quaternions (w, x, y, z). The batches of a and b broadcast.

    Example:
        >>> upright, upside_down = np.array([1.0, 0, 0, 0]), np.array([0, 1.0, 0, 0])
        >>> round(float(np.rad2deg(rotation_angle(upright, upside_down))))
        180
    """
    difference = quaternion_multiply(quaternion_conjugate(a), b)
    return 2.0 * np.arctan2(np.linalg.norm(difference[..., 1:], axis=-1), np.abs(difference[..., 0]))


def planar_turn(before: Float[np.ndarray, "4"], after: Float[np.ndarray, "4"]) -> float | None:
    """Turn about the vertical between two orientations, in -pi to pi [rad]; None if it tilts by more than 0.08 rad."""
    angle, tilt = planar_turns(before, after[None])
    return float(angle[0]) if tilt[0] <= UPRIGHT_RAD else None


def planar_turns(
    before: Float[np.ndarray, "4"], after: Float[np.ndarray, "M 4"]
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Rotations from one orientation as turns about the vertical, in -pi to pi, and tilts after them [rad]."""
    turn = quaternion_multiply(after, quaternion_conjugate(before))
    tilt = 2 * np.arcsin(np.linalg.norm(turn[:, 1:3], axis=1).clip(max=1.0))
    angle = 2 * np.arctan2(turn[:, 3], turn[:, 0])
    return (angle + np.pi) % (2 * np.pi) - np.pi, tilt


def unit_quaternion(q: Float[np.ndarray, "*batch 4"], what: str = "quaternion") -> Float[np.ndarray, "*batch 4"]:
    """Return the same quaternions with norm 1, up to rounding; those that have it come back bit by bit.

    Raises:
        InvalidInput: if a norm is off by more than 1e-3: such a quaternion is a mistake, not a rounding error.
    """
    q = np.asarray(q, float)
    if q.shape[-1:] != (4,):
        raise InvalidInput(what, f"an array of shape {q.shape}", "four numbers (w, x, y, z)")
    norms = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(norms - 1.0) < QUATERNION_NORM_TOLERANCE):  # also false for NaN
        raise InvalidInput(what, q.tolist(), "a unit quaternion (w, x, y, z)")
    return np.where(np.abs(norms - 1.0) < _ROUNDING, q, q / norms)


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """A rigid pose `T_a_b`, or a batch of them: it maps coordinates in frame b to coordinates in frame a.

    Poses compose by matching frames: `T_a_b @ T_b_c` is `T_a_c`.

    Attributes:
        position: origin of b in a [m].
        quaternion: rotation from b to a as a unit quaternion (w, x, y, z).

    Example:
        >>> T_world_object = Pose(np.array([0.1, 0.0, 0.05]), np.array([1.0, 0, 0, 0]))
        >>> T_world_object.apply(np.array([0.0, 0.0, 0.02])).round(3)
        array([0.1 , 0.  , 0.07])
    """

    position: Float[np.ndarray, "*batch 3"]
    quaternion: Float[np.ndarray, "*batch 4"]

    @staticmethod
    def identity(*batch: int) -> Pose:
        """Return the identity, or a batch of identities of this shape."""
        quaternion = np.zeros((*batch, 4))
        quaternion[..., 0] = 1.0
        return Pose(np.zeros((*batch, 3)), quaternion)

    @staticmethod
    def joined(*batches: Pose) -> Pose:
        """Join batches along the first axis."""
        return Pose(np.concatenate([b.position for b in batches]), np.concatenate([b.quaternion for b in batches]))

    @staticmethod
    def stacked(poses: Iterable[Pose]) -> Pose:
        """Stack poses, or batches of one size, along a new first axis. No poses give an empty batch."""
        every = list(poses)
        if not every:
            return Pose.identity(0)
        return Pose(np.stack([p.position for p in every]), np.stack([p.quaternion for p in every]))

    @staticmethod
    def from_matrix(matrix: Float[np.ndarray, "*batch 4 4"]) -> Pose:
        """Return the poses of homogeneous 4 x 4 matrices, whose upper left 3 x 3 block must be a rotation."""
        matrix = np.asarray(matrix, float)
        return Pose(matrix[..., :3, 3].copy(), quaternion_from_matrix(matrix[..., :3, :3]))

    def matrix(self) -> Float[np.ndarray, "*batch 4 4"]:
        """Return the pose as homogeneous 4 x 4 matrices."""
        matrix = np.zeros((*self.position.shape[:-1], 4, 4))
        matrix[..., :3, :3] = quaternion_to_matrix(self.quaternion)
        matrix[..., :3, 3] = self.position
        matrix[..., 3, 3] = 1.0
        return matrix

    def inverse(self) -> Pose:
        """Return `T_b_a`, the inverse of `T_a_b`."""
        quaternion = quaternion_conjugate(self.quaternion)
        return Pose(-rotate(quaternion, self.position), quaternion)

    def __matmul__(self, other: Pose) -> Pose:
        """Return `T_a_c = T_a_b @ T_b_c`. Batches broadcast."""
        return Pose(
            self.position + rotate(self.quaternion, other.position),
            quaternion_multiply(self.quaternion, other.quaternion),
        )

    def apply(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*out 3"]:
        """Map points from frame b to frame a [m]. One pose maps any array of points; a batch broadcasts with them."""
        return rotate(self.quaternion, points) + self.position

    def __getitem__(self, index: object) -> Pose:
        """Return some poses of a batch, by index, slice or list."""
        return Pose(self.position[index], self.quaternion[index])  # pyright: ignore[reportArgumentType, reportCallIssue]


def orthogonal_basis(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two unit vectors that stand on a unit vector and on each other."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def fibonacci_sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Return unit vectors spread evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
