"""What the renderers share: scenes in, images out, the quality between them, and checks of requests."""

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
    """How carefully rays are followed.

    Attributes:
        step_voxels: distance between samples [voxels of the field].
        min_weight: samples that show less are not coloured.
        stop: a ray ends where less of what lies behind would show.
        one_shadow: ask once per ray and object whether the light arrives, not at every sample.
        shadow_voxels: distance between samples of shadow rays [voxels].
        samples_per_side: rays per pixel, squared.
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
    """B scenes with the same objects.

    Attributes:
        names: of the N objects; each one's field is looked up under this name.
        positions: of the objects [m].
        quaternions: (w, x, y, z), unit.
        lights: unit vectors toward the distant light; they play no part where there are near lamps.
        pusher: its centre [m]; None where there is none.
        spots: the near lamp of each scene, in the place of its distant light; None for distant lights.

    Raises:
        InvalidInput: if an array has another shape, is not finite or not of unit length, or there are too many objects.
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
        """Make a batch of one scene, under a near lamp in the place of its light if one is given."""
        pusher = None if state.pusher is None else state.pusher[None]
        light = state.light if spot is None else spot.distant
        return SceneBatch(
            state.names, state.poses.position[None], state.poses.quaternion[None], light.direction[None], pusher,
            None if spot is None else (spot,),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class Rendered:
    """Images of B scenes from V cameras; what was not asked for is None.

    Attributes:
        rgb: linear radiance in [0, 1].
        opacity: how much of each pixel shows each object.
        masks: pixels of which an object covers half or more.
        depth: expected distance along the camera's z axis [m]; 0 where there is nothing.
    """

    rgb: Float32[np.ndarray, "B V h w 3"]
    opacity: Float32[np.ndarray, "B V N h w"] | None = None
    masks: Bool[np.ndarray, "B V N h w"] | None = None
    depth: Float32[np.ndarray, "B V h w"] | None = None

    @staticmethod
    def of(rgb: np.ndarray, opacity: np.ndarray, depth: np.ndarray, outputs: Collection[str]) -> Rendered:
        """Keep of everything that was drawn what was asked for."""
        return Rendered(
            rgb,
            opacity if "opacity" in outputs else None,
            opacity >= MASK_OPACITY if "masks" in outputs else None,
            depth if "depth" in outputs else None,
        )


class Renderer(Protocol):
    """What draws scenes: `osfcore.render.renderer.SceneRenderer`, or the paper's."""

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
    """Return height and width of the images [px], once everything asked for is found possible.

    Args:
        fields: names of those there are.
        batch: scenes to render.
        cameras: from which.
        outputs: names of what is asked for.

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
    """Return rotations from the world into objects' frames (B, N, 3, 3) and positions (B, N, 3), the pusher last."""
    rotations = np.swapaxes(quaternion_to_matrix(batch.quaternions), -1, -2)
    positions = batch.positions
    if batch.pusher is not None:
        upright = np.broadcast_to(np.eye(3), (len(rotations), 1, 3, 3))
        rotations = np.concatenate([rotations, upright], axis=1)
        positions = np.concatenate([positions, batch.pusher[:, None]], axis=1)
    return rotations, positions


def camera_numbers(camera: Camera) -> Float[np.ndarray, "12"]:
    """Return the position and the matrix from pixel coordinates to directions in the world."""
    pose = camera.T_world_camera
    matrix = quaternion_to_matrix(pose.quaternion) @ np.linalg.inv(camera.intrinsics)
    return np.concatenate([pose.position, matrix.reshape(-1)])
