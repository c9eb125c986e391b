"""The lamp of photographs: its direction from shading and shadows, and its distance if the photographs show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.optimize import least_squares

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import MIN_LAMP_DISTANCE_M, MIN_LIGHT_ELEVATION_DEG, SpotLamp
from osfcore.geometry.poses import Pose, fibonacci_sphere, orthogonal_basis, quaternion_to_matrix, rotate
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import Surfels, draw, draw_surfels, lens, object_windows, rotation_and_position
from osfcore.photo.poses import PhotoObject

Vector = Float[np.ndarray, "3"]
Vectors = Float[np.ndarray, "P 3"]
Colours = Float[np.ndarray, "P C"]
PerPixel = Float[np.ndarray, "P"]
Columns = Float[np.ndarray, "P K"]
Jacobian = Float[np.ndarray, "P 3 count"]
Light = Float[np.ndarray, "K"]  # of K terms, in one colour
Lights = Float[np.ndarray, "3 K"]

# The direction toward a lamp, from the shading of surfaces whose normals and albedo are known.
#
# For each colour c and pixel p, with b small (a ridge),
#
#     I_pc = albedo_pc * (a_c + b_c . n_p + k_c * max(n_p . l, 0) * visible_p(l)),
#
# so that a, b and k follow from linear least squares and only l is searched: over a grid of directions, then by
# Levenberg-Marquardt on the sphere. Residuals are weighted by Tukey's biweight: highlights and shadows that others
# cast must not count. The light is called diffuse if ambient light and first-order harmonics alone explain the
# image nearly as well, and these are not more directed than a room's: |b| / a is 2 for a point light (E(n) = 1/4 +
# n . l / 2 + ...), 0 for a sky.


Visibility = Callable[[Vector], PerPixel] | None  # share of a lamp's light from a direction that reaches each pixel
Solution = tuple[Vectors, Lights]  # residuals and light

_DIRECTIONS = 600
_SHADED = 60  # of them, the best without shadows, that are compared with them
_RIDGE = 0.05  # of the harmonics, which explain less of a gradient than a lamp
_ROUNDS = 3  # of reweighting
_TUKEY = 4.685  # deviations; 95 % efficient for normal errors
_LEAST_STD = 2e-3  # [radiance]
_LEAST_GAIN = 0.05  # share of the harmonics' squared residual that a lamp must explain
_MOST_DIRECTED = 1.0  # |b| / a of what is called diffuse
_FEWEST = 50  # pixels


def _check_count(pixels: np.ndarray) -> None:
    if len(pixels) < _FEWEST:
        raise InvalidInput("number of shaded pixels", len(pixels), f"{_FEWEST} or more")


@dataclass(frozen=True, eq=False, slots=True)
class ShadedPixels:
    """Pixels with known normal and albedo.

    Attributes:
        radiance: linear radiance, well exposed.
        albedo: linear albedo.
        normals: outward unit normals.
    """

    radiance: Vectors
    albedo: Vectors
    normals: Vectors

    def __post_init__(self) -> None:
        """Check the number of pixels.

        Raises:
            InvalidInput: if there are fewer than 50.
        """
        _check_count(self.radiance)


@dataclass(frozen=True, eq=False, slots=True)
class LampFit:
    """The light of one photograph.

    Attributes:
        direction: unit vector toward the lamp, in the frame of the normals.
        std: its standard deviation, per axis, from the curvature of the residuals [rad].
        strength: light of the lamp on a surface that faces it, per colour, where the radiance of white is 1.
        gain: share of the squared residual of ambient light and harmonics that the lamp explains.
        is_diffuse: whether there is no single lamp, so that the direction is unreliable.
    """

    direction: Vector
    std: float
    strength: Vector
    gain: float
    is_diffuse: bool


def fit_lamp(pixels: ShadedPixels, visible: Visibility = None) -> LampFit:
    """Estimate the direction of the lamp.

    Args:
        pixels: pixels of all objects in one photograph.
        visible: function from a direction to the share of the lamp's light that reaches each pixel; no shadows by
            default.
    """
    weights, grid = np.ones(len(pixels.radiance)), fibonacci_sphere(_DIRECTIONS)
    for shadows in [None] if visible is None else [None, visible]:
        costs = [_squared(_solve(pixels, d, shadows, weights)[0], weights) for d in grid]
        grid = grid[np.argsort(costs, kind="stable")[:_SHADED]]
    direction = grid[0]
    for _ in range(_ROUNDS):
        direction, std = _refine(pixels, direction, visible, weights)
        weights = _tukey(_solve(pixels, direction, visible, weights)[0])
    direction, std = _refine(pixels, direction, visible, weights)
    residual, light = _solve(pixels, direction, visible, weights)
    without, harmonics = _solve(pixels, None, visible, weights)
    gain = _gain(residual, without, weights)
    ambient, *gradient = harmonics.mean(axis=0)
    is_diffuse = light[:, -1].mean() <= 0 or not _speaks_for_lamp(gain, np.array(gradient), float(ambient))
    return LampFit(direction, std, light[:, -1], gain, bool(is_diffuse))


def _solve(pixels: ShadedPixels, direction: Vector | None, visible: Visibility, weights: PerPixel) -> Solution:
    """Fit the light under a lamp from a direction, or without a lamp, and return the residuals and that light."""
    basis = [np.ones(len(weights)), *pixels.normals.T]
    if direction is not None:
        lit = np.maximum(pixels.normals @ direction, 0)
        basis.append(lit if visible is None else lit * visible(direction))
    shape = np.stack(basis, axis=1)
    ridge = np.array([0.0, _RIDGE, _RIDGE, _RIDGE, 0.0])[: shape.shape[1]] if direction is not None else np.zeros(4)
    residual, light = np.empty_like(pixels.radiance), np.empty((3, shape.shape[1]))
    for c in range(3):
        shades = shape * pixels.albedo[:, c, None]
        weighted = shades * weights[:, None]
        normal = weighted.T @ shades
        normal += np.diag(ridge * normal[0, 0] + 1e-9 * max(normal[0, 0], 1e-9))
        light[c] = np.linalg.solve(normal, weighted.T @ pixels.radiance[:, c])
        residual[:, c] = pixels.radiance[:, c] - shades @ light[c]
    return residual, light


def _refine(pixels: ShadedPixels, start: Vector, visible: Visibility, weights: PerPixel) -> tuple[Vector, float]:
    """Return the direction nearby with the least weighted residual, and its standard deviation [rad]."""
    right, up = orthogonal_basis(start)
    root = np.sqrt(weights)[:, None]

    def at(x: np.ndarray) -> np.ndarray:
        turned = start + x[0] * right + x[1] * up
        return turned / np.linalg.norm(turned)

    def cost(x: np.ndarray) -> np.ndarray:
        return (root * _solve(pixels, at(x), visible, weights)[0]).ravel()

    found = least_squares(cost, np.zeros(2), diff_step=1e-3, max_nfev=30)
    variance = 2 * found.cost / max(len(found.fun) - 20, 1)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    return at(found.x), float(np.sqrt(np.trace(covariance) / 2))


def _tukey(residual: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(residual, axis=1) / np.sqrt(3)
    std = max(1.4826 * float(np.median(size)), _LEAST_STD)
    return (1 - np.minimum(size / (_TUKEY * std), 1) ** 2) ** 2


def _squared(residual: np.ndarray, weights: np.ndarray) -> float:
    return float((weights[:, None] * residual**2).sum())


def _gain(residual: np.ndarray, without: np.ndarray, weights: np.ndarray) -> float:
    """Return the share of the squared residual without a lamp that the lamp explains."""
    return 1 - _squared(residual, weights) / max(_squared(without, weights), 1e-12)


def _speaks_for_lamp(gain: float, gradient: Vector, ambient: float) -> bool:
    """Return whether objects show a lamp: it explains more than harmonics, or these are more directed than a room's."""
    return bool(np.linalg.norm(gradient) > _MOST_DIRECTED * max(ambient, 0.0)) or gain > _LEAST_GAIN


# Cast shadows of known objects, by a shadow map of their surfels (Williams 1978).
#
# A point is lit if nothing nearer to the lamp was drawn at its pixel. The result is interpolated between the four
# pixels around it, so that it changes gradually as the lamp moves. Distant lamps are put at a hundred times the
# objects' extent.


_SIDE = 224  # of the picture that the lamp sees [px]
_FAR = 100.0  # radii of all objects together, at which a distant lamp stands
_SURFELS = 6000  # of an object, about
_HALF_SIDE = 0.75  # of a surfel, in spacings
_LIFT = 1.5  # spacings
_TOLERANCE_M = 1e-3  # by which what hides a point must be nearer
_WIDEST_RAD = 1.2  # half the lamp's field of view


class Shadows:
    """Shadows that objects cast.

    Args:
        surfels: surfels of each object.
        poses: poses of each, in the world.
    """

    def __init__(self, surfels: Sequence[Surfels], poses: Sequence[Pose]) -> None:
        self._casters = [_caster(its, pose) for its, pose in zip(surfels, poses, strict=True)]
        everything = np.concatenate([np.zeros((0, 3), np.float32), *(points for points, _, _ in self._casters)])
        low, high = (everything.min(axis=0), everything.max(axis=0)) if len(everything) else np.zeros((2, 3))
        self.centre: Vector = ((low + high) / 2).astype(float)
        """Centre of all objects [m]."""
        self.radius = float(np.linalg.norm(everything - self.centre, axis=1).max(initial=0.0))
        """Radius of the sphere around it that holds them [m]."""
        self._lift_m = _LIFT * max((spacing for _, _, spacing in self._casters), default=0.0)

    def lifted(self, points: Vectors, normals: Vectors) -> Vectors:
        """Lift points of the objects' own surfaces so that these do not shade themselves [m]."""
        return points + self._lift_m * normals

    def from_direction(self, direction: Vector, points: Vectors) -> PerPixel:
        """Return the shares of a distant lamp's light from a unit direction that reach points [m]."""
        return self.from_place(self.centre + _FAR * max(self.radius, 1e-3) * direction, points)

    def from_place(self, place: Vector, points: Vectors) -> PerPixel:
        """Return the shares of the light of a lamp at a place [m] that reach points [m]."""
        distance = float(np.linalg.norm(self.centre - place))
        if not self._casters or distance < 1e-6:
            return np.ones(len(points))
        half = min(float(np.arcsin(min(1.05 * self.radius / distance, 1.0))), _WIDEST_RAD)
        camera = Camera.look_at("lamp", place, self.centre, size=_SIDE, fov_y_deg=float(np.rad2deg(2 * half)))
        to_lamp = camera.T_world_camera.inverse()
        numbers = *rotation_and_position(to_lamp), lens(camera.intrinsics)
        nearest = np.full((_SIDE, _SIDE), 1e9, np.float32)  # depth of what the lamp sees first [m]
        depth, index = np.empty((_SIDE, _SIDE), np.float32), np.empty((_SIDE, _SIDE), np.int32)
        for surfels, normals, spacing in self._casters:
            draw_surfels(surfels, normals, np.float32(_HALF_SIDE * spacing), *numbers, depth, index)
            np.minimum(nearest, depth, out=nearest)
        return _lit(nearest, to_lamp.apply(points), camera.intrinsics)


def _lit(nearest: Float32[np.ndarray, "side side"], local: Vectors, K: np.ndarray) -> PerPixel:
    """Return the share of the four pixels around each point, in the lamp's frame, that show nothing nearer than it."""
    depth = np.maximum(local[:, 2], 1e-6)
    x, y = (K[axis, axis] * local[:, axis] / depth + K[axis, 2] - 0.5 for axis in range(2))
    seen = (local[:, 2] > 1e-6) & (x > 0) & (y > 0) & (x < _SIDE - 1) & (y < _SIDE - 1)
    x, y = np.where(seen, x, 0), np.where(seen, y, 0)
    column, row = np.minimum(x.astype(np.int64), _SIDE - 2), np.minimum(y.astype(np.int64), _SIDE - 2)
    right, below = x - column, y - row
    lit = np.zeros(len(local))
    flat, first, level = nearest.ravel(), row * _SIDE + column, (depth - _TOLERANCE_M).astype(np.float32)
    shares = (1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below
    for step, share in zip((0, 1, _SIDE, _SIDE + 1), shares, strict=True):
        lit += share * (flat[first + step] >= level)
    return np.where(seen, lit, 1.0)


def _caster(surfels: Surfels, pose: Pose) -> tuple[Float32[np.ndarray, "S 3"], Float32[np.ndarray, "S 3"], float]:
    """Return points and normals in the world of about 6000 surfels, all that shadows need, and their spacing [m]."""
    points, normals = surfels.points, surfels.normals
    coarser = max(np.sqrt(len(points) / _SURFELS), 1.0)
    spacing = float(coarser * surfels.spacing)
    if coarser > 1:
        _, kept = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
        points, normals = points[kept], normals[kept]
    rotation = quaternion_to_matrix(pose.quaternion)
    moved, turned = points @ rotation.T + pose.position, normals @ rotation.T
    return np.ascontiguousarray(moved, np.float32), np.ascontiguousarray(turned, np.float32), spacing


# Pixels whose position and normal are known: on objects, and on the table around them.


TABLE = -1
Sides = tuple[float, float] | None  # along x and y [m]
PixelColumns = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # radiance, albedo, points and normals
_MASK_SIDE, _TABLE_SIDE = 60, 320  # of masks and photographs, as they are looked at [px]
_OBJECT_PIXELS, _TABLE_PIXELS = 600, 1800  # of one object, and of the table, in one photograph
_AROUND_M = 0.4  # of the table, around the objects
_MARGIN, _BESIDE = 3, 41  # masks grow by half of it on each side: what the table loses; where shadows often lie [px]
_SEEN = 0.25  # least cosine of the angle at which a surface is seen


@dataclass(frozen=True, eq=False, slots=True)
class LitPixels:
    """Pixels of one scene.

    Attributes:
        radiance: linear radiance, well exposed.
        albedo: linear albedo; 1 on the table, whose albedo is unknown.
        points: points on the surface [m].
        normals: outward unit normals.
        owner: index of the object; -1 on the table.
        view: index of the photograph. Each view has its own exposure and white balance.
        shadows: shadows that the objects cast.
    """

    radiance: Vectors
    albedo: Vectors
    points: Vectors
    normals: Vectors
    owner: Int[np.ndarray, "P"]
    view: Int[np.ndarray, "P"]
    shadows: Shadows

    def __post_init__(self) -> None:
        """Check the number of pixels.

        Raises:
            InvalidInput: if there are fewer than 50.
        """
        _check_count(self.radiance)

    @property
    def on_table(self) -> Bool[np.ndarray, "P"]:
        """Mark the pixels that show the table."""
        return self.owner == TABLE

    def lifted(self) -> Vectors:
        """Return the points moved off surfaces that could shade themselves [m]."""
        return np.where(self.on_table[:, None], self.points, self.shadows.lifted(self.points, self.normals))

    def about(self, count: int) -> LitPixels:
        """Return about so many of the pixels, evenly chosen."""
        some = slice(None, None, max(len(self.radiance) // count, 1))
        return LitPixels(self.radiance[some], self.albedo[some], self.points[some], self.normals[some],
                         self.owner[some], self.view[some], self.shadows)  # fmt: skip


def _joined(parts: Sequence[tuple[Any, ...]]) -> PixelColumns:
    """Concatenate the first four columns of parts: radiance, albedo, points and normals."""
    radiance, albedo, points, normals = (
        np.concatenate([np.zeros((0, 3)), *(part[k] for part in parts)]) for k in range(4)
    )
    return radiance, albedo, points, normals


def object_pixels(photo: Photograph, found: PhotoObject, surfels: Surfels) -> PixelColumns:
    """Return radiance, albedo, points in the world [m] and normals of well exposed pixels that show an object.

    Args:
        photo: with a mask of the object.
        found: the object and its pose in the world.
        surfels: surfels of the object.
    """
    window, pose = object_windows([photo], found.name, _MASK_SIDE)[0], found.best.pose
    index, _ = draw(surfels, window, pose[None])
    shown = (index[0] >= 0) & window.plain
    seen = index[0][shown]
    normals, points = rotate(pose.quaternion, surfels.normals[seen]), pose.apply(surfels.points[seen])
    return window.image[shown], surfels.albedo[seen], points, normals


def _facing_pixels(photo: Photograph, found: PhotoObject, surfels: Surfels) -> PixelColumns:
    """Return some of `object_pixels`, none of which is seen at a grazing angle."""
    try:
        columns = object_pixels(photo, found, surfels)
    except InvalidInput:  # a tiny mask in one of several views
        none = np.zeros((0, 3))
        return none, none, none, none
    to_camera = photo.T_world_camera.position - columns[2]
    cosine = np.sum(columns[3] * to_camera, axis=1) / np.linalg.norm(to_camera, axis=1)
    kept = np.flatnonzero(cosine > _SEEN)
    kept = kept[:: max(-(-len(kept) // _OBJECT_PIXELS), 1)]
    radiance, albedo, points, normals = (column[kept] for column in columns)
    return radiance, albedo, points, normals


def _table_pixels(photo: Photograph, centre: np.ndarray, covered_m: Sides) -> PixelColumns:
    """Return radiance, ones, points [m] and normals of well exposed pixels of the table near the objects."""
    objects = np.any([np.zeros((photo.height, photo.width), bool), *photo.masks.values()], axis=0).astype(np.float32)
    photo = photo.with_masks({}).resized(_TABLE_SIDE)
    whole = cv2.resize(objects, (photo.width, photo.height), interpolation=cv2.INTER_AREA)
    some = (whole > 0).astype(np.uint8)
    covered, beside = (cv2.dilate(some, np.ones((k, k), np.uint8)) > 0 for k in (_MARGIN, _BESIDE))
    rows, columns = np.nonzero(photo.well_exposed & ~covered)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    matrix = quaternion_to_matrix(photo.T_world_camera.quaternion) @ np.linalg.inv(photo.intrinsics)
    rays, origin = pixels @ matrix.T, photo.T_world_camera.position
    down = rays[:, 2] < -1e-6
    points = origin - rays * (origin[2] / np.where(down, rays[:, 2], 1.0))[:, None]
    near = down & (np.linalg.norm(points[:, :2] - centre[:2], axis=1) < _AROUND_M)
    if covered_m is not None:
        near &= np.any(np.abs(points[:, :2]) > np.array(covered_m) / 2, axis=1)
    groups = [np.flatnonzero(near & (beside[rows, columns] == flag)) for flag in (True, False)]
    kept = np.concatenate([group[:: max(-(-2 * len(group) // _TABLE_PIXELS), 1)] for group in groups])
    normals = np.tile([0.0, 0.0, 1.0], (len(kept), 1))
    flat = points[kept] * (1.0, 1.0, 0.0)
    return photo.image[rows[kept], columns[kept]], np.ones((len(kept), 3)), flat, normals


# A lamp by few numbers, and the share of its light that falls on each pixel: n . l, visibility, falloff and cone.
#
# The lamp stands at centre + direction / q: q = 1 / distance is searched rather than the distance, since it is
# bounded, and small for a distant lamp. The direction is a step in the tangent plane of a base direction. The cone
# looks at a point of the plane z = centre_z; its size is the radius rho of the pool of light around that point,
# which says less of the distance than an angle would.


STEPS = np.array([0.012, 0.012, 0.05, 0.01, 0.01, 0.03, 0.03])
"""Steps of the numbers x of `LampShape.moved`, at which the light changes noticeably, but still linearly."""
PLACE_NUMBERS = 3  # of those, that say where the lamp is
NEAREST_M, FARTHEST_M = 0.2, 25.0
_SHARES = 0.2, 0.98  # inner over outer half-angle
_RADII_M = 0.03, 3.0
_LEAST_HEIGHT = 0.08  # of the direction above the table


@dataclass(frozen=True, eq=False, slots=True)
class LampShape:
    """A lamp.

    Attributes:
        centre: from which its direction and distance are counted [m].
        direction: unit vector from there toward the lamp.
        inverse: inverse of the distance [1/m].
        aim: x and y of the point that it looks at, from the centre [m].
        radius: radius of the pool of light around that point, where it ends [m]; None without a cone.
        inner_share: the inner half-angle of the cone over the outer one.
    """

    centre: Vector
    direction: Vector
    inverse: float
    aim: Float[np.ndarray, "2"]
    radius: float | None = None
    inner_share: float = 0.7

    @property
    def place(self) -> Vector:
        """Position of the lamp [m]."""
        return self.centre + self.direction / self.inverse

    @property
    def aim_point(self) -> Vector:
        """Point that it looks at [m]."""
        return self.centre + np.array([*self.aim, 0.0])

    @property
    def cone_rad(self) -> tuple[float, float] | None:
        """Inner and outer half-angle; None without a cone."""
        if self.radius is None:
            return None
        outer = float(np.arctan2(self.radius, np.linalg.norm(self.place - self.aim_point)))
        return self.inner_share * outer, outer

    @property
    def count(self) -> int:
        """Number of its parameters."""
        return PLACE_NUMBERS if self.radius is None else len(STEPS)

    def moved(self, x: Float[np.ndarray, "count"], *, above_table: bool) -> LampShape:
        """Return another lamp nearby.

        Args:
            x: two steps of the direction [rad], of the inverse distance [1/m], of the aim [m], of the radius's
                logarithm and of the inner share; the first three alone without a cone.
            above_table: keep it above the plane.
        """
        right, up = orthogonal_basis(self.direction)
        direction = self.direction + x[0] * right + x[1] * up
        direction /= np.linalg.norm(direction)
        if above_table and direction[2] < _LEAST_HEIGHT:
            flat = direction[:2] / max(float(np.linalg.norm(direction[:2])), 1e-9)
            direction = np.array([*flat * np.sqrt(1 - _LEAST_HEIGHT**2), _LEAST_HEIGHT])
        inverse = float(np.clip(self.inverse + x[2], 1 / FARTHEST_M, 1 / NEAREST_M))
        if self.radius is None:
            return replace(self, direction=direction, inverse=inverse)
        radius = float(np.clip(self.radius * np.exp(np.clip(x[5], -1, 1)), *_RADII_M))
        share = float(np.clip(self.inner_share + x[6], *_SHARES))
        return LampShape(self.centre, direction, inverse, self.aim + x[3:5], radius, share)

    def unshaded(self, pixels: LitPixels) -> PerPixel:
        """Return the share of light on each pixel without shadows; 1 on one at the centre that faces the lamp."""
        way = self.place - pixels.points
        squared = np.einsum("ij,ij->i", way, way)
        along = np.einsum("ij,ij->i", way, pixels.normals)
        share = np.maximum(along, 0) / np.sqrt(squared) / (squared * self.inverse**2)
        cone = self.cone_rad
        if cone is None:
            return share
        axis = self.aim_point - self.place
        cosine = -(way @ axis) / (np.sqrt(squared) * np.linalg.norm(axis))
        s = np.clip((cone[1] - np.arccos(np.clip(cosine, -1, 1))) / (cone[1] - cone[0]), 0, 1)
        return share * s**2 * (3 - 2 * s)


# The linear part of the light: by weighted least squares for each colour and view, given the lamp's share of light.
#
# With s the lamp's share on each pixel, n . l times visibility, falloff and cone, and b small (a ridge),
#
#     objects: I = albedo * (a + b . n + k * s),      table: I = A + K * s with A, K >= 0,
#
# since the table's albedo is unknown. k is not negative either: no lamp takes light away. Without a lamp, light on
# the table may vary smoothly, as a quadratic of the place: shadows and cones speak for lamps, vignetting does not.


_TINY = 1e-9
_TABLE_SCALE_M = 0.4
_LEAST_SHARE = 0.05  # of the median radiance


@dataclass(frozen=True, eq=False, slots=True)
class Gains:
    """Light of one scene.

    Attributes:
        residual: radiance minus the part that the light explains.
        lamp: k of each view and colour; NaN if no object is visible.
        ambient: a, of each view and colour.
        gradient: b, mean over views and colours.
    """

    residual: Vectors
    lamp: Float[np.ndarray, "views 3"]
    ambient: Float[np.ndarray, "views 3"]
    gradient: Vector


def smooth_light(points: Vectors, radiance: Colours, weights: PerPixel, visible: PerPixel | None = None) -> Colours:
    """Fit the table's radiance by a quadratic of x and y; with visibility, by a constant and a quadratic times it."""
    x, y = ((points[:, :2] - points[:, :2].mean(axis=0)) / _TABLE_SCALE_M).T
    basis = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    if visible is not None:
        basis = np.column_stack([np.ones_like(x), basis * visible[:, None]])
    weighted = basis * weights[:, None]
    normal = weighted.T @ basis
    normal[np.diag_indices(len(normal))] += _TINY + 1e-6 * normal[0, 0]
    return basis @ np.linalg.solve(normal, weighted.T @ radiance)


def _table_light(share: PerPixel, radiance: Colours, weights: PerPixel) -> Colours:
    """Fit radiance by A + K s, neither negative."""
    total = max(float(weights.sum()), _TINY)
    mean = weights @ radiance / total
    middle = float(weights @ share) / total
    centred = share - middle
    slope = np.maximum((weights * centred) @ radiance / max(float((weights * centred) @ centred), _TINY), 0)
    base = mean - slope * middle
    through_zero = (weights * share) @ radiance / max(float((weights * share) @ share), _TINY)
    slope, base = np.where(base < 0, through_zero, slope), np.maximum(base, 0)
    return base + share[:, None] * slope


def _ridge(basis: Columns, albedo: PerPixel, target: PerPixel, weights: PerPixel, ridge: float) -> Light:
    weighted = basis * (weights * albedo)[:, None]
    normal = weighted.T @ (basis * albedo[:, None])
    scale = max(float(normal[0, 0]), _TINY)
    normal[np.diag_indices(len(normal))] += _TINY * scale
    normal[[1, 2, 3], [1, 2, 3]] += ridge * scale
    return np.linalg.solve(normal, weighted.T @ target)


# Search for the lamp: costs of lamps on some pixels, comparison of all directions, refinement of one lamp.


_SEARCH_DIRECTIONS = 260  # on the sphere
_SEARCH_LEAST_HEIGHT = 0.1  # of those above a table
_SEARCH_INVERSES = 0.4, 1.4  # of the distances that they are compared at [1/m]
_RING, _RINGS_RAD = 6, (0.06, 0.12)  # directions near the best of them
_FINE_INVERSES = 0.1, 0.7, 1.3, 2.1
_EVALUATIONS = 6  # of one refinement


class LampSearch:
    """Costs of lamps on the pixels of one scene.

    Args:
        pixels: pixels of the scene.
    """

    def __init__(self, pixels: LitPixels) -> None:
        self.pixels = pixels
        self._table, self._lifted = pixels.on_table, pixels.lifted()
        self._parts = [part for part in (self._table, ~self._table) if part.any()]
        self.is_on_table = bool(self._table.any())
        """Whether the plane z = 0 is seen, so that the lamp is above it."""
        views = range(int(pixels.view.max()) + 1)
        chosen = [[np.flatnonzero(part & (pixels.view == v)) for v in views] for part in (~self._table, self._table)]
        self._objects_by_view, self._table_by_view = chosen

    def visible(self, lamp: LampShape) -> PerPixel:
        """Return the share of the lamp that each pixel sees."""
        return self.pixels.shadows.from_place(lamp.place, self._lifted)

    def gains(self, lamp: LampShape | None, weights: PerPixel, visible: PerPixel | None = None) -> Gains:
        """Fit the light under a lamp, or without one; `visible` if that is known already."""
        share = None
        if lamp is not None:
            share = lamp.unshaded(self.pixels) * (self.visible(lamp) if visible is None else visible)
        radiance = self.pixels.radiance
        residual = np.empty_like(radiance)
        fitted, ambient = np.full((2, len(self._objects_by_view), 3), np.nan)
        gradients = []
        for view, chosen in enumerate(self._objects_by_view):
            if len(chosen):
                light = self._on_objects(chosen, None if share is None else share[chosen], weights[chosen], residual)
                ambient[view], fitted[view] = light[:, 0], light[:, 4] if share is not None else 0.0
                gradients.append(light[:, 1:4].mean(axis=0))
        for chosen in filter(len, self._table_by_view):
            if share is None:
                lit = smooth_light(self.pixels.points[chosen], radiance[chosen], weights[chosen])
            else:
                lit = _table_light(share[chosen], radiance[chosen], weights[chosen])
            residual[chosen] = radiance[chosen] - lit
        return Gains(residual, fitted, ambient, np.mean(gradients or [np.zeros(3)], axis=0))

    def _on_objects(
        self, chosen: np.ndarray, share: PerPixel | None, weights: PerPixel, residual: np.ndarray
    ) -> Lights:
        """Fit the light of objects in one view; write the residual."""
        plain = np.column_stack([np.ones(len(chosen)), self.pixels.normals[chosen]])
        lit = plain if share is None else np.column_stack([plain, share])
        light = np.zeros((3, lit.shape[1]))
        for c in range(3):
            albedo, target = self.pixels.albedo[chosen, c], self.pixels.radiance[chosen, c]
            found = _ridge(lit, albedo, target, weights, 0.0 if share is None else _RIDGE)
            if share is not None and found[4] < 0:
                found = np.append(_ridge(plain, albedo, target, weights, 0.0), 0.0)
            light[c] = found
            residual[chosen, c] = target - albedo * (lit @ found)
        return light

    def cost(self, residual: Colours) -> float:
        """Return the logarithms of the mean absolute residual of objects and table, weighted by their pixels."""
        size = np.abs(residual).mean(axis=1)
        return sum(float(part.mean() * np.log(size[part].mean() + 1e-6)) for part in self._parts)

    def weights(self, residual: Vectors) -> PerPixel:
        """Return weights as of absolute errors, by which misplaced shadows still count, over variances.

        The usual error, of objects and of the table apart, is at least a share of the radiance: on a plain table a
        shadow is no outlier by its contrast alone.
        """
        size, usual = np.sqrt((residual**2).mean(axis=1)), np.empty(len(residual))
        for part in self._parts:
            least = _LEAST_SHARE * float(np.median(self.pixels.radiance[part].mean(axis=1)))
            usual[part] = max(1.4826 * float(np.median(size[part])), least, _LEAST_STD)
        return 1 / np.sqrt(1 + (size / usual) ** 2) / usual**2

    def by_direction(self, centre: Vector) -> list[LampShape]:
        """Return lamps without a cone in all directions from a centre [m], the best first; see `ranked`."""
        directions = fibonacci_sphere(_SEARCH_DIRECTIONS)
        if self.is_on_table:
            directions = directions[directions[:, 2] > _SEARCH_LEAST_HEIGHT]
        return self.ranked([LampShape(centre, d, q, np.zeros(2)) for d in directions for q in _SEARCH_INVERSES])

    def around(self, lamps: Sequence[LampShape]) -> list[LampShape]:
        """Return lamps without a cone near some, at several distances, the best first; see `ranked`."""
        angles = np.linspace(0, 2 * np.pi, _RING, endpoint=False)
        steps = [(0.0, 0.0), *((r * np.cos(a), r * np.sin(a)) for r in _RINGS_RAD for a in angles)]
        near = [lamp.moved(np.array([*step, 0.0]), above_table=self.is_on_table) for lamp in lamps for step in steps]
        return self.ranked([replace(lamp, inverse=q) for lamp in near for q in _FINE_INVERSES])

    def ranked(self, lamps: Sequence[LampShape]) -> list[LampShape]:
        """Sort lamps, the best first; the table's brightness may vary smoothly: shadows count and no cone matters."""
        grey, albedo = self.pixels.radiance.mean(axis=1), self.pixels.albedo.mean(axis=1)
        for chosen in filter(len, [*self._objects_by_view, *self._table_by_view]):  # views then have about one exposure
            grey[chosen] /= max(float(np.median(grey[chosen] / np.maximum(albedo[chosen], 1e-3))), 1e-6)
        costs = [self.cost(self._left_over(lamp, grey[:, None], albedo)) for lamp in lamps]
        return [lamps[k] for k in np.argsort(costs, kind="stable")]

    def refine(self, lamp: LampShape, weights: PerPixel, scale: float = 1.0) -> tuple[LampShape, Vectors, Jacobian]:
        """Refine a lamp by Levenberg and Marquardt's method, with central differences over `STEPS` times a scale.

        Returns:
            The lamp with the least weighted residual nearby, that residual, and its derivatives by the lamp's numbers
            in steps.
        """
        steps, root = scale * STEPS[: lamp.count], np.sqrt(weights)[:, None]

        def cost(x: np.ndarray) -> np.ndarray:
            moved = lamp.moved(x * steps, above_table=self.is_on_table)
            return (root * self.gains(moved, weights).residual).ravel()

        def jacobian(x: np.ndarray) -> np.ndarray:
            return np.stack([(cost(x + e) - cost(x - e)) / 2 for e in np.eye(len(x))], axis=1)

        start = np.zeros(lamp.count)
        found = least_squares(cost, start, jacobian, method="lm", max_nfev=_EVALUATIONS)  # pyright: ignore[reportArgumentType]
        moved = lamp.moved(found.x * steps, above_table=self.is_on_table)
        return moved, found.fun.reshape(-1, 3), found.jac.reshape(-1, 3, lamp.count) / scale

    def _left_over(self, lamp: LampShape, grey: Float[np.ndarray, "P 1"], albedo: PerPixel) -> Float[np.ndarray, "P 1"]:
        """Return what a lamp does not explain of such radiance."""
        visible, objects = self.visible(lamp), ~self._table
        left = np.zeros_like(grey)
        if objects.any():
            share = (lamp.unshaded(self.pixels) * visible)[objects]
            plain = np.column_stack([np.ones(len(share)), self.pixels.normals[objects], share])
            basis = plain * albedo[objects, None]
            normal = basis.T @ basis + 1e-6 * np.eye(5)
            normal[[1, 2, 3], [1, 2, 3]] += _RIDGE * normal[0, 0]
            light = np.linalg.solve(normal, basis.T @ grey[objects])
            light[4] = np.maximum(light[4], 0)
            left[objects] = grey[objects] - basis @ light
        if self.is_on_table:
            of_table, lit = self.pixels.points[self._table], visible[self._table]
            one = np.ones(len(lit))
            left[self._table] = grey[self._table] - smooth_light(of_table, grey[self._table], one, lit)
        return left


def apart(lamps: Sequence[LampShape], count: int, angle_rad: float) -> list[LampShape]:
    """Return the first so many lamps, none within an angle of another."""
    kept: list[LampShape] = []
    for lamp in lamps:
        if len(kept) < count and all(lamp.direction @ other.direction < np.cos(angle_rad) for other in kept):
            kept.append(lamp)
    return kept


# A lamp at a finite distance, from photographs of known objects and of the table around them.
#
# Its share of light on each pixel (`LampShape`) is searched, everything else about the light is linear
# (`Gains`). Directions are compared first, by the shadows that they cast and by shading, with a table whose
# brightness may vary smoothly as it likes; then distances and cones, for the best of them; Levenberg-Marquardt
# refines what fits best, with weights as of absolute errors. Deviations come from the curvature of the residuals,
# those of one patch of a surface taken as one observation, since errors of albedo and normals are alike within a
# patch; and from what poses add.


_COARSE_PIXELS, _MIDDLE_PIXELS, _FINE_PIXELS = 3000, 4000, 5000
_STARTS, _APART_RAD = 3, 0.15
_INVERSES = 0.2, 0.7, 1.2, 2.0  # of distances to start from [1/m]
_START_RADII_M = None, 0.15, 0.25, 0.4, 0.6  # of the pool of light to start from
_REFINED = 2  # of all starts; and the best without a cone
_SCALES = 4.0, 2.0, 1.0  # of steps: shadows' edges are seen from farther with long ones
_NEAR_ROUNDS = 2  # of reweighting
_PATCH_M = 0.03
_PRIOR_STD = np.array([1e3, 1e3, 1e3, 0.3, 0.3, 1.0, 0.3])  # of what is searched, in its units: of the cone only
_POSE_STD_RAD, _POSE_STD_PER_M = 0.02, 0.09  # what errors of poses, albedo and table add, as simulated scenes showed
_MOST_LOG_STD = 0.25  # of a distance that is known
_LEAST_TABLE_GAIN = 0.12  # 0.3 and more in simulated scenes under a lamp, at most 0.1 in most photographs of rooms
_WIDE_DEG = 85.0  # half-angle of a cone whose border no photograph shows


@dataclass(frozen=True, eq=False, slots=True)
class NearLampFit:
    """The lamp of one scene.

    Attributes:
        shape: position and aim of the lamp.
        std: standard deviation of its direction, per axis [rad].
        log_distance_std: standard deviation of the logarithm of its distance.
        strength: its light on a surface at the centre that faces it, per view and colour, where the radiance of white
            is 1: relative to the exposure, which is unknown. NaN where no object is seen.
        gain: share of the squared residual without a lamp that it explains.
        is_diffuse: whether there is no single lamp, so that the rest is unreliable.
    """

    shape: LampShape
    std: float
    log_distance_std: float
    strength: Float[np.ndarray, "views 3"]
    gain: float
    is_diffuse: bool

    @property
    def direction(self) -> Vector:
        """Unit vector from the centre toward the lamp."""
        return self.shape.direction

    @property
    def distance(self) -> float:
        """Distance from the centre [m]; unreliable unless `distance_known`."""
        return 1 / self.shape.inverse

    @property
    def distance_known(self) -> bool:
        """Whether the photographs determine the distance."""
        return not self.is_diffuse and self.log_distance_std < _MOST_LOG_STD

    @property
    def lamp(self) -> SpotLamp | None:
        """Return the lamp for renderers; None if its distance is not known, or it is too near or too low.

        If the photographs show no cone, it has a wide one.
        """
        place, cone = self.shape.place, self.shape.cone_rad
        distance = float(np.linalg.norm(place))
        is_low = place[2] < distance * np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))
        if not self.distance_known or distance < MIN_LAMP_DISTANCE_M or is_low:
            return None
        inner, outer = (_WIDE_DEG, _WIDE_DEG) if cone is None else np.rad2deg(cone)
        return SpotLamp(place, self.shape.aim_point, float(inner), float(outer))


def fit_near_lamp(pixels: LitPixels, centre: Vector) -> NearLampFit:
    """Estimate the direction and the distance of the lamp.

    Args:
        pixels: pixels of all photographs of one scene.
        centre: point from which direction and distance are measured [m], such as the table's centre.
    """
    start = _start(pixels, centre)
    search = LampSearch(pixels.about(_FINE_PIXELS))
    weights = np.ones(len(search.pixels.radiance))
    weights = search.weights(search.gains(start, weights).residual)
    lamp, residual, jacobian = search.refine(start, weights)
    for _ in range(_NEAR_ROUNDS):
        weights = search.weights(search.gains(lamp, weights).residual)
        lamp, residual, jacobian = search.refine(lamp, weights)
    covariance = _covariance(residual, jacobian, search.pixels)
    std = float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2 + _POSE_STD_RAD**2))
    log_std = float(np.sqrt(covariance[2, 2] + _POSE_STD_PER_M**2)) / lamp.inverse
    under, without = search.gains(lamp, weights), search.gains(None, weights)
    gain = _gain(under.residual, without.residual, weights)
    if search.is_on_table:  # nothing else explains shadows on a table
        is_lit = gain > _LEAST_TABLE_GAIN
    else:
        is_lit = _speaks_for_lamp(gain, without.gradient, float(np.nanmean(without.ambient)))
    is_diffuse = not (is_lit and np.nanmax(under.lamp, initial=0.0) > 0)
    return NearLampFit(lamp, std, log_std, under.lamp, gain, is_diffuse)


def _start(pixels: LitPixels, centre: Vector) -> LampShape:
    """Find the best lamp on few pixels."""
    coarse = LampSearch(pixels.about(_COARSE_PIXELS))
    directions = coarse.around(apart(coarse.by_direction(centre), _STARTS, _APART_RAD))
    search = LampSearch(pixels.about(_MIDDLE_PIXELS))
    flat = search.weights(search.gains(None, np.ones(len(search.pixels.radiance))).residual)
    starts = _with_cones(search, apart(directions, _STARTS, _APART_RAD), flat)
    tried = [*starts[:_REFINED], next(lamp for lamp in starts if lamp.radius is None)]
    ends, costs = [], []
    for first in tried:
        lamp, weights = first, flat
        for scale in _SCALES:
            weights = search.weights(search.gains(lamp, weights).residual)
            lamp, _, _ = search.refine(lamp, weights, scale)
        ends.append(lamp)
        costs.append(search.cost(search.gains(lamp, weights).residual))
    return ends[int(np.argmin(costs))]


def _with_cones(search: LampSearch, lamps: Sequence[LampShape], weights: np.ndarray) -> list[LampShape]:
    """Return lamps at several distances and with several cones, the best first."""
    costs, tried = [], []
    for lamp in (replace(lamp, inverse=inverse) for lamp in lamps for inverse in _INVERSES):
        visible = search.visible(lamp)
        for radius in _START_RADII_M if search.is_on_table else (None,):
            tried.append(replace(lamp, radius=radius))
            costs.append(search.cost(search.gains(tried[-1], weights, visible).residual))
    return [tried[k] for k in np.argsort(costs, kind="stable")]


def _covariance(residual: Vectors, jacobian: Jacobian, pixels: LitPixels) -> Float[np.ndarray, "count count"]:
    """Return the covariance of the lamp's parameters: H^-1 (sum of g g^T over patches) H^-1, g a patch's gradient."""
    count = jacobian.shape[2]
    curvature = np.einsum("pci,pcj->ij", jacobian, jacobian)
    curvature += np.diag((STEPS[:count] / _PRIOR_STD[:count]) ** 2)
    gradients = np.einsum("pci,pc->pi", jacobian, residual)
    cells = np.column_stack([np.floor(pixels.points / _PATCH_M).astype(np.int64), pixels.owner])
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    sums = np.stack([np.bincount(patch.reshape(-1), column) for column in gradients.T], axis=1)
    inverse = np.linalg.pinv(curvature)
    return inverse @ (sums.T @ sums) @ inverse * np.outer(STEPS[:count], STEPS[:count])


# The light of photographs whose objects are known: surfels give normals and albedo of the pixels that show them.


def photo_light(photo: Photograph, objects: Sequence[PhotoObject], surfels: Sequence[Surfels]) -> LampFit:
    """Estimate the direction toward a distant lamp in the world, from the objects' shading and their shadows.

    Args:
        photo: photo with masks of the objects.
        objects: the objects that were found in it.
        surfels: surfels of each object.

    Raises:
        InvalidInput: if too few pixels show objects that are trusted.
    """
    pairs = zip(objects, surfels, strict=True)
    seen = [object_pixels(photo, found, its) for found, its in pairs if found.name in photo.masks]
    radiance, albedo, points, normals = _joined(seen)
    shadows = Shadows(surfels, [found.best.pose for found in objects])
    lifted = shadows.lifted(points, normals)
    return fit_lamp(
        ShadedPixels(radiance, albedo, normals), lambda direction: shadows.from_direction(direction, lifted)
    )


def photo_lamp(
    photos: Sequence[Photograph], objects: Sequence[PhotoObject], surfels: Sequence[Surfels], *, covered_m: Sides = None
) -> NearLampFit:
    """Estimate the lamp with its distance, from the objects, their shadows, and the table if it is known.

    Direction and distance are measured from the world's origin on a known table, else from the objects' centre.

    Args:
        photos: photos of one scene, with masks of the objects.
        objects: the objects that were found in them.
        surfels: surfels of each object.
        covered_m: sides along x and y of a printed board around the world's origin, which hides the table [m].

    Raises:
        InvalidInput: if too few pixels show anything known.
    """
    shadows, parts = Shadows(surfels, [found.best.pose for found in objects]), []
    for view, photo in enumerate(photos):
        for owner, (found, its) in enumerate(zip(objects, surfels, strict=True)):
            if found.name in photo.masks:
                parts.append((*_facing_pixels(photo, found, its), owner, view))
        if photo.on_table:
            parts.append((*_table_pixels(photo, shadows.centre, covered_m), TABLE, view))
    owner, view = (np.repeat([p[k] for p in parts], [len(p[0]) for p in parts]).astype(int) for k in (4, 5))
    pixels = LitPixels(*_joined(parts), owner, view, shadows)
    return fit_near_lamp(pixels, np.zeros(3) if all(p.on_table for p in photos) else shadows.centre)
