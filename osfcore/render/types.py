"""What the renderers share: batches of scenes, images, quality settings, and checks of requests."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import SpotLamp
from osfcore.geometry.poses import QUATERNION_NORM_TOLERANCE, quaternion_to_matrix
from osfcore.geometry.states import SceneState

OUTPUTS = frozenset({"rgb", "opacity", "masks", "depth"})
MASK_OPACITY = 0.5
MOST_OBJECTS = 23  # and the pusher
_FARTHEST_M = 1e6


@dataclass(frozen=True, slots=True)
class Quality:
    """Accuracy of volume rendering: smaller steps and thresholds cost more time.

    Attributes:
        step_voxels: distance between samples along a ray [voxels of the field].
        min_weight: smallest weight of a sample whose colour is computed.
        stop: transmittance at which a ray ends.
        one_shadow: whether to follow one shadow ray per ray and object, instead of one per sample.
        shadow_voxels: distance between samples along a shadow ray [voxels of the field].
        samples_per_side: square root of the number of rays per pixel.

    Example:
        >>> smooth = Quality(samples_per_side=2)  # four rays per pixel
        >>> SceneRenderer({name: fields.load(name)}, table).render(
        ...     SceneBatch.of(state), [goal_camera(64)], quality=smooth
        ... ).rgb.shape
        (1, 1, 64, 64, 3)
    """

    step_voxels: float = 0.5
    min_weight: float = 1e-5
    stop: float = 1e-4
    one_shadow: bool = False
    shadow_voxels: float = 0.5
    samples_per_side: int = 1


EXACT = Quality()
PLANNING = Quality(step_voxels=1.0, min_weight=0.1, stop=0.03, one_shadow=True, shadow_voxels=1.5)


@dataclass(frozen=True, eq=False, slots=True)
class SceneBatch:
    """B scenes with the same objects, which a renderer draws together.

    Attributes:
        names: names of the N objects. The renderer looks up their fields by these names.
        positions: positions of the objects in the world [m].
        quaternions: orientations of the objects in the world as unit quaternions (w, x, y, z).
        lights: unit vectors toward the distant lights. They are ignored if `spots` is given.
        pusher: centres of the pusher in the world [m]; None for scenes without a pusher.
        spots: a near lamp for each scene in place of the distant light; None for distant lights.

    Raises:
        InvalidInput: if an array has another shape or numbers that are not finite, a vector or quaternion is not unit,
            or there are more than 23 objects.

    Example:
        >>> SceneBatch.of(state).positions.shape
        (1, 1, 3)
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "B N 3"]
    quaternions: Float[np.ndarray, "B N 4"]
    lights: Float[np.ndarray, "B 3"]
    pusher: Float[np.ndarray, "B 3"] | None
    spots: tuple[SpotLamp, ...] | None = None

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        count, scenes = len(self.names), len(self.lights)
        shapes = {"positions": (scenes, count, 3), "quaternions": (scenes, count, 4), "lights": (scenes, 3)}
        if self.pusher is not None:
            shapes["pusher"] = (scenes, 3)
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise InvalidInput(f"{name} of a batch", f"shape {array.shape}", f"finite numbers of shape {shape}")
            if not np.all(np.abs(array) < _FARTHEST_M):  # also false for NaN
                largest = f"{np.abs(array).max():g}"  # NaN where there is one
                raise InvalidInput(
                    f"largest of the {name} of a batch", largest, f"finite and below {_FARTHEST_M:g} in size"
                )
        for name in ("quaternions", "lights"):
            norms = np.linalg.norm(getattr(self, name), axis=-1)
            if not np.all(np.abs(norms - 1) < QUATERNION_NORM_TOLERANCE):
                raise InvalidInput(f"norms of the {name} of a batch", f"{norms.min():g} to {norms.max():g}", "1")
        if count > MOST_OBJECTS:
            raise InvalidInput("number of objects", count, f"at most {MOST_OBJECTS}")
        if self.spots is not None and len(self.spots) != scenes:
            raise InvalidInput("number of lamps of a batch", len(self.spots), f"{scenes}, one for each scene")

    @staticmethod
    def of(state: SceneState, spot: SpotLamp | None = None) -> SceneBatch:
        """Return a batch of one scene. A near lamp `spot` replaces the light of the state."""
        pusher = None if state.pusher is None else state.pusher[None]
        light = state.light if spot is None else spot.distant
        return SceneBatch(
            state.names, state.poses.position[None], state.poses.quaternion[None], light.direction[None], pusher,
            None if spot is None else (spot,),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class Rendered:
    """Images of B scenes from V cameras. Outputs that were not requested are None.

    Attributes:
        rgb: linear radiance in [0, 1].
        opacity: share of each pixel that each object covers, in [0, 1].
        masks: pixels that an object covers by half or more.
        depth: expected distance along the camera's z axis [m]; 0 where a ray meets nothing.
    """

    rgb: Float32[np.ndarray, "B V h w 3"]
    opacity: Float32[np.ndarray, "B V N h w"] | None = None
    masks: Bool[np.ndarray, "B V N h w"] | None = None
    depth: Float32[np.ndarray, "B V h w"] | None = None

    @staticmethod
    def of(rgb: np.ndarray, opacity: np.ndarray, depth: np.ndarray, outputs: Collection[str]) -> Rendered:
        """Return the requested outputs of everything that was drawn."""
        return Rendered(
            rgb,
            opacity if "opacity" in outputs else None,
            opacity >= MASK_OPACITY if "masks" in outputs else None,
            depth if "depth" in outputs else None,
        )


class Renderer(Protocol):
    """A renderer of scenes: `osfcore.render.renderer.SceneRenderer`, or the paper's."""

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that can be drawn."""
        ...

    def render(
        self,
        batch: SceneBatch,
        cameras: Sequence[Camera],
        *,
        quality: Quality = EXACT,
        outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
        only: Bool[np.ndarray, "V h w"] | None = None,
    ) -> Rendered:
        """Render every scene of a batch from every camera."""
        ...


def check_request(
    fields: Collection[str], batch: SceneBatch, cameras: Sequence[Camera], outputs: frozenset[str] | set[str]
) -> tuple[int, int]:
    """Check a request to a renderer; return height and width of its images [px].

    Args:
        fields: names of the fields that the renderer has.
        batch: scenes to render.
        cameras: cameras to render from.
        outputs: names of the requested outputs.

    Raises:
        UnknownName: if an object has no field.
        InvalidInput: if there is no camera, cameras differ in size, or an output is unknown.
    """
    for name in batch.names:
        if name not in fields:
            raise UnknownName("field", name, sorted(fields))
    unknown = set(outputs) - OUTPUTS
    if unknown:
        raise InvalidInput("outputs", ", ".join(sorted(unknown)), ", ".join(sorted(OUTPUTS)))
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise InvalidInput("image sizes of the cameras", sorted(sizes), "one size for all cameras")
    return sizes.pop()


def poses_of(batch: SceneBatch) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations from world to object frames (B, N, 3, 3) and positions (B, N, 3) [m], with the pusher last."""
    rotations = np.swapaxes(quaternion_to_matrix(batch.quaternions), -1, -2)
    positions = batch.positions
    if batch.pusher is not None:
        upright = np.broadcast_to(np.eye(3), (len(rotations), 1, 3, 3))
        rotations = np.concatenate([rotations, upright], axis=1)
        positions = np.concatenate([positions, batch.pusher[:, None]], axis=1)
    return rotations, positions


def camera_numbers(camera: Camera) -> Float[np.ndarray, "12"]:
    """Return a camera's position [m] and the 3 x 3 matrix from pixel coordinates to directions in the world."""
    pose = camera.T_world_camera
    matrix = quaternion_to_matrix(pose.quaternion) @ np.linalg.inv(camera.intrinsics)
    return np.concatenate([pose.position, matrix.reshape(-1)])
