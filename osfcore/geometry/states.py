"""Scene states and observations: frozen dataclasses of numpy arrays, checked when they are built.

Letters: V views, N objects, h w pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import InvalidInput, check_known, check_unique, finite_vector
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.geometry.workspace import TABLE_SIDE_M

MAX_OBJECTS = 8


@dataclass(frozen=True, eq=False, slots=True)
class SceneState:
    """Poses of the objects, the light, and the position of the pusher.

    Attributes:
        names: names of the N objects, all different; 8 at most.
        poses: `T_world_object`, a batch of N.
        light: the light.
        pusher: centre of the pusher in the world [m]; None for a scene without one, such as a goal image.

    Raises:
        InvalidInput: if there are more than 8 objects, a name occurs twice, a number is not finite, a quaternion is
            not unit, or an array has another shape.

    Example:
        >>> state = SceneState((name,), Pose.stacked([upright]), light, pusher)
        >>> state.pose(name).position
        array([0.   , 0.   , 0.095])
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
        check_unique("list of objects", self.names)
        if self.poses.position.shape != (count, 3) or not np.all(np.isfinite(self.poses.position)):
            raise InvalidInput("object positions [m]", self.poses.position.tolist(), f"{count} x 3 finite numbers")
        quaternion = unit_quaternion(self.poses.quaternion, "object quaternions")
        object.__setattr__(self, "poses", Pose(self.poses.position, quaternion))
        if self.pusher is not None:
            object.__setattr__(self, "pusher", finite_vector(self.pusher, 3, "pusher position [m]"))

    def pose(self, name: str) -> Pose:
        """Return `T_world_object` of one object.

        Raises:
            UnknownName: if the object is not in the scene.
        """
        return self.poses[self._number(name)]

    def reordered(self, names: tuple[str, ...]) -> SceneState:
        """Return the same state with its objects in another order.

        Raises:
            UnknownName: if a name is not in the scene.
        """
        return replace(self, names=names, poses=self.poses[[self._number(name) for name in names]])

    def _number(self, name: str) -> int:
        check_known("object in the scene", [name], self.names)
        return self.names.index(name)


def shifted_poses(state: SceneState, shifts_m: Mapping[str, tuple[float, float]]) -> dict[str, Pose]:
    """Return poses of some objects, each moved along x and y [m] from its pose in a state, not turned."""
    return {
        name: Pose(state.pose(name).position + np.array([*shift, 0.0]), state.pose(name).quaternion)
        for name, shift in shifts_m.items()
    }


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """Images and pusher position at one instant. It holds no depth and no poses.

    Attributes:
        cameras: V cameras of one image size.
        images: linear RGB in [0, 1].
        names: names of the N objects in the scene.
        masks: visible pixels of each object, or None. Only a first frame needs masks.
        pusher: centre of the pusher in the world [m], as the robot reports it; None without a pusher.
        time_s: time since the last reset [s].
        unmasked: which of the masks nobody drew; None if all are there, so that an empty one means a hidden object.

    Example:
        >>> observation = Observation(cameras, images, state.names, masks, pusher, time_s=0.0)
        >>> observation.images.shape, observation.masks.shape
        ((4, 128, 128, 3), (4, 1, 128, 128))
    """

    cameras: tuple[Camera, ...]
    images: Float[np.ndarray, "V h w 3"]
    names: tuple[str, ...]
    masks: Bool[np.ndarray, "V N h w"] | None
    pusher: Float[np.ndarray, "3"] | None
    time_s: float
    unmasked: Bool[np.ndarray, "V N"] | None = None


def pose_rows(poses: Pose) -> Float[np.ndarray, "N 7"]:
    """Return position [m] and quaternion (w, x, y, z) of each object, as learning programs receive them.

    Quaternions have w >= 0. Positions of objects that have fallen off the table are clipped to 1.2 m around its centre.
    """
    signs = np.where(poses.quaternion[:, :1] < 0, -1.0, 1.0)
    positions = poses.position.clip(-TABLE_SIDE_M, TABLE_SIDE_M)
    return np.concatenate([positions, (signs * poses.quaternion).clip(-1, 1)], axis=1)


@dataclass(frozen=True, eq=False, slots=True)
class EstimatedState:
    """An estimated scene state, its uncertainty, and whether to trust it.

    Attributes:
        state: the most likely state.
        position_std: standard deviation of each object's position, per axis [m].
        rotation_std: standard deviation of each object's orientation, per axis of a small rotation [rad].
        light_std: standard deviation of the direction toward the light, per axis [rad].
        doubts: for each object, why its pose should not be trusted; "" if it can be.
        reason: why the estimate should not be trusted, in one sentence; "" if it can be.
    """

    state: SceneState
    position_std: Float[np.ndarray, "N"]
    rotation_std: Float[np.ndarray, "N"]
    light_std: float
    doubts: tuple[str, ...]
    reason: str

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        count = len(self.state.names)
        for name in ("position_std", "rotation_std"):
            array = getattr(self, name)
            if array.shape != (count,) or not np.all(array >= 0):  # also false for NaN
                raise InvalidInput(name, array.tolist(), f"{count} numbers of at least 0")
        if not self.light_std >= 0:
            raise InvalidInput("light_std", self.light_std, "a number of at least 0")
        if len(self.doubts) != count:
            raise InvalidInput("doubts", len(self.doubts), f"one for each of {count} objects")

    @property
    def trusted(self) -> bool:
        """Whether the estimate can be trusted."""
        return not self.reason

    @property
    def doubted(self) -> tuple[str, ...]:
        """Objects that should not be trusted."""
        return tuple(name for name, doubt in zip(self.state.names, self.doubts, strict=True) if doubt)

    def with_pusher(self, pusher: Float[np.ndarray, "3"] | None) -> EstimatedState:
        """Return the same estimate with the pusher at this position in the world [m]."""
        return replace(self, state=replace(self.state, pusher=pusher))
