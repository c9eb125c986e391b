"""Pinhole cameras with OpenCV axes, and the cameras around the table."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, check_ranges, finite_vector, shown
from osfcore.geometry.poses import Pose, quaternion_from_matrix, rotate

MIN_IMAGE_SIDE, MAX_IMAGE_SIDE = 16, 1024
DEFAULT_IMAGE_SIDE = 128
FIELD_OF_VIEW_DEG = 45.0
SCENE_CENTRE = (0.0, 0.0, 0.04)
CAMERA_POSITIONS = ((0.65, 0.0, 0.55), (0.0, 0.65, 0.55), (-0.65, 0.0, 0.55), (0.0, -0.65, 0.55))
GOAL_CAMERA_POSITION = (0.0, -0.45, 0.8)


def image_side(value: int, what: str = "image size [px]") -> int:
    """Return the side of an image [px] after checking it.

    Raises:
        InvalidInput: outside 16 to 1024.
    """
    check_ranges((what, value, MIN_IMAGE_SIDE, MAX_IMAGE_SIDE))
    return int(value)


@dataclass(frozen=True, eq=False, slots=True)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward. Pixel centres lie at +0.5.

    Attributes:
        name: name of the camera in files and on pages.
        T_world_camera: pose of the camera in the world.
        intrinsics: matrix K of focal lengths and principal point [px].
        width: width of the image [px].
        height: height of the image [px].

    Raises:
        InvalidInput: if a side is outside 16 to 1024 px, or `intrinsics` is not such a matrix.

    Example:
        >>> camera = Camera.look_at("side", position=(0.6, 0.0, 0.5), target=(0, 0, 0.05))
        >>> camera.project(np.array([0.0, 0.0, 0.05])).round(3)
        array([64., 64.])
    """

    name: str
    T_world_camera: Pose
    intrinsics: Float[np.ndarray, "3 3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        """Check the image size and the intrinsics."""
        name = shown(self.name)
        image_side(self.width, f"width of camera {name} [px]")
        image_side(self.height, f"height of camera {name} [px]")
        K = self.intrinsics
        is_sane = K.shape == (3, 3) and np.all(np.isfinite(K)) and K[0, 0] > 0 and K[1, 1] > 0
        if not is_sane or not np.array_equal(K[2], (0, 0, 1)):
            allowed = "a 3 x 3 matrix with positive focal lengths and last row 0, 0, 1"
            raise InvalidInput(f"K of camera {name}", K.tolist(), allowed)

    @staticmethod
    def look_at(
        name: str,
        position: object,
        target: object,
        *,
        size: int = DEFAULT_IMAGE_SIDE,
        fov_y_deg: float = FIELD_OF_VIEW_DEG,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> Camera:
        """Return a camera with a square image that looks at a point.

        Args:
            name: name of the camera in files and on pages.
            position: optical centre in the world [m], three numbers.
            target: point in the world that appears in the middle of the image [m], three numbers.
            size: side of the image [px].
            fov_y_deg: angle of view, vertical and horizontal [deg].
            up: direction in the world that points upwards in the image. If the camera looks along it, world y is
                used instead; if it looks along world y as well, world z.

        Raises:
            InvalidInput: if the two points coincide or are not finite, or `size` is outside 16 to 1024.
        """
        origin = finite_vector(position, 3, f"position of camera {name} [m]")
        forward = finite_vector(target, 3, f"target of camera {name} [m]") - origin
        if not np.linalg.norm(forward) > 0:
            raise InvalidInput(f"target of camera {name} [m]", origin.tolist(), "away from the camera")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        if np.linalg.norm(right) < 1e-9:  # looking along `up`: any direction serves as the image's top
            right = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[1]) < 0.9 else (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        focal = size / 2 / np.tan(np.deg2rad(fov_y_deg) / 2)
        intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
        return Camera(name, Pose(origin, quaternion_from_matrix(rotation)), intrinsics, size, size)

    @property
    def fov_y_rad(self) -> float:
        """Vertical field of view [rad]."""
        return float(2 * np.arctan2(self.height / 2, self.intrinsics[1, 1]))

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view with images of another size [px]."""
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        return replace(self, intrinsics=self.intrinsics * scale, width=width, height=height)

    def project(self, points_world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return pixel coordinates [px] of points in the world [m]. They mean nothing for points behind the camera."""
        points = self.T_world_camera.inverse().apply(points_world) @ self.intrinsics.T
        return points[..., :2] / points[..., 2:]

    def ray_directions(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Return unit vectors, in the world frame, along the rays through pixel coordinates [px]."""
        ones = np.ones((*pixels.shape[:-1], 1))
        directions = np.concatenate([pixels, ones], axis=-1) @ np.linalg.inv(self.intrinsics).T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return rotate(self.T_world_camera.quaternion, directions)


def default_cameras(size: int = DEFAULT_IMAGE_SIDE) -> tuple[Camera, ...]:
    """Return the four cameras "0" to "3" around the table, which an episode observes with.

    Args:
        size: side of the images [px].

    Raises:
        InvalidInput: if `size` is outside 16 to 1024.

    Example:
        >>> [camera.name for camera in default_cameras(size=64)]
        ['0', '1', '2', '3']
    """
    return tuple(Camera.look_at(str(i), p, SCENE_CENTRE, size=size) for i, p in enumerate(CAMERA_POSITIONS))


def goal_camera(size: int = DEFAULT_IMAGE_SIDE) -> Camera:
    """Return the camera "goal", which takes goal images.

    Args:
        size: side of the image [px].

    Raises:
        InvalidInput: if `size` is outside 16 to 1024.

    Example:
        >>> goal_camera().T_world_camera.position
        array([ 0.  , -0.45,  0.8 ])
    """
    return Camera.look_at("goal", GOAL_CAMERA_POSITION, SCENE_CENTRE, size=size)
