"""Factors of variation, one at a time: worlds that differ in one thing from what the method takes for granted.

The method knows of none of them. Taken for granted are: a distant white lamp with ambient 0.25 and diffuse 0.75, 5
deg and more above the table; a table of one known colour; exact calibration; linear images without noise; exact masks;
friction as the dynamics were trained on; objects that they were trained on. `mild_together` are many factors at once,
each of them small.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.control.goal import GoalImage
from osfcore.errors import UnknownName
from osfcore.estimation.camera_response import linear_of_srgb, srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import Observation, SceneState
from osfcore.io.image_file import to_uint8
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import Lamp, TableSurface, wooden_texture
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.tabletop import Tabletop

# Sensors: noise, compression, encodings, calibrations and masks that are a bit off.


ImageChange = Literal["none", "noise", "jpeg", "srgb_8bit", "srgb_8bit_decoded", "srgb_noise_jpeg"]
NOISE_SIGMA = 0.02  # of each channel of each pixel
JPEG_QUALITY = 80


def received(
    image: Float[np.ndarray, "h w 3"], change: ImageChange, rng: np.random.Generator
) -> Float[np.ndarray, "h w 3"]:
    """Return an image as a program gets it; whatever else happens, sensors saturate at 1.

    Args:
        image: linear radiance.
        change: "noise" adds Gaussian noise; "jpeg" stores linear values in a JPEG file; "srgb_8bit" hands over sRGB
            values of 8 bit where linear ones are expected; "srgb_8bit_decoded" makes them linear again;
            "srgb_noise_jpeg" hands over sRGB values with half of the noise, from a JPEG file.
        rng: draws the noise.

    Returns:
        Values in [0, 1].
    """
    image = np.clip(image, 0, 1)
    match change:
        case "noise":
            noise = rng.standard_normal(image.shape, np.float32)
            return np.clip(image + np.float32(NOISE_SIGMA) * noise, 0, 1)
        case "jpeg":
            return _through_jpeg(to_uint8(image)).astype(np.float32) / 255
        case "srgb_8bit":
            return to_uint8(srgb_of_linear(image)).astype(np.float32) / 255
        case "srgb_8bit_decoded":
            return linear_of_srgb(to_uint8(srgb_of_linear(image)).astype(np.float32) / 255)
        case "srgb_noise_jpeg":
            noisy = image + np.float32(NOISE_SIGMA / 2) * rng.standard_normal(image.shape, np.float32)
            return _through_jpeg(to_uint8(srgb_of_linear(np.clip(noisy, 0, 1)))).astype(np.float32) / 255
        case "none":
            return image


def _through_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    assert decoded is not None
    return np.asarray(decoded, np.uint8)


def resized_masks(masks: Bool[np.ndarray, "V N h w"], radius_px: int) -> Bool[np.ndarray, "V N h w"]:
    """Dilate masks by a number of pixels, or erode them where it is negative, but not from the image's border.

    Masks that reach farther may overlap, as those of a segmentation that looks at one object after the other.
    """
    if radius_px == 0:
        return masks
    steps = np.arange(-abs(radius_px), abs(radius_px) + 1) ** 2
    disc = (steps[:, None] + steps <= radius_px**2).astype(np.uint8)
    change = cv2.dilate if radius_px > 0 else cv2.erode
    flat = masks.reshape(-1, *masks.shape[-2:]).astype(np.uint8)
    return np.array([change(mask, disc) for mask in flat], bool).reshape(masks.shape)


@dataclass(frozen=True, eq=False, slots=True)
class CameraError:
    """Difference of a camera's true pose from its calibration.

    Attributes:
        rotation: rotation vector about axes of the world through the optical centre [rad].
        shift: of the optical centre in the world [m].
    """

    rotation: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]

    @staticmethod
    def random(rng: np.random.Generator, turn_rad: float, shift_m: float) -> CameraError:
        """Draw an error of given size, about a random axis and in a random direction."""
        axis, direction = rng.standard_normal((2, 3))
        return CameraError(turn_rad * axis / np.linalg.norm(axis), shift_m * direction / np.linalg.norm(direction))

    def applied(self, camera: Camera) -> Camera:
        """Return the camera as it truly stands."""
        calibrated = camera.T_world_camera
        quaternion = quaternion_multiply(quaternion_exp(self.rotation), calibrated.quaternion)
        return replace(camera, T_world_camera=Pose(calibrated.position + self.shift, quaternion))


UNSEEN_NETWORK = "pushes_without_two"  # of the dynamics, trained without mustard bottle and tuna can
_SAME_RAD = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class Factor:
    """Difference of a world from the usual one; by default none.

    Attributes:
        conditions: lamp, table, contacts and what takes the pictures.
        has_wooden_table: the table is of wood, another one for each world.
        camera_turn_rad: by which every camera is turned, each about an axis of its own [rad].
        camera_shift_m: by which every camera is moved, each in a direction of its own [m].
        exposure: factor on every image, which saturates at 1.
        image: what becomes of every image then.
        mask_radius_px: by which masks reach too far [px], or not far enough where it is negative.
        has_unseen_objects: the dynamics are those that were trained without mustard bottle and tuna can, whose shapes
            are then all that is known of them. Fields are of single objects in any case.
        light_elevation_deg: between which the light stands above the table [deg]; None leaves it where it is.
    """

    conditions: Conditions = field(default_factory=Conditions)
    has_wooden_table: bool = False
    camera_turn_rad: float = 0.0
    camera_shift_m: float = 0.0
    exposure: float = 1.0
    image: ImageChange = "none"
    mask_radius_px: int = 0
    has_unseen_objects: bool = False
    light_elevation_deg: tuple[float, float] | None = None

    def light(self, light: Light, rng: np.random.Generator) -> Light:
        """Return a light as high as the factor has them, at the same azimuth."""
        if self.light_elevation_deg is None:
            return light
        x, y, _ = light.direction
        return Light.from_angles(float(np.arctan2(y, x)), float(np.deg2rad(rng.uniform(*self.light_elevation_deg))))

    def camera_errors(self, rng: np.random.Generator, count: int) -> list[CameraError]:
        """Draw errors of calibration, for each camera its own."""
        return [CameraError.random(rng, self.camera_turn_rad, self.camera_shift_m) for _ in range(count)]

    def drawn_conditions(self, rng: np.random.Generator) -> Conditions:
        """Return lamp, table and contacts; wood is drawn anew."""
        if not self.has_wooden_table:
            return self.conditions
        return replace(self.conditions, table=TableSurface(texture=wooden_texture(rng)))

    def received(self, taken: Observation, cameras: tuple[Camera, ...], rng: np.random.Generator) -> Observation:
        """Return pictures as a program gets them.

        Args:
            taken: by cameras as they stand.
            cameras: as they are calibrated.
            rng: draws the noise.
        """
        exposed = taken.images * np.float32(self.exposure) if self.exposure != 1 else taken.images
        images = np.stack([received(image, self.image, rng) for image in exposed])
        masks = None if taken.masks is None else resized_masks(taken.masks, self.mask_radius_px)
        return replace(taken, cameras=cameras, images=images, masks=masks)

    def task(self, task: RearrangementTask, rng: np.random.Generator) -> RearrangementTask:
        """Return a task under the factor's lights; where start and goal share one, they still do."""
        start = self.light(task.start.light, rng)
        is_same = task.goal.light.angle_to(task.start.light) < _SAME_RAD
        goal = start if is_same else self.light(task.goal.light, rng)
        return replace(task, start=replace(task.start, light=start), goal=replace(task.goal, light=goal))


def _ambient(share: float) -> Factor:
    """Return a lamp whose ambient light takes from the diffuse light."""
    return Factor(Conditions(lamp=Lamp(ambient=share, diffuse=1 - share)))


FACTORS: Mapping[str, Factor] = MappingProxyType(
    {
        "light_low": Factor(light_elevation_deg=(5.0, 10.0)),
        "intensity_0.5": Factor(Conditions(lamp=Lamp(intensity=0.5))),
        "intensity_1.5": Factor(Conditions(lamp=Lamp(intensity=1.5))),
        "ambient_0.1": _ambient(0.1),
        "ambient_0.5": _ambient(0.5),
        "light_coloured": Factor(Conditions(lamp=Lamp(colour=(1.0, 0.85, 0.65)))),
        "table_colour": Factor(Conditions(table=TableSurface((0.36, 0.44, 0.54)))),
        "table_wood": Factor(has_wooden_table=True),
        "camera_shifted": Factor(camera_turn_rad=float(np.deg2rad(0.3)), camera_shift_m=0.003),
        "noise_2": Factor(image="noise"),
        "jpeg_80": Factor(image="jpeg"),
        "srgb_8bit": Factor(image="srgb_8bit"),
        "srgb_8bit_decoded": Factor(image="srgb_8bit_decoded"),
        "masks_eroded_2": Factor(mask_radius_px=-2),
        "masks_dilated_2": Factor(mask_radius_px=2),
        "friction_0.5": Factor(Conditions(friction_factor=0.5)),
        "friction_2": Factor(Conditions(friction_factor=2.0)),
        "mass_0.5": Factor(Conditions(mass_factor=0.5)),
        "mass_2": Factor(Conditions(mass_factor=2.0)),
        "objects_unseen": Factor(has_unseen_objects=True),
        "exposure_0.7": Factor(exposure=0.7),
        "exposure_1.4": Factor(exposure=1.4),
        "ambient_0.6": _ambient(0.6),
        "table_dark": Factor(Conditions(table=TableSurface((0.20, 0.19, 0.17)))),
        "objects_shiny": Factor(Conditions(lamp=Lamp(specular=0.4))),
        "renderer_tiny": Factor(Conditions(renderer="tiny")),
        "mild_together": Factor(
            Conditions(lamp=Lamp(ambient=0.35, diffuse=0.65), table=TableSurface((0.50, 0.52, 0.53))),
            camera_turn_rad=float(np.deg2rad(0.15)),
            camera_shift_m=0.0015,
            exposure=0.85,
            image="srgb_noise_jpeg",
            mask_radius_px=1,
        ),
    }
)
_FIRST_FRAME_ONLY = ("exposure_0.7", "exposure_1.4", "ambient_0.6", "table_dark", "mild_together")
EPISODE_FACTORS = tuple(name for name in FACTORS if name not in _FIRST_FRAME_ONLY)  # measured in whole episodes
FIRST_FRAME_FACTORS = (
    "exposure_0.7", "exposure_1.4", "ambient_0.1", "ambient_0.6", "srgb_8bit", "table_dark", "table_wood",
    "table_colour", "noise_2", "jpeg_80", "camera_shifted", "masks_dilated_2", "masks_eroded_2", "mild_together",
)  # fmt: skip


def factor_named(name: str) -> Factor:
    """Return the factor of a name.

    Raises:
        UnknownName: if there is none of that name.
    """
    if name not in FACTORS:
        raise UnknownName("factor of variation", name, FACTORS)
    return FACTORS[name]


class VariedWorld(Tabletop):
    """A simulated tabletop under a factor: a `World` for the method, with the truth for whoever scores it.

    What a factor leaves to chance but for noise (wood, errors of the cameras) is drawn once, when the world is made.
    Only `observe` and `goal_image` show what the method gets; `render` has ideal cameras, for scores and pictures.

    Args:
        library: where the objects' meshes are.
        factor: what differs.
        rng: draws what the factor leaves to chance.
        cameras: what `observe` looks through, as they are calibrated.
        request: what `reset` puts on the table.

    Raises:
        UnknownName, MissingAssets, InvalidInput: if the request cannot be met.
    """

    def __init__(
        self,
        library: AssetLibrary,
        factor: Factor,
        rng: np.random.Generator,
        *,
        cameras: tuple[Camera, ...],
        request: SceneRequest | None = None,
    ) -> None:
        self._factor, self._rng = factor, rng
        errors = factor.camera_errors(rng, len(cameras))
        (self._goal_error,) = factor.camera_errors(rng, 1)
        super().__init__(library, cameras=cameras, request=request, conditions=factor.drawn_conditions(rng))
        self._standing = tuple(error.applied(camera) for error, camera in zip(errors, cameras, strict=True))

    def reset(self, seed: int) -> Observation:
        """Put a new random scene on the table, at rest.

        Raises:
            NoRoom: if the objects do not fit side by side.
        """
        self.arrange(seed)
        self.set_light(self._factor.light(self.truth().light, self._rng))
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """Return one image per camera, as the method gets them, with the cameras as they are calibrated."""
        return self._factor.received(self.render(self._standing, masks=masks), self.cameras, self._rng)

    def goal_image(self, state: SceneState, camera: Camera) -> GoalImage:
        """Return a state as a camera shows it to the method, without the pusher; the table is left like that.

        Args:
            state: put on the table, as by `restore`.
            camera: as it is calibrated; all goals are taken with the same error.
        """
        self.restore(state)
        taken = self.render((self._goal_error.applied(camera),), with_pusher=False)
        return GoalImage(camera, self._factor.received(taken, (camera,), self._rng).images[0])
