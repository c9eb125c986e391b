"""What an estimate minimises: parameters of a scene, models of objects and table, losses of paper eq. 5 and 6."""

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
        names: of the N objects.
        positions: of the objects [m].
        quaternions: unit.
        light: unit vector toward the light.
        pusher: its centre [m], or None.
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "N 3"]
    quaternions: Float[np.ndarray, "N 4"]
    light: Float[np.ndarray, "3"]
    pusher: Float[np.ndarray, "3"] | None

    @staticmethod
    def of(state: SceneState, pusher: Float[np.ndarray, "3"] | None) -> SceneParameters:
        """The objects and the light of a state, with this pusher."""
        return SceneParameters(state.names, state.poses.position, state.poses.quaternion, state.light.direction, pusher)

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return POSE * len(self.names) + LIGHT

    def pose(self, number: int) -> Pose:
        """`T_world_object` of one object."""
        return Pose(self.positions[number], self.quaternions[number])

    def with_pose(self, number: int, pose: Pose) -> SceneParameters:
        """The scene with one object in another pose `T_world_object`."""
        positions, quaternions = self.positions.copy(), self.quaternions.copy()
        positions[number], quaternions[number] = pose.position, pose.quaternion
        return replace(self, positions=positions, quaternions=quaternions)

    def state(self) -> SceneState:
        """The scene as a state."""
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
        """Return a batch of the scene itself, `count` times."""
        return self.perturbed(np.zeros((count, self.size)))


def empty_scene(light: Float[np.ndarray, "3"]) -> SceneBatch:
    """Return a batch of one scene without objects and pusher, under a light [unit vector toward it]."""
    return SceneBatch((), np.zeros((1, 0, 3)), np.zeros((1, 0, 4)), light[None], None)


# How an object can lie on a table, from its field alone.
#
# The height of the centre of mass over the table is a function of the direction that points down. Where it has a
# minimum the object lies stably; where it hardly changes from one direction to the next, as for a can on its side,
# every one of them is kept.


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
        heights: of the centre of mass above the table [m].
        centre: the centre of mass of a solid body of that shape, in the object's frame [m].
        radius: of the sphere around that centre that holds the object [m].
        hull: vertices of the convex hull, in the object's frame [m].
    """

    quaternions: Float[np.ndarray, "K 4"]
    heights: Float[np.ndarray, "K"]
    centre: Float[np.ndarray, "3"]
    radius: float
    hull: Float[np.ndarray, "H 3"]

    @property
    def origin_heights(self) -> Float[np.ndarray, "K"]:
        """Height of the object's origin above the table in each orientation [m]."""
        return self.heights - rotate(self.quaternions, self.centre)[:, 2]

    def lowest(self, pose: Pose) -> float:
        """Height of the lowest point of the object in a pose [m]."""
        return float(pose.apply(self.hull)[:, 2].min())

    def poses_at(self, centres: Float[np.ndarray, "... 3"], quaternions: Float[np.ndarray, "K 4"]) -> Pose:
        """Return K poses in given orientations whose centres of mass lie at one place or at K places [m]."""
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
    """Vertices of the convex hull of what is opaque, and the hull's centre of mass."""
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
    """Directions that are (almost) the lowest around them, thinned out, the lowest first."""
    cosines = directions @ directions.T
    lowest = np.where(cosines > np.cos(np.deg2rad(_NEIGHBOURHOOD_DEG)), heights, np.inf).min(axis=1)
    candidates = np.flatnonzero(heights <= lowest + _SLACK_M)
    kept: list[int] = []
    for k in candidates[np.argsort(heights[candidates])]:
        if all(cosines[k, other] < np.cos(np.deg2rad(_SPACING_DEG)) for other in kept):
            kept.append(int(k))
    return kept


def _rotation_downwards(direction: np.ndarray) -> np.ndarray:
    """A rotation that takes a unit vector to (0, 0, -1)."""
    axis = np.cross(direction, (0.0, 0.0, -1.0))
    sine = np.linalg.norm(axis)
    if sine < 1e-9:  # along the vertical already
        return np.array([1.0, 0.0, 0.0, 0.0] if direction[2] < 0 else [0.0, 1.0, 0.0, 0.0])
    return quaternion_exp(axis / sine * np.arctan2(sine, -direction[2]))


# What is known before any image: how each object looks, how it can lie, and how the table looks.


QUALITY: Quality = PLANNING
FieldT = TypeVar("FieldT", bound=DensityGrid)


class ObjectModels:
    """Fields of the objects, and two renderers of them.

    Attributes:
        alone: draws objects over black.
        together: draws them on the table.
    """

    def __init__(
        self,
        fields: Mapping[str, KiloOSF],
        table: TableField,
        *,
        device: str = "cpu",
        symmetries: Mapping[str, Symmetry] | None = None,
    ) -> None:
        """Prepare fields.

        Args:
            fields: by name of the object.
            table: what the objects lie on.
            device: where images are rendered, see `SceneRenderer`.
            symmetries: which orientations of an object look the same; none of those left out.

        Raises:
            InvalidInput: if there is no such device.
        """
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
        """Models whose fields another renderer draws.

        Args:
            renderer: makes renderers of fields, on a table or over black.
            fields: by name of the object.
            table: what the objects lie on.
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
        """Whether `changed` works, which it does not where another renderer draws fields of its own kind."""
        return self._changeable is not None

    def changed(
        self, names: Iterable[str], field: Callable[[KiloOSF], KiloOSF], table: Callable[[TableField], TableField]
    ) -> ObjectModels:
        """Models of some of the objects with another look and the same shapes.

        Args:
            names: of the objects.
            field: from a field to the one in its place, of the same density.
            table: likewise of the table.

        Raises:
            InvalidInput: where `can_change` is false.
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
        """Refuse objects without a field.

        Raises:
            UnknownName: if one has none.
        """
        for name in names:
            if name not in self._fields:
                raise UnknownName("field", name, sorted(self._fields))

    def turned(
        self, name: str, one: Float[np.ndarray, "4"], others: Float[np.ndarray, "B 4"]
    ) -> Float[np.ndarray, "B"]:
        """Angles between an object's orientations [rad], over all that look like `one`."""
        symmetry = self._symmetries.get(name, Symmetry("none"))
        return np.array([rotation_error(symmetry, other, one) for other in others])

    def resting(self, name: str) -> RestingOrientations:
        """Return how an object can lie on a table; it is found when first asked for."""
        if name not in self._resting:
            self.check((name,))
            self._resting[name] = resting_orientations(self._fields[name])
        return self._resting[name]

    def centre_of_mass(self, params: SceneParameters, number: int) -> Float[np.ndarray, "3"]:
        """Where the centre of mass of an object of a scene is [m]."""
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
        quality: of what is rendered to compare with.
        only: pixels that count, where not all do.
        unmasked: which of the masks nobody drew, if there are such.
    """

    cameras: tuple[Camera, ...]
    images: Float32[np.ndarray, "V h w 3"]
    masks: Float32[np.ndarray, "V N h w"] | None
    pusher: Float[np.ndarray, "3"] | None
    quality: Quality = QUALITY
    only: Bool[np.ndarray, "V h w"] | None = None
    unmasked: Bool[np.ndarray, "V N"] | None = None


def views_of(observation: Observation, side: int, *, samples: int = 1) -> ObservedViews:
    """An observation at the resolution at which it is compared with renderings.

    Args:
        observation: images are reduced by area averaging, never enlarged.
        side: longest side of the result [px]; the other does not fall below 16 px.
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
    """The windows of V views around one object; all of one size.

    Attributes:
        cameras: that see the windows alone.
        rgb: the object over black (paper eq. 5: image times mask).
        mask: share of each pixel that shows it.
        valid: pixels in which no other object hides it.
        area: of the mask [px]; at least 1.
        quality: of what is rendered to compare with.
    """

    cameras: tuple[Camera, ...]
    rgb: Float32[np.ndarray, "V h w 3"]
    mask: Float32[np.ndarray, "V h w"]
    valid: Bool[np.ndarray, "V h w"]
    area: Float32[np.ndarray, "V"]
    quality: Quality


def crop_to_masks(views: ObservedViews, number: int) -> ObjectView:
    """The windows around one object's masks.

    Args:
        views: with masks; views in which the object's is empty are left out, and at least one must not be.
        number: of the object.
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
    """The windows around one object of a guess, without masks, or whole images if none shows it.

    Args:
        views: whole images; those that do not show the object are left out.
        models: fields, for the object's bounding sphere.
        params: the guess.
        number: of the object.
        reach: by how much the windows reach beyond that sphere [m].
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
    """The windows around one object of a guess, of which only pixels in or just beside its silhouette count.

    Args:
        views: whole images.
        models: fields; the object is rendered alone for its silhouette.
        params: the guess.
        number: of the object.
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
    """The camera that sees a window of another's image.

    Args:
        camera: the other.
        x: left edge of the window in its image [px]; may lie outside.
        y: upper edge likewise [px].
        width: of the window [px].
        height: of the window [px].

    Raises:
        InvalidInput: if the window's sides are outside 16 to 1024 px.
    """
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= x, y
    return replace(camera, intrinsics=intrinsics, width=width, height=height)


def _crop_windows(masks: Bool[np.ndarray, "V h w"]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Corners (x, y) of windows around masks, none of them empty, and their common width and height [px]."""
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
    """Rendered minus observed [radiance]; 0 where pixels do not count.

    Args:
        models: fields of the objects and the table.
        views: what was observed.
        batch: B scenes to render.
    """
    rendered = models.together.render(batch, views.cameras, quality=views.quality, only=views.only)
    return rendered.rgb - views.images


def photometric_loss(errors: Float[np.ndarray, "B *pixels"]) -> Float[np.ndarray, "B"]:
    """Mean Huber loss over all pixels and colours of each scene.

    rho(r) = r^2 / 2 for |r| < h, h (|r| - h / 2) otherwise, with h = HUBER.

    Deviation from paper eq. 6, the mean square: outliers such as specular highlights count linearly.
    """
    size = np.abs(errors.reshape(len(errors), -1))
    return np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER)).mean(axis=1, dtype=float)


def loss_of(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> float:
    """Photometric loss of one scene.

    Args:
        models: fields of the objects and the table.
        views: what was observed.
        params: the scene.
    """
    return float(photometric_loss(residuals(models, views, params.repeated()))[0])


def pose_losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, number: int, poses: Pose
) -> Float[np.ndarray, "K"]:
    """Photometric loss of a scene with one object in each of K poses.

    Args:
        models: fields.
        views: images to compare with, whole ones or windows around the object.
        params: the guess; all other objects and the light stay.
        number: of the object.
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
        rgb: over black.
        opacity: share of each pixel that shows it.
    """

    rgb: Float32[np.ndarray, "B V h w 3"]
    opacity: Float32[np.ndarray, "B V h w"]


def render_poses(
    models: ObjectModels, name: str, part: ObjectView, poses: Pose, light: Float[np.ndarray, "3"]
) -> RenderedObject:
    """Render one object in B poses, alone.

    Args:
        models: fields.
        name: of the object.
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
    """Silhouette and colour error of each pose; 0 is perfect.

    With rendered opacity o, mask m, validity v, the mask's area A in each view, and P the pixels of both silhouettes:

        L = sum_views A / sum(A) * [ sum |o - m| v / A  +  w * sum_P min(|c_rendered - c_observed|, e_max) / A ]

    Deviations from paper eq. 5, the mean squared error inside the masks: absolute errors, truncated at e_max, so that
    shadows of other objects, which are not rendered here, do not decide; the silhouette is a term of its own; pixels
    that other objects may cover are left out.

    Args:
        look: rendered images of B poses.
        part: the observed crop of each view.
        any_brightness: scale colours by the least-squares factor of each pose and view: the light is not known yet.

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
