"""The objective of an estimate: scene parameters, models of objects and table, and the losses of paper eq. 5 and 6."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial import ConvexHull

from osfcore.errors import InvalidInput, UnknownName
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import MIN_IMAGE_SIDE, Camera
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, fibonacci_sphere, orthogonal_basis, quaternion_exp, quaternion_multiply, rotate
from osfcore.geometry.states import Observation, SceneState
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import PLANNING, Quality, Renderer, SceneBatch

# The parameter vector of a scene: changes of poses and light in the tangent space of a current scene.
#
# delta = (t_1, w_1, ..., t_N, w_N, a, b): for each of N objects a translation t [m] and a rotation vector w [rad]
# along the world's axes, p <- p + t, q <- exp(w) q; then two components of the light, l <- normalize(l + a e_1 + b
# e_2) with e_1, e_2 orthogonal to l. The exponential map has no singularities and keeps quaternions unit.


POSE = 6  # numbers per object
LIGHT = 2
_LOWEST_SLOPE = np.tan(np.deg2rad(MIN_LIGHT_ELEVATION_DEG + 1e-3))


@dataclass(frozen=True, eq=False, slots=True)
class SceneParameters:
    """The scene at which the parameter vector is zero.

    Attributes:
        names: names of the N objects.
        positions: positions of the objects in the world [m].
        quaternions: orientations of the objects in the world as unit quaternions (w, x, y, z).
        light: unit vector toward the light.
        pusher: centre of the pusher in the world [m], or None.
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "N 3"]
    quaternions: Float[np.ndarray, "N 4"]
    light: Float[np.ndarray, "3"]
    pusher: Float[np.ndarray, "3"] | None

    @staticmethod
    def of(state: SceneState, pusher: Float[np.ndarray, "3"] | None) -> SceneParameters:
        """Return the parameters of a state, with this pusher."""
        return SceneParameters(state.names, state.poses.position, state.poses.quaternion, state.light.direction, pusher)

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return POSE * len(self.names) + LIGHT

    def pose(self, number: int) -> Pose:
        """Return `T_world_object` of one object."""
        return Pose(self.positions[number], self.quaternions[number])

    def with_pose(self, number: int, pose: Pose) -> SceneParameters:
        """Return the scene with one object in another pose `T_world_object`."""
        positions, quaternions = self.positions.copy(), self.quaternions.copy()
        positions[number], quaternions[number] = pose.position, pose.quaternion
        return replace(self, positions=positions, quaternions=quaternions)

    def state(self) -> SceneState:
        """Return the scene as a state."""
        return SceneState(self.names, Pose(self.positions, self.quaternions), Light(self.light), self.pusher)

    def perturbed(self, changes: Float[np.ndarray, "B P"]) -> SceneBatch:
        """Return the B scenes of a batch of parameter vectors, one per row."""
        count = len(self.names)
        poses = changes[:, : POSE * count].reshape(len(changes), count, POSE)
        positions = self.positions + poses[..., :3]
        quaternions = quaternion_multiply(quaternion_exp(poses[..., 3:]), self.quaternions[None])
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        first, second = orthogonal_basis(self.light)
        lights = self.light + changes[:, -2:-1] * first + changes[:, -1:] * second
        lights[:, 2] = np.maximum(lights[:, 2], _LOWEST_SLOPE * np.hypot(lights[:, 0], lights[:, 1]))
        lights /= np.linalg.norm(lights, axis=1, keepdims=True)
        pusher = None if self.pusher is None else np.tile(self.pusher, (len(changes), 1))
        return SceneBatch(self.names, positions, quaternions, lights, pusher)

    def updated(self, change: Float[np.ndarray, "P"]) -> SceneParameters:
        """Return the scene of one parameter vector."""
        batch = self.perturbed(change[None])
        return replace(self, positions=batch.positions[0], quaternions=batch.quaternions[0], light=batch.lights[0])

    def repeated(self, count: int = 1) -> SceneBatch:
        """Return a batch with `count` copies of the scene."""
        return self.perturbed(np.zeros((count, self.size)))


def empty_scene(light: Float[np.ndarray, "3"]) -> SceneBatch:
    """Return a batch of one scene without objects and pusher, under a light [unit vector toward it]."""
    return SceneBatch((), np.zeros((1, 0, 3)), np.zeros((1, 0, 4)), light[None], None)


# The resting orientations of an object, from its field alone.
#
# The height of the centre of mass over the table is a function of the direction that points down. At a minimum of it
# the object lies stably. Where the height hardly changes between neighbouring directions, as for a can on its side, all
# of them are kept.


_OPAQUE_G = 2.0  # density feature above which a corner counts as solid
_DIRECTIONS = 3000
_NEIGHBOURHOOD_DEG = 20.0
_SLACK_M = 1.5e-3  # above the lowest direction nearby
_SPACING_DEG = 15.0
_YAWS = 24


class DensityGrid(Protocol):
    """A field's density features on a grid: `osfcore.fields.kiloosf.KiloOSF`, or the paper's."""

    @property
    def origin(self) -> Float32[np.ndarray, "3"]:
        """Corner (0, 0, 0) of the grid [m]."""
        ...

    @property
    def voxel(self) -> float:
        """Side of a voxel [m]."""
        ...

    @property
    def density(self) -> Float32[np.ndarray, "nx ny nz"]:
        """Density features on all corners."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class RestingOrientations:
    """Orientations in which an object may lie on a table, each turned about the vertical in equal steps.

    Attributes:
        quaternions: rotations from the object's frame to the world.
        heights: heights of the centre of mass above the table [m].
        centre: the centre of mass of a solid body of that shape, in the object's frame [m].
        radius: radius of the sphere around that centre that holds the object [m].
        hull: vertices of the convex hull, in the object's frame [m].
    """

    quaternions: Float[np.ndarray, "K 4"]
    heights: Float[np.ndarray, "K"]
    centre: Float[np.ndarray, "3"]
    radius: float
    hull: Float[np.ndarray, "H 3"]

    @property
    def origin_heights(self) -> Float[np.ndarray, "K"]:
        """Return the height of the object's origin above the table in each orientation [m]."""
        return self.heights - rotate(self.quaternions, self.centre)[:, 2]

    def lowest(self, pose: Pose) -> float:
        """Return the height of the lowest point of the object in a pose [m]."""
        return float(pose.apply(self.hull)[:, 2].min())

    def poses_at(self, centres: Float[np.ndarray, "... 3"], quaternions: Float[np.ndarray, "K 4"]) -> Pose:
        """Return K poses in these orientations, with the centres of mass at one place or at K places [m]."""
        return Pose(centres - rotate(quaternions, self.centre), quaternions)


def resting_orientations(field: DensityGrid, *, yaws: int = _YAWS) -> RestingOrientations:
    """Find the resting orientations of a field, each turned about the vertical in `yaws` steps."""
    vertices, centre = _solid(field)
    directions = fibonacci_sphere(_DIRECTIONS)
    heights = ((vertices - centre) @ directions.T).max(axis=0)
    down = _stable(directions, heights)
    lying = np.array([_rotation_downwards(directions[k]) for k in down])
    quaternions = quaternion_multiply(full_circle(yaws)[None], lying[:, None]).reshape(-1, 4)
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    return RestingOrientations(quaternions, np.repeat(heights[down], yaws), centre, radius, vertices)


def yaw_quaternions(angles: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K 4"]:
    """Return turns about the vertical by angles [rad]."""
    return quaternion_exp(np.stack([np.zeros_like(angles), np.zeros_like(angles), angles], axis=1))


def full_circle(steps: int) -> Float[np.ndarray, "steps 4"]:
    """Return turns about the vertical in equal steps, beginning with none."""
    return yaw_quaternions(np.arange(steps) * 2 * np.pi / steps)


def _solid(field: DensityGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and the centre of mass of the convex hull of the opaque corners."""
    solid = np.argwhere(field.density > min(_OPAQUE_G, float(field.density.max()) - 1))
    points = field.origin + field.voxel * solid
    hull = ConvexHull(points, qhull_options="QJ")  # joggled: a flat or degenerate field still has a hull
    corners = points[hull.simplices]
    inside = points[hull.vertices].mean(axis=0)
    sides = corners - inside
    volumes = np.abs(np.einsum("ij,ij->i", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])))
    centres = (corners.sum(axis=1) + inside) / 4
    return points[hull.vertices], (centres * volumes[:, None]).sum(axis=0) / volumes.sum()


def _stable(directions: np.ndarray, heights: np.ndarray) -> list[int]:
    """Return directions that are (almost) the lowest among their neighbours, thinned out, the lowest first."""
    cosines = directions @ directions.T
    lowest = np.where(cosines > np.cos(np.deg2rad(_NEIGHBOURHOOD_DEG)), heights, np.inf).min(axis=1)
    candidates = np.flatnonzero(heights <= lowest + _SLACK_M)
    kept: list[int] = []
    for k in candidates[np.argsort(heights[candidates])]:
        if all(cosines[k, other] < np.cos(np.deg2rad(_SPACING_DEG)) for other in kept):
            kept.append(int(k))
    return kept


def _rotation_downwards(direction: np.ndarray) -> np.ndarray:
    """Return a rotation that takes a unit vector to (0, 0, -1)."""
    axis = np.cross(direction, (0.0, 0.0, -1.0))
    sine = np.linalg.norm(axis)
    if sine < 1e-9:  # along the vertical already
        return np.array([1.0, 0.0, 0.0, 0.0] if direction[2] < 0 else [0.0, 1.0, 0.0, 0.0])
    return quaternion_exp(axis / sine * np.arctan2(sine, -direction[2]))


# Known before any image: how each object looks, how it can lie, and how the table looks.


QUALITY: Quality = PLANNING
FieldT = TypeVar("FieldT", bound=DensityGrid)


class ObjectModels:
    """What an estimator knows of the objects: their fields, renderers of them, and their symmetries.

    Args:
        fields: fields of the objects, by name.
        table: field of the table.
        device: where images are rendered, as in `SceneRenderer`.
        symmetries: orientations of each object that look the same; none for objects that are left out.

    Attributes:
        alone: renderer of the objects over black.
        together: renderer of the objects on the table.

    Raises:
        InvalidInput: if there is no such device.

    Example:
        >>> models = ObjectModels({name: fields.load(name)}, fields.load_table())
        >>> models.together.names
        ('006_mustard_bottle',)
    """

    def __init__(
        self,
        fields: Mapping[str, KiloOSF],
        table: TableField,
        *,
        device: str = "cpu",
        symmetries: Mapping[str, Symmetry] | None = None,
    ) -> None:
        alone, together = (SceneRenderer(fields, ground, device=device) for ground in (None, table))
        self._set(fields, alone, together)
        self._changeable = fields, table, device
        self._symmetries = dict(symmetries or {})

    @classmethod
    def rendered_by(
        cls,
        renderer: Callable[[Mapping[str, FieldT], TableField | None], Renderer],
        fields: Mapping[str, FieldT],
        table: TableField,
    ) -> ObjectModels:
        """Return models whose fields another renderer draws.

        Args:
            renderer: makes a renderer of fields, on a table or over black.
            fields: fields of the objects, by name.
            table: field of the table.
        """
        models = cls.__new__(cls)
        models._set(fields, renderer(fields, None), renderer(fields, table))
        return models

    def _set(self, fields: Mapping[str, DensityGrid], alone: Renderer, together: Renderer) -> None:
        self._fields = dict(fields)
        self._resting: dict[str, RestingOrientations] = {}
        self._symmetries: dict[str, Symmetry] = {}
        self._changeable: tuple[Mapping[str, KiloOSF], TableField, str] | None = None
        self.alone, self.together = alone, together

    @property
    def can_change(self) -> bool:
        """Whether `changed` works. It does not work with models made by `rendered_by`."""
        return self._changeable is not None

    def changed(
        self, names: Iterable[str], field: Callable[[KiloOSF], KiloOSF], table: Callable[[TableField], TableField]
    ) -> ObjectModels:
        """Return models of some of the objects that look different but have the same shapes.

        Args:
            names: names of the objects.
            field: maps each field to its replacement, which must have the same density.
            table: maps the table to its replacement.

        Raises:
            InvalidInput: if `can_change` is false.
        """
        if self._changeable is None:
            raise InvalidInput(
                "renderer of the models to change", "of another kind", "the one that they were made with"
            )
        fields, ground, device = self._changeable
        changed = {name: field(fields[name]) for name in names}
        models = ObjectModels(changed, table(ground), device=device, symmetries=self._symmetries)
        models._resting = {name: self.resting(name) for name in names}
        return models

    def check(self, names: tuple[str, ...]) -> None:
        """Check that objects have a field.

        Raises:
            UnknownName: if an object has none.
        """
        for name in names:
            if name not in self._fields:
                raise UnknownName("field", name, sorted(self._fields))

    def turned(
        self, name: str, one: Float[np.ndarray, "4"], others: Float[np.ndarray, "B 4"]
    ) -> Float[np.ndarray, "B"]:
        """Return the angles [rad] from each of `others` to the nearest orientation that looks like `one`."""
        symmetry = self._symmetries.get(name, Symmetry("none"))
        return np.array([rotation_error(symmetry, other, one) for other in others])

    def resting(self, name: str) -> RestingOrientations:
        """Return the orientations in which an object can rest on a table. The first call computes them."""
        if name not in self._resting:
            self.check((name,))
            self._resting[name] = resting_orientations(self._fields[name])
        return self._resting[name]

    def centre_of_mass(self, params: SceneParameters, number: int) -> Float[np.ndarray, "3"]:
        """Return the centre of mass of one object of a scene, in the world [m]."""
        centre = self.resting(params.names[number]).centre
        return params.positions[number] + rotate(params.quaternions[number], centre)


# Observations at the resolutions the estimator works at, and the parts of them that show one object.


FINE_SIDE = 128  # more pixels would cost time and add little
_BESIDE_PX = 3  # of its silhouette that an object may come to cover in one step
_MARGIN_PX = 3  # around an object's sphere or its masks
_OTHER_SHARE = 0.3  # of a pixel that others may cover before it does not count for an object


@dataclass(frozen=True, eq=False, slots=True)
class ObservedViews:
    """An observation at one resolution.

    Attributes:
        cameras: V cameras.
        images: linear RGB.
        masks: share of each pixel that shows each object, or None.
        pusher: centre of the pusher [m], or None.
        quality: quality of the renderings that are compared with the images.
        only: pixels that are compared; None for all.
        unmasked: which of the masks nobody drew; None if all are there.
    """

    cameras: tuple[Camera, ...]
    images: Float32[np.ndarray, "V h w 3"]
    masks: Float32[np.ndarray, "V N h w"] | None
    pusher: Float[np.ndarray, "3"] | None
    quality: Quality = QUALITY
    only: Bool[np.ndarray, "V h w"] | None = None
    unmasked: Bool[np.ndarray, "V N"] | None = None


def views_of(observation: Observation, side: int, *, samples: int = 1) -> ObservedViews:
    """Return an observation at the resolution at which it is compared with renderings.

    Args:
        observation: the observation. Its images are reduced by area averaging, never enlarged.
        side: longest side of the result [px]. The other side is at least 16 px.
        samples: rays along each side of a rendered pixel.
    """
    height, width = observation.images.shape[1:3]
    scale = min(1.0, side / max(height, width))
    size = (max(MIN_IMAGE_SIDE, round(width * scale)), max(MIN_IMAGE_SIDE, round(height * scale)))
    cameras = tuple(camera.resized(*size) for camera in observation.cameras)
    images = np.stack([_resize(image, size) for image in observation.images])
    masks = observation.masks
    if masks is not None:
        masks = np.stack([[_resize(mask, size) for mask in view] for view in masks.astype(np.float32)])
        masks = masks.reshape(len(cameras), len(observation.names), size[1], size[0])
    quality = replace(QUALITY, samples_per_side=samples)
    return ObservedViews(cameras, images, masks, observation.pusher, quality, unmasked=observation.unmasked)


def _resize(image: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "h w *c"]:
    image = np.ascontiguousarray(image, np.float32)
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, eq=False, slots=True)
class ObjectView:
    """Windows of V views around one object, all of one size.

    Attributes:
        cameras: cameras that see only the windows.
        rgb: the object over black (paper eq. 5: image times mask).
        mask: share of each pixel that shows it.
        valid: pixels in which no other object hides it.
        area: area of the mask [px]; at least 1.
        quality: quality of the renderings that are compared with the windows.
    """

    cameras: tuple[Camera, ...]
    rgb: Float32[np.ndarray, "V h w 3"]
    mask: Float32[np.ndarray, "V h w"]
    valid: Bool[np.ndarray, "V h w"]
    area: Float32[np.ndarray, "V"]
    quality: Quality


def crop_to_masks(views: ObservedViews, number: int) -> ObjectView:
    """Return the windows around the masks of one object.

    Args:
        views: images with masks. Views with an empty mask of the object are left out; at least one must not be empty.
        number: index of the object.
    """
    assert views.masks is not None
    shown = [v for v, mask in enumerate(views.masks[:, number]) if mask.max() > 0.5]
    own = views.masks[shown, number]
    others = np.delete(views.masks[shown], number, axis=1)
    covered = others.max(axis=1) if others.shape[1] else np.zeros_like(own)
    corners, (width, height) = _crop_windows(own > 0.5)

    def cut(array: np.ndarray) -> np.ndarray:
        return np.stack([a[y : y + height, x : x + width] for a, (x, y) in zip(array, corners, strict=True)])

    cameras = tuple(
        crop_camera(views.cameras[v], x, y, width, height) for v, (x, y) in zip(shown, corners, strict=True)
    )
    mask, valid = cut(own), cut(covered) < _OTHER_SHARE
    area = np.maximum((mask * valid).sum(axis=(1, 2)), 1)
    return ObjectView(cameras, cut(views.images[shown]) * mask[..., None], mask, valid, area, views.quality)


def crop_to_object(
    views: ObservedViews, models: ObjectModels, params: SceneParameters, number: int, *, reach: float = 0.0
) -> ObservedViews:
    """Return the windows around one object of a guess, without masks; whole images if none shows it.

    Args:
        views: whole images. Those that do not show the object are left out.
        models: models of the objects, for the bounding sphere.
        params: guess of the scene.
        number: index of the object.
        reach: margin of the windows around that sphere [m].
    """
    radius, centre = models.resting(params.names[number]).radius, models.centre_of_mass(params, number)
    height, width = views.images.shape[1:3]
    boxes = []
    for view, camera in enumerate(views.cameras):
        depth = float(camera.T_world_camera.inverse().apply(centre)[2])
        if depth < radius:
            continue
        x, y = camera.project(centre)
        half = camera.intrinsics[0, 0] / depth * (radius + reach) + _MARGIN_PX
        if -half < x < width + half and -half < y < height + half:
            boxes.append((view, x, y, half))
    if not boxes:
        return replace(views, masks=None)
    side = int(np.ceil(2 * max(half for *_, half in boxes)))
    w, h = min(max(side, MIN_IMAGE_SIDE), width), min(max(side, MIN_IMAGE_SIDE), height)
    corners = [(int(np.clip(x - w / 2, 0, width - w)), int(np.clip(y - h / 2, 0, height - h))) for _, x, y, _ in boxes]
    cameras = tuple(crop_camera(views.cameras[v], x, y, w, h) for (v, *_), (x, y) in zip(boxes, corners, strict=True))
    windows = [(v, slice(y, y + h), slice(x, x + w)) for (v, *_), (x, y) in zip(boxes, corners, strict=True)]
    images = np.stack([views.images[window] for window in windows])
    return ObservedViews(cameras, images, None, views.pusher, views.quality)


def crop_to_silhouette(
    views: ObservedViews, models: ObjectModels, params: SceneParameters, number: int
) -> ObservedViews:
    """Return the windows around one object of a guess, in which only pixels at its silhouette count.

    Args:
        views: whole images.
        models: models of the objects, to render the silhouette.
        params: guess of the scene.
        number: index of the object.
    """
    own = crop_to_object(views, models, params, number)
    alone = SceneBatch((params.names[number],), params.positions[None, [number]], params.quaternions[None, [number]],
                       params.light[None], None)  # fmt: skip
    rendered = models.alone.render(alone, own.cameras, quality=QUALITY, outputs={"opacity"})
    assert rendered.opacity is not None
    silhouettes = (rendered.opacity[0, :, 0] > 0).astype(np.uint8)
    kernel = np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)
    only = np.stack([cv2.dilate(silhouette, kernel) for silhouette in silhouettes]).astype(bool)
    return replace(own, images=own.images * only[..., None], only=only) if only.any() else own


def crop_camera(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """Return a camera that sees only a window of another camera's image.

    Args:
        camera: the other camera.
        x: left edge of the window in its image [px]; may lie outside.
        y: upper edge of the window [px]; may lie outside.
        width: width of the window [px].
        height: height of the window [px].

    Raises:
        InvalidInput: if the window's sides are outside 16 to 1024 px.
    """
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= x, y
    return replace(camera, intrinsics=intrinsics, width=width, height=height)


def _crop_windows(masks: Bool[np.ndarray, "V h w"]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return corners (x, y) of windows around masks that are not empty, and their common width and height [px]."""
    height, width = masks.shape[1:]
    boxes = []
    for mask in masks:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append((columns[0], columns[-1] + 1, rows[0], rows[-1] + 1))
    x0, x1, y0, y1 = np.array(boxes).T
    size = (
        int(np.clip((x1 - x0).max() + 2 * _MARGIN_PX, min(MIN_IMAGE_SIDE, width), width)),
        int(np.clip((y1 - y0).max() + 2 * _MARGIN_PX, min(MIN_IMAGE_SIDE, height), height)),
    )
    x = np.clip((x0 + x1 - size[0]) // 2, 0, width - size[0])
    y = np.clip((y0 + y1 - size[1]) // 2, 0, height - size[1])
    return list(zip(x.tolist(), y.tolist(), strict=True)), size


# The photometric loss of whole scenes: objects, pusher, table and shadows against the images (paper eq. 6).


HUBER = 0.1  # h [radiance]


def residuals(models: ObjectModels, views: ObservedViews, batch: SceneBatch) -> Float32[np.ndarray, "B V h w 3"]:
    """Return rendered minus observed images [radiance]; 0 at pixels that do not count.

    Args:
        models: models of the objects and the table.
        views: the images.
        batch: B scenes to render.
    """
    rendered = models.together.render(batch, views.cameras, quality=views.quality, only=views.only)
    return rendered.rgb - views.images


def photometric_loss(errors: Float[np.ndarray, "B *pixels"]) -> Float[np.ndarray, "B"]:
    """Return the mean Huber loss over all pixels and colours of each scene.

    rho(r) = r^2 / 2 for |r| < h, h (|r| - h / 2) otherwise, with h = HUBER.

    Deviation from paper eq. 6, which is the mean square: outliers such as specular highlights count linearly.
    """
    size = np.abs(errors.reshape(len(errors), -1))
    return np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER)).mean(axis=1, dtype=float)


def loss_of(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> float:
    """Return the photometric loss of one scene.

    Args:
        models: models of the objects and the table.
        views: the images.
        params: the scene.
    """
    return float(photometric_loss(residuals(models, views, params.repeated()))[0])


def pose_losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, number: int, poses: Pose
) -> Float[np.ndarray, "K"]:
    """Return the photometric loss of a scene with one object in each of K poses.

    Args:
        models: models of the objects and the table.
        views: images to compare with: whole images or windows around the object.
        params: the guess, in which all other objects and the light stay.
        number: index of the object.
        poses: the K poses, a batch of `T_world_object`.
    """
    batch = params.repeated(len(poses.position))
    positions, quaternions = batch.positions.copy(), batch.quaternions.copy()
    positions[:, number], quaternions[:, number] = poses.position, poses.quaternion
    return photometric_loss(residuals(models, views, replace(batch, positions=positions, quaternions=quaternions)))


# The masked loss: one object rendered alone against the images inside its masks (paper eq. 5), many poses at once.


COLOUR_WEIGHT = 6.0  # w: of the colour term against the silhouette term
_MAX_ERROR = 0.3  # e_max [radiance]
_LEAST_GAIN, _MOST_GAIN = 0.2, 4.0


@dataclass(frozen=True, eq=False, slots=True)
class RenderedObject:
    """Renderings of one object in B poses, cropped as its `ObjectView`.

    Attributes:
        rgb: linear radiance of the object over black.
        opacity: share of each pixel that shows it.
    """

    rgb: Float32[np.ndarray, "B V h w 3"]
    opacity: Float32[np.ndarray, "B V h w"]


def render_poses(
    models: ObjectModels, name: str, part: ObjectView, poses: Pose, light: Float[np.ndarray, "3"]
) -> RenderedObject:
    """Render one object in B poses, alone.

    Args:
        models: models of the objects and the table.
        name: name of the object.
        part: the crop whose cameras and quality are used.
        poses: the B poses, a batch of `T_world_object`.
        light: unit vector toward the light, the same for all poses.
    """
    lights = np.tile(light, (len(poses.position), 1))
    batch = SceneBatch((name,), poses.position[:, None], poses.quaternion[:, None], lights, None)
    rendered = models.alone.render(batch, part.cameras, quality=part.quality, outputs={"rgb", "opacity"})
    assert rendered.opacity is not None
    return RenderedObject(rendered.rgb, rendered.opacity[:, :, 0])


def masked_loss(look: RenderedObject, part: ObjectView, *, any_brightness: bool = False) -> Float[np.ndarray, "B"]:
    """Return the silhouette and colour error of each pose; 0 is perfect.

    With rendered opacity o, mask m, validity v, the mask's area A in each view, and P the pixels of both silhouettes:

        L = sum_views A / sum(A) * [ sum |o - m| v / A  +  w * sum_P min(|c_rendered - c_observed|, e_max) / A ]

    Deviations from paper eq. 5, the mean squared error inside the masks: errors are absolute and truncated at e_max, so
    that shadows of other objects, which are not rendered here, have little weight. The silhouette has a term of its
    own. Pixels that other objects may cover are left out.

    Args:
        look: rendered images of B poses.
        part: the observed crop of each view.
        any_brightness: whether to scale colours by the least-squares factor of each pose and view, because the light is
            not known yet.

    Returns:
        The loss of each pose.
    """
    silhouette = (np.abs(look.opacity - part.mask) * part.valid).sum(axis=(2, 3)) / part.area
    both = ((look.opacity > 0.5) & (part.mask > 0.5) & part.valid)[..., None]
    rgb = look.rgb
    if any_brightness:
        shown = rgb * both
        gain = (shown * part.rgb).sum(axis=(2, 3, 4)) / np.maximum((shown * shown).sum(axis=(2, 3, 4)), 1e-6)
        rgb = rgb * np.clip(gain, _LEAST_GAIN, _MOST_GAIN)[..., None, None, None]
    errors = np.minimum(np.abs(rgb - part.rgb), _MAX_ERROR) * both
    colour = errors.mean(axis=-1).sum(axis=(2, 3)) / part.area
    weights = part.area / part.area.sum()
    return ((silhouette + COLOUR_WEIGHT * colour) * weights).sum(axis=1).astype(float)
