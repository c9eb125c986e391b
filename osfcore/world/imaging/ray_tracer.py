"""Pictures of a tabletop by ray tracing: anti-aliased, textured, with exact shadows of a parallel light or a near lamp.

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
from osfcore.geometry.spot_lamp import SpotLamp
from osfcore.geometry.states import SceneState
from osfcore.world.imaging.optics import Lamp, TableSurface, lambert
from osfcore.world.imaging.shot import Body, Shot
from osfcore.world.imaging.traced_mesh import NO_HIT, TracedMesh, into_frame
from osfcore.world.imaging.traced_table import open_table, see_table
from osfcore.world.pusher_body import pusher_mesh

DEFAULT_SAMPLES = 3  # samples along each side of a pixel, in images of 96 pixels and more
_SMALL_SIDE = 96  # below, bodies may be thinner than a pixel: corners miss them and three samples are too few
_BIAS_M = np.float32(5e-4)  # shadow rays start this far above curved facets, which smooth normals make look round


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


class RayTracer:
    """Traces views of scenes made of known meshes.

    Args:
        meshes: the objects that scenes may name.
        lamp: strengths of ambient and diffuse light, and their colour; the usual ones if None.
        table: what the table looks like; the usual one if None.
        spot: a near lamp in the place of the light of every state.
        executor: traces the views of one call side by side, if given (threads serve: Embree releases the GIL).
    """

    def __init__(
        self,
        meshes: Mapping[str, TracedMesh],
        *,
        lamp: Lamp | None = None,
        table: TableSurface | None = None,
        spot: SpotLamp | None = None,
        executor: Executor | None = None,
    ) -> None:
        self._meshes = dict(meshes)
        self._pusher = TracedMesh(pusher_mesh())
        self._lamp = lamp or Lamp()
        self._table = table or TableSurface()
        self._spot = spot
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
        bodies = [Body(self._meshes[name], state.poses[i]) for i, name in enumerate(state.names)]
        if state.pusher is not None:
            bodies.append(Body(self._pusher, Pose(state.pusher, Pose.identity().quaternion)))
        light = state.light.direction.astype(np.float32)
        lamp, table, spot = self._lamp, self._table, self._spot
        shots = [Shot(tuple(bodies), light, c, lamp, table, samples or _samples_for(c), sharp, spot) for c in cameras]
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
        bodies = (Body(self._meshes[name], Pose.identity()),)
        light = np.asarray(light_direction, np.float32)
        return _trace(Shot(bodies, light, camera, self._lamp, None, samples, False))


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


def _trace(shot: Shot) -> Picture:
    """One view: closed-form table first, then grids of samples where something happens."""
    height, width = shot.camera.height, shot.camera.width
    near_body = np.ones((height, width), bool) if shot.sharp else _near_bodies(shot)
    rgb = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    coverage = np.zeros((len(shot.bodies), height, width), np.float32)
    if shot.table is not None:
        busy = open_table(shot, near_body, rgb, depth)
        _sampled(shot, busy & ~near_body, (), rgb, depth, coverage)
    _sampled(shot, near_body, tuple(range(len(shot.bodies))), rgb, depth, coverage)
    return Picture(rgb, coverage, depth)


def _near_bodies(shot: Shot) -> Bool[np.ndarray, "h w"]:
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
            directions = shot.directions(np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32))
            origins = np.broadcast_to(shot.origin, directions.shape)
            hit = body.mesh.occludes(*into_frame(body.pose, origins, directions))
            on_body[top : bottom + 1, left : right + 1] |= hit.reshape(x.shape)
    pixels = on_body[:-1, :-1] | on_body[:-1, 1:] | on_body[1:, :-1] | on_body[1:, 1:]
    return cv2.dilate(pixels.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _screen_box(body: Body, camera: Camera) -> tuple[int, int, int, int] | None:
    T_camera_object = camera.T_world_camera.inverse() @ body.pose
    return body.mesh.screen_box(T_camera_object, camera.intrinsics, camera.width, camera.height)


def _sampled(
    shot: Shot,
    pixels: Bool[np.ndarray, "h w"],
    visible: tuple[int, ...],
    rgb: np.ndarray,
    depth: np.ndarray,
    coverage: np.ndarray,
) -> None:
    """Fill the chosen pixels with the mean of a grid of samples; `visible` are the bodies they may show."""
    for samples in shot.sampled(pixels):
        chosen = samples.rows, samples.columns
        colour, z, owner = _shade(shot, samples.points, visible)
        rgb[chosen] = samples.means(colour)
        hit = np.isfinite(z)
        share = samples.means(hit[:, None].astype(np.float32))[:, 0]
        total = samples.means(np.where(hit, z, 0)[:, None])[:, 0]
        depth[chosen] = np.where(share > 0, total / np.maximum(share, 1e-6), np.inf)
        owned = owner[:, None] == np.array(visible)
        coverage[visible, samples.rows[:, None], samples.columns[:, None]] = samples.means(owned.astype(np.float32))


def _shade(
    shot: Shot, points: Float[np.ndarray, "S 2"], visible: tuple[int, ...]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], np.ndarray]:
    """Radiance, depth and owner (index of the body, or -1) of the samples at pixel coordinates."""
    directions = shot.directions(points)
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
    if shot.table is not None:
        # Bodies stand on the table, so it is only seen where no body was hit, or below the table.
        owner[(owner >= 0) & ~_above_table(shot, directions, nearest)] = -1
        open_rays = np.nonzero(owner < 0)[0]
        seen = see_table(shot, directions[open_rays])
        colour[open_rays], depth[open_rays] = seen.colour, seen.depth
    for i in visible:
        mine = np.nonzero(owner == i)[0]
        if len(mine):
            colour[mine] = _body_colour(shot, i, directions[mine], nearest[mine], face[mine], barycentric[mine])
            depth[mine] = nearest[mine]
    return colour, depth, owner


def _above_table(shot: Shot, directions: np.ndarray, distance: np.ndarray) -> Bool[np.ndarray, "S"]:
    """Whether hits lie above the table's plane: a body that sinks a fraction of a millimetre does not shine through."""
    z = shot.origin[2] + np.where(distance < NO_HIT, distance, 0) * directions[:, 2]
    return z > -1e-4 if shot.origin[2] > 0 else np.ones(len(z), bool)


def _inside_box(shot: Shot, index: int, points: Float[np.ndarray, "S 2"]) -> np.ndarray:
    box = _screen_box(shot.bodies[index], shot.camera)
    if box is None:
        return np.zeros(0, np.int64)
    left, top, right, bottom = box
    x, y = points.T
    return np.nonzero((x >= left) & (x < right) & (y >= top) & (y < bottom))[0]


def _body_colour(
    shot: Shot, index: int, directions: np.ndarray, distance: np.ndarray, face: np.ndarray, barycentric: np.ndarray
) -> Float[np.ndarray, "S 3"]:
    """Radiance of hits on one body."""
    body = shot.bodies[index]
    rotation = quaternion_to_matrix(body.pose.quaternion).astype(np.float32)
    surface = body.mesh.surface(face, barycentric, directions @ rotation)
    normals = surface.normals @ rotation.T
    spacing_m = float(distance.mean()) / shot.camera.intrinsics[1, 1] / shot.samples
    albedo = body.mesh.albedo(surface.uv, 0.0 if shot.sharp else spacing_m)
    points = shot.origin + distance[:, None] * directions
    incidence = shot.incidence(points, normals)
    visible = np.zeros(len(distance), np.float32)
    facing = np.nonzero(incidence > 0)[0]
    visible[facing] = shot.lit(points[facing] + _BIAS_M * normals[facing], index)
    return lambert(albedo, incidence, visible, shot.lamp)
