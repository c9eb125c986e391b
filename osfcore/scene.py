"""The vocabulary: cameras, light, pusher, scene states and observations, with their conventions and limits.

World frame: z up, table top at z = 0, its centre the origin; SI units. Everything here is a frozen dataclass of numpy
arrays, checked when built, so what crosses a line between rooms is always sane. Letters: V views, N objects,
h w pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import InvalidInput, shown
from osfcore.poses import Pose, quaternion_from_matrix, rotate, unit_quaternion

TABLE_SIDE_M = 1.2
WORKSPACE_HALF_M = 0.22
PUSHER_RADIUS_M = 0.015
PUSHER_HEIGHT_M = 0.12
PUSHER_ALBEDO = (0.22, 0.42, 0.50)  # a robot knows its hand
PUSHER_CLEARANCE_M = 0.002  # the pusher hovers, so that it never rubs on the table
PUSHER_CENTRE_Z_M = PUSHER_CLEARANCE_M + PUSHER_HEIGHT_M / 2
PUSHER_REACH_M = 0.35  # |x|, |y| of the pusher's centre; the robot stops there
MAX_SPEED_M_S = 0.3
STEP_S = 0.2
ACTION_ALLOWED = f"(vx, vy, 0), finite, with |vx| and |vy| at most {MAX_SPEED_M_S}"
AMBIENT = 0.25
DIFFUSE = 0.75
MIN_LIGHT_ELEVATION_DEG = 5.0
MAX_OBJECTS = 8
MIN_IMAGE_SIDE, MAX_IMAGE_SIDE = 16, 1024
MAX_SEED = 2**63 - 1
DEFAULT_IMAGE_SIDE = 128
FIELD_OF_VIEW_DEG = 45.0
SCENE_CENTRE = (0.0, 0.0, 0.04)
CAMERA_POSITIONS = ((0.65, 0.0, 0.55), (0.0, 0.65, 0.55), (-0.65, 0.0, 0.55), (0.0, -0.65, 0.55))
GOAL_CAMERA_POSITION = (0.0, -0.45, 0.8)


def finite_vector(value: object, size: int, what: str) -> Float[np.ndarray, "size"]:
    """A float64 copy of `size` finite numbers.

    Raises:
        InvalidInput: if there are not exactly `size` numbers, or one is NaN or infinite.
    """
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput(what, repr(value)[:80], f"{size} finite numbers") from None
    if vector.shape != (size,) or not np.all(np.isfinite(vector)):
        raise InvalidInput(what, repr(vector.tolist())[:80], f"{size} finite numbers")
    return vector


def image_side(value: int, what: str = "image size [px]") -> int:
    """The side of an image [px], checked.

    Raises:
        InvalidInput: outside 16 to 1024.
    """
    if not MIN_IMAGE_SIDE <= value <= MAX_IMAGE_SIDE:
        raise InvalidInput(what, value, f"between {MIN_IMAGE_SIDE} and {MAX_IMAGE_SIDE}")
    return int(value)


def check_seed(value: int) -> int:
    """A seed that every random generator takes.

    Raises:
        InvalidInput: if it is negative or has more than 63 bits.
    """
    if not 0 <= value <= MAX_SEED:
        raise InvalidInput("seed", value, f"between 0 and {MAX_SEED}")
    return int(value)


@dataclass(frozen=True, eq=False, slots=True)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward; pixel centres at +0.5.

    Attributes:
        name: how files and pages call it.
        T_world_camera: pose of the camera in the world.
        intrinsics: focal lengths and principal point, 3 x 3 [px].
        width: of the image [px].
        height: of the image [px].
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
        """A square camera at `position` [m] that looks at `target` [m] with `up` upwards in its image.

        Raises:
            InvalidInput: if both points coincide.
        """
        origin = finite_vector(position, 3, f"position of camera {name} [m]")
        forward = finite_vector(target, 3, f"target of camera {name} [m]") - origin
        if not np.linalg.norm(forward) > 0:
            raise InvalidInput(f"target of camera {name} [m]", origin.tolist(), "away from the camera")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        if np.linalg.norm(right) < 1e-9:  # looking along `up`: any direction serves as the image's top
            right = np.cross(forward, (0.0, 1.0, 0.0))
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
        """The same view with another number of pixels."""
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        return replace(self, intrinsics=self.intrinsics * scale, width=width, height=height)

    def project(self, points_world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates of world points [px]; meaningless for points behind the camera."""
        points = self.T_world_camera.inverse().apply(points_world) @ self.intrinsics.T
        return points[..., :2] / points[..., 2:]

    def ray_directions(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions in the world of the rays through pixel coordinates [px]."""
        ones = np.ones((*pixels.shape[:-1], 1))
        directions = np.concatenate([pixels, ones], axis=-1) @ np.linalg.inv(self.intrinsics).T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return rotate(self.T_world_camera.quaternion, directions)


def default_cameras(size: int = DEFAULT_IMAGE_SIDE) -> tuple[Camera, ...]:
    """Cameras "0" to "3" around the table."""
    return tuple(Camera.look_at(str(i), p, SCENE_CENTRE, size=size) for i, p in enumerate(CAMERA_POSITIONS))


def goal_camera(size: int = DEFAULT_IMAGE_SIDE) -> Camera:
    """The camera "goal", from which goal images are taken."""
    return Camera.look_at("goal", GOAL_CAMERA_POSITION, SCENE_CENTRE, size=size)


@dataclass(frozen=True, eq=False, slots=True)
class Light:
    """A distant, parallel, white light. Only its direction can be observed.

    Attributes:
        position: 1 m from the table's centre, toward the light [m]; any other length is brought to 1.
    """

    position: Float[np.ndarray, "3"]

    def __post_init__(self) -> None:
        """Bring the position to unit length and refuse lights at or below the table."""
        position = finite_vector(self.position, 3, "light position [m]")
        length = np.linalg.norm(position)
        if not length > 1e-9:
            raise InvalidInput("light position [m]", position.tolist(), "away from the table's centre")
        position = position / length
        elevation_deg = float(np.rad2deg(np.arcsin(np.clip(position[2], -1, 1))))
        if elevation_deg < MIN_LIGHT_ELEVATION_DEG - 1e-6:
            raise InvalidInput("light elevation [deg]", f"{elevation_deg:.1f}", f"at least {MIN_LIGHT_ELEVATION_DEG:g}")
        object.__setattr__(self, "position", position)

    @staticmethod
    def from_angles(azimuth_rad: float, elevation_rad: float) -> Light:
        """A light at an azimuth from +x toward +y and an elevation above the table [rad]."""
        c = np.cos(elevation_rad)
        return Light(np.array([c * np.cos(azimuth_rad), c * np.sin(azimuth_rad), np.sin(elevation_rad)]))

    @staticmethod
    def random(rng: np.random.Generator, min_elevation_deg: float = 10.0) -> Light:
        """A light drawn uniformly (by solid angle) from the hemisphere above `min_elevation_deg`."""
        z = rng.uniform(np.sin(np.deg2rad(min_elevation_deg)), 1.0)
        return Light.from_angles(rng.uniform(-np.pi, np.pi), float(np.arcsin(z)))

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector from the table's centre toward the light."""
        return self.position


def check_action(action: object) -> Float[np.ndarray, "3"]:
    """A velocity (vx, vy, 0) of the pusher [m/s], held for `STEP_S`.

    Raises:
        InvalidInput: if it is not three finite numbers, exceeds 0.3 m/s on an axis or has a vertical part.
    """
    velocity = finite_vector(action, 3, "action [m/s]")
    if np.any(np.abs(velocity) > MAX_SPEED_M_S + 1e-9) or velocity[2] != 0:
        raise InvalidInput("action [m/s]", velocity.tolist(), ACTION_ALLOWED)
    return velocity


@dataclass(frozen=True, eq=False, slots=True)
class SceneState:
    """Where everything is: objects, light, pusher.

    Attributes:
        names: catalogue names of the objects, all different.
        poses: `T_world_object`, a batch of N.
        light: the one light.
        pusher: centre of the pusher [m], or None where there is none (goal images).
    """

    names: tuple[str, ...]
    poses: Pose
    light: Light
    pusher: Float[np.ndarray, "3"] | None

    def __post_init__(self) -> None:
        """Check counts, shapes and numbers."""
        count = len(self.names)
        if count > MAX_OBJECTS:
            raise InvalidInput("number of objects", count, f"at most {MAX_OBJECTS}")
        if len(set(self.names)) != count:
            raise InvalidInput("list of objects", ", ".join(self.names), "without repetition")
        if self.poses.position.shape != (count, 3) or not np.all(np.isfinite(self.poses.position)):
            raise InvalidInput("object positions [m]", self.poses.position.tolist(), f"{count} x 3 finite numbers")
        quaternion = unit_quaternion(self.poses.quaternion, "object quaternions")
        object.__setattr__(self, "poses", Pose(self.poses.position, quaternion))
        if self.pusher is not None:
            object.__setattr__(self, "pusher", finite_vector(self.pusher, 3, "pusher position [m]"))

    def pose(self, name: str) -> Pose:
        """`T_world_object` of one object."""
        return self.poses[self.names.index(name)]


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """What the cameras and the robot report at one instant; no depth, no poses.

    Attributes:
        cameras: V cameras of one image size.
        images: linear RGB in [0, 1].
        names: names of the N objects in the scene.
        masks: visible pixels of each object, or None.
        pusher: centre of the pusher [m]; the robot knows its hand.
        time_s: since the last reset [s].
    """

    cameras: tuple[Camera, ...]
    images: Float[np.ndarray, "V h w 3"]
    names: tuple[str, ...]
    masks: Bool[np.ndarray, "V N h w"] | None
    pusher: Float[np.ndarray, "3"] | None
    time_s: float
