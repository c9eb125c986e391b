"""Pictures of a tabletop by ray tracing: anti-aliased, textured, with exact shadows of a parallel light.

This is the image model of object image sets, scenes and goals alike. Pixels that an object may cover, and those where a
shadow or the table's edge crosses, take a grid of samples each; the open table is known in closed form. Depth and
coverage come with the picture for tests and evaluation; observations leave them out.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging.optics import BACKGROUND_RADIANCE, TABLE_ALBEDO, Lamp, lambert
from osfcore.world.imaging.traced_mesh import NO_HIT, TracedMesh, into_frame
from osfcore.world.pusher_body import pusher_mesh

DEFAULT_SAMPLES = 3  # samples along each side of a pixel, in images of 96 pixels and more
_SMALL_SIDE = 96  # below, bodies may be thinner than a pixel: corners miss them and three samples are too few
_BIAS_M = np.float32(5e-4)  # shadow rays start this far above curved facets, which smooth normals make look round
_CHUNK = 1 << 17  # samples traced at once, to bound memory at large image sizes


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """One traced view.

    Attributes:
        rgb: mean radiance of each pixel, linear; black around an object traced alone.
        coverage: visible share of each pixel per body, objects in the state's order, then the pusher if there is one.
        depth: mean distance along the camera's z axis over what was hit [m]; infinite where nothing was.
    """

    rgb: Float[np.ndarray, "h w 3"]
    coverage: Float[np.ndarray, "N h w"]
    depth: Float[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False, slots=True)
class _Body:
    """A mesh at its place in one scene."""

    mesh: TracedMesh
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class _Shot:
    """One view to trace: who, from where, under which light."""

    bodies: tuple[_Body, ...]
    light: Float[np.ndarray, "3"]
    camera: Camera
    lamp: Lamp
    has_table: bool
    samples: int
    sharp: bool

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """Centre of projection [m], float32."""
        return self.camera.T_world_camera.position.astype(np.float32)


class RayTracer:
    """Traces views of scenes made of known meshes.

    Args:
        meshes: the objects that scenes may name.
        lamp: strengths of ambient and diffuse light.
        executor: traces the views of one call side by side, if given (threads serve: Embree releases the GIL).
    """

    def __init__(
        self, meshes: Mapping[str, TracedMesh], *, lamp: Lamp | None = None, executor: Executor | None = None
    ) -> None:
        self._meshes = dict(meshes)
        self._pusher = TracedMesh(pusher_mesh())
        self._lamp = lamp or Lamp()
        self._executor = executor

    def render(
        self, state: SceneState, cameras: tuple[Camera, ...], *, samples: int | None = None, sharp: bool = False
    ) -> tuple[Picture, ...]:
        """Trace the state from each camera.

        Args:
            state: objects, light and pusher (drawn if it is not None).
            cameras: the views.
            samples: samples along each side of a pixel; by default 3, and more in small images.
            sharp: take textures at their finest level and sample every pixel alike: slow, the yardstick of tests.

        Raises:
            KeyError: if the state names an object without mesh.
        """
        bodies = [_Body(self._meshes[name], state.poses[i]) for i, name in enumerate(state.names)]
        if state.pusher is not None:
            bodies.append(_Body(self._pusher, Pose(state.pusher, Pose.identity().quaternion)))
        light = state.light.direction.astype(np.float32)
        shots = [_Shot(tuple(bodies), light, c, self._lamp, True, samples or _samples_for(c), sharp) for c in cameras]
        mapped = map(_trace, shots) if self._executor is None else self._executor.map(_trace, shots)
        return tuple(mapped)

    def render_alone(
        self, name: str, light_direction: Float[np.ndarray, "3"], camera: Camera, *, samples: int = DEFAULT_SAMPLES
    ) -> Picture:
        """Trace one object at the origin, floating in black nothing, lit from any direction, from below as well.

        Args:
            name: which object.
            light_direction: unit vector toward the light, in the object's frame.
            camera: a view, in the object's frame.
            samples: samples along each side of a pixel.
        """
        bodies = (_Body(self._meshes[name], Pose.identity()),)
        light = np.asarray(light_direction, np.float32)
        return _trace(_Shot(bodies, light, camera, self._lamp, False, samples, False))


def _samples_for(camera: Camera) -> int:
    side = min(camera.width, camera.height)
    if side >= _SMALL_SIDE:
        return DEFAULT_SAMPLES
    return 4 if side >= 48 else 6 if side >= 24 else 8


def masks_of(picture: Picture, count: int) -> Bool[np.ndarray, "N h w"]:
    """Binary masks of the first `count` bodies: a pixel belongs to what covers most of it, if that is half or more."""
    coverage = picture.coverage[:count]
    if count == 0:
        return np.zeros(coverage.shape, bool)
    winner = np.arange(count)[:, None, None] == coverage.argmax(axis=0)
    return winner & (coverage >= 0.5)


def _trace(shot: _Shot) -> Picture:
    """One view: closed-form table first, then grids of samples where something happens."""
    height, width = shot.camera.height, shot.camera.width
    near_body = np.ones((height, width), bool) if shot.sharp else _near_bodies(shot)
    rgb = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    coverage = np.zeros((len(shot.bodies), height, width), np.float32)
    if shot.has_table:
        busy = _open_table(shot, near_body, rgb, depth)
        _sampled(shot, busy & ~near_body, (), rgb, depth, coverage)
    _sampled(shot, near_body, tuple(range(len(shot.bodies))), rgb, depth, coverage)
    return Picture(rgb, coverage, depth)


def _near_bodies(shot: _Shot) -> Bool[np.ndarray, "h w"]:
    """Pixels that a body may cover: those with a corner on one, and their neighbours."""
    height, width = shot.camera.height, shot.camera.width
    on_body = np.zeros((height + 1, width + 1), bool)
    for body in shot.bodies:
        box = _screen_box(body, shot.camera)
        if box is not None:
            left, top, right, bottom = box
            if min(height, width) < _SMALL_SIDE:
                on_body[top : bottom + 1, left : right + 1] = True
                continue
            y, x = np.mgrid[top : bottom + 1, left : right + 1]
            directions = _directions(shot, np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32))
            origins = np.broadcast_to(shot.origin, directions.shape)
            hit = body.mesh.occludes(*into_frame(body.pose, origins, directions))
            on_body[top : bottom + 1, left : right + 1] |= hit.reshape(x.shape)
    pixels = on_body[:-1, :-1] | on_body[:-1, 1:] | on_body[1:, :-1] | on_body[1:, 1:]
    return cv2.dilate(pixels.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _screen_box(body: _Body, camera: Camera) -> tuple[int, int, int, int] | None:
    T_camera_object = camera.T_world_camera.inverse() @ body.pose
    return body.mesh.screen_box(T_camera_object, camera.intrinsics, camera.width, camera.height)


def _open_table(shot: _Shot, near_body: np.ndarray, rgb: np.ndarray, depth: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Fill pixels without body from their four corners; return those whose corners disagree."""
    height, width = near_body.shape
    y, x = np.mgrid[: height + 1, : width + 1]
    directions = _directions(shot, np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32))
    kind, colour, distance = _table(shot, directions)
    kind = kind.reshape(height + 1, width + 1)
    corners = np.stack([kind[:-1, :-1], kind[:-1, 1:], kind[1:, :-1], kind[1:, 1:]])
    busy = (corners[1] != corners[0]) | (corners[2] != corners[0]) | (corners[3] != corners[0])
    rgb[:] = colour.reshape(height + 1, width + 1, 3)[:-1, :-1]
    distance = distance.reshape(height + 1, width + 1)
    depth[:] = (distance[:-1, :-1] + distance[:-1, 1:] + distance[1:, :-1] + distance[1:, 1:]) / 4
    return busy


def _sampled(
    shot: _Shot,
    pixels: Bool[np.ndarray, "h w"],
    visible: tuple[int, ...],
    rgb: np.ndarray,
    depth: np.ndarray,
    coverage: np.ndarray,
) -> None:
    """Fill the chosen pixels with the mean of a grid of samples; `visible` are the bodies they may show."""
    rows, columns = np.nonzero(pixels)
    side = shot.samples
    offsets = (np.arange(side) + 0.5) / side
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    per_chunk = max(_CHUNK // side**2, 1)
    for start in range(0, len(rows), per_chunk):
        r, c = rows[start : start + per_chunk], columns[start : start + per_chunk]
        points = (np.stack([c, r], axis=-1)[:, None] + grid).reshape(-1, 2).astype(np.float32)
        colour, z, owner = _shade(shot, points, visible)
        rgb[r, c] = _pixel_means(colour, len(r))
        hit = np.isfinite(z)
        share = _pixel_means(hit[:, None].astype(np.float32), len(r))[:, 0]
        total = _pixel_means(np.where(hit, z, 0)[:, None], len(r))[:, 0]
        depth[r, c] = np.where(share > 0, total / np.maximum(share, 1e-6), np.inf)
        owned = owner[:, None] == np.array(visible)
        coverage[visible, r[:, None], c[:, None]] = _pixel_means(owned.astype(np.float32), len(r))


def _pixel_means(samples: Float[np.ndarray, "S C"], pixels: int) -> Float[np.ndarray, "P C"]:
    """Means over each pixel's samples, as a matrix product: numpy reduces short axes slowly."""
    channels = samples.shape[1]
    per_pixel = len(samples) // pixels
    average = np.tile(np.eye(channels, dtype=np.float32), (per_pixel, 1)) / np.float32(per_pixel)
    return samples.reshape(pixels, per_pixel * channels) @ average


def _directions(shot: _Shot, points: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
    """World directions through pixel coordinates, scaled so that the ray parameter is the depth along z."""
    inverse = np.linalg.inv(shot.camera.intrinsics)
    to_world = quaternion_to_matrix(shot.camera.T_world_camera.quaternion) @ inverse
    homogeneous = np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1)
    return homogeneous @ to_world.T.astype(np.float32)


def _table(
    shot: _Shot, directions: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """Background (kind -1), shadowed (0) or lit (1) table along rays; its radiance; its depth [m]."""
    origin = shot.origin
    falling = directions[:, 2] < -1e-9
    depth = np.where(falling, -origin[2] / np.where(falling, directions[:, 2], -1), np.inf).astype(np.float32)
    if origin[2] <= 0:  # a camera below the table sees no table
        depth[:] = np.inf
    reach = np.where(falling, depth, 0) if origin[2] > 0 else np.zeros_like(depth)
    points = origin + reach[:, None] * directions
    half = TABLE_SIDE_M / 2
    on_table = np.isfinite(depth) & (np.abs(points[:, 0]) <= half) & (np.abs(points[:, 1]) <= half)
    kind = np.full(len(depth), -1.0, np.float32)
    kind[on_table] = _lit(shot, points[on_table], None)
    colour = np.empty((len(depth), 3), np.float32)
    colour[:] = BACKGROUND_RADIANCE
    count = int(on_table.sum())
    albedo = np.broadcast_to(np.array(TABLE_ALBEDO, np.float32), (count, 3))
    cosine = np.full(count, shot.light[2], np.float32)
    colour[on_table] = lambert(albedo, cosine, kind[on_table], shot.lamp)
    return kind, colour, np.where(on_table, depth, np.inf).astype(np.float32)


def _shade(
    shot: _Shot, points: Float[np.ndarray, "S 2"], visible: tuple[int, ...]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], np.ndarray]:
    """Radiance, depth and owner (index of the body, or -1) of the samples at pixel coordinates."""
    directions = _directions(shot, points)
    nearest = np.full(len(points), NO_HIT, np.float32)
    owner = np.full(len(points), -1)
    face = np.zeros(len(points), np.int64)
    barycentric = np.zeros((len(points), 2), np.float32)
    for i in visible:
        inside = np.arange(len(points)) if shot.sharp else _inside_box(shot, i, points)
        if len(inside) == 0:
            continue
        origins = np.broadcast_to(shot.origin, (len(inside), 3))
        local_origins, local_directions = into_frame(shot.bodies[i].pose, origins, directions[inside])
        distance, hit_face, hit_uv = shot.bodies[i].mesh.intersect(local_origins, local_directions)
        closer = distance < nearest[inside]
        chosen = inside[closer]
        nearest[chosen], owner[chosen] = distance[closer], i
        face[chosen], barycentric[chosen] = hit_face[closer], hit_uv[closer]
    colour = np.zeros((len(points), 3), np.float32)
    depth = np.full(len(points), np.inf, np.float32)
    if shot.has_table:
        # Bodies stand on the table, so it is only seen where no body was hit.
        open_rays = np.nonzero(owner < 0)[0]
        _, colour[open_rays], depth[open_rays] = _table(shot, directions[open_rays])
        below = (owner >= 0) & ~_above_table(shot, directions, nearest)
        owner[below] = -1
        _, colour[below], depth[below] = _table(shot, directions[below])
    for i in visible:
        mine = np.nonzero(owner == i)[0]
        if len(mine):
            colour[mine] = _body_colour(shot, i, directions[mine], nearest[mine], face[mine], barycentric[mine])
            depth[mine] = nearest[mine]
    return colour, depth, owner


def _above_table(shot: _Shot, directions: np.ndarray, distance: np.ndarray) -> Bool[np.ndarray, "S"]:
    """Whether hits lie above the table's plane: a body that sinks a fraction of a millimetre does not shine through."""
    z = shot.origin[2] + np.where(distance < NO_HIT, distance, 0) * directions[:, 2]
    return z > -1e-4 if shot.origin[2] > 0 else np.ones(len(z), bool)


def _inside_box(shot: _Shot, index: int, points: Float[np.ndarray, "S 2"]) -> np.ndarray:
    box = _screen_box(shot.bodies[index], shot.camera)
    if box is None:
        return np.zeros(0, np.int64)
    left, top, right, bottom = box
    x, y = points.T
    return np.nonzero((x >= left) & (x < right) & (y >= top) & (y < bottom))[0]


def _body_colour(
    shot: _Shot, index: int, directions: np.ndarray, distance: np.ndarray, face: np.ndarray, barycentric: np.ndarray
) -> Float[np.ndarray, "S 3"]:
    """Radiance of hits on one body."""
    body = shot.bodies[index]
    rotation = quaternion_to_matrix(body.pose.quaternion).astype(np.float32)
    surface = body.mesh.surface(face, barycentric, directions @ rotation)
    normals = surface.normals @ rotation.T
    spacing_m = float(distance.mean()) / shot.camera.intrinsics[1, 1] / shot.samples
    albedo = body.mesh.albedo(surface.uv, 0.0 if shot.sharp else spacing_m)
    cosine = normals @ shot.light
    visible = np.zeros(len(distance), np.float32)
    facing = np.nonzero(cosine > 0)[0]
    points = shot.origin + distance[facing, None] * directions[facing] + _BIAS_M * normals[facing]
    visible[facing] = _lit(shot, points, index)
    return lambert(albedo, cosine, visible, shot.lamp)


def _lit(shot: _Shot, points: Float[np.ndarray, "S 3"], receiver: int | None) -> Float[np.ndarray, "S"]:
    """1 where the light reaches world points, 0 where a body stands in the way (the receiver itself included)."""
    lit = np.ones(len(points), np.float32)
    for i, body in enumerate(shot.bodies):
        if i == receiver:
            candidates = np.nonzero(lit)[0]
        else:  # only points whose ray toward the light passes through the body's bounding sphere
            to_centre = body.pose.position.astype(np.float32) - points
            along = to_centre @ shot.light
            across2 = np.einsum("ij,ij->i", to_centre, to_centre) - along**2
            candidates = np.nonzero((lit > 0) & (across2 < body.mesh.radius_m**2) & (along > -body.mesh.radius_m))[0]
        if len(candidates):
            light = np.broadcast_to(shot.light, (len(candidates), 3))
            blocked = body.mesh.occludes(*into_frame(body.pose, points[candidates], light))
            lit[candidates[blocked]] = 0
    return lit
