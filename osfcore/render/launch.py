"""From scenes and cameras to the arrays that the compiled renderer works on, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from osfcore.fields.ray_marching import ONE_AT_A_TIME
from osfcore.fields.table_field import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import quaternion_to_matrix
from osfcore.render.kernels import BAND_ROWS, NO_OUTLINE, render_batch
from osfcore.render.lamps import Lamps, below_lamps, numbers_of_lamps, over_the_table, place_lamps
from osfcore.render.packing import Packed
from osfcore.render.table_kernels import render_base
from osfcore.render.types import MASK_OPACITY, Quality, Rendered, SceneBatch, camera_numbers, poses_of

_LAST_CORNER = 1.001  # interpolation needs the corner after
_TINY = 1e-9
_NEAREST_M = 1e-3  # corners of boxes closer than that make a box fill the screen


class Table(NamedTuple):
    """What compiled code needs of a table; background is black where there is none."""

    exists: bool
    half_side: np.float32
    albedo: np.ndarray
    ambient: np.ndarray
    background: np.ndarray


class Scene(NamedTuple):
    """Where everything is, in the voxel coordinates of each object.

    Attributes:
        eye: B x V x N x 3, the cameras.
        ray: B x V x N x 9, from pixel coordinates (u, v, 1) to directions, of the length that they have in pixels.
        lit: B x N x 3, toward the light, per metre.
        lit_inverse: the same, each number inverted.
        between: B x (N + 1) x N x 12, from the voxel coordinates of one object to another's; the last: the world.
        reach: N x 6, lowest and highest corner of what is occupied.
    """

    eye: np.ndarray
    ray: np.ndarray
    lit: np.ndarray
    lit_inverse: np.ndarray
    between: np.ndarray
    reach: np.ndarray


class Outlines(NamedTuple):
    """Corners of boxes on the screen, B x V x N x 8 x 2 [px]; `NO_OUTLINE` where a box reaches behind the camera."""

    objects: np.ndarray
    shadows: np.ndarray


class Rules(NamedTuple):
    """`Quality` for compiled code; `enough` is the optical depth past which no light counts."""

    step_voxels: np.float32
    min_weight: np.float32
    stop: np.float32
    enough: np.float32
    one_shadow: bool
    shadow_voxels: np.float32
    samples: int


def launch(  # noqa: D417
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    table: TableField | None,
    batch: SceneBatch,
    cameras: Sequence[Camera],
    size: tuple[int, int],
    quality: Quality,
    outputs: frozenset[str] | set[str],
    only: Bool[np.ndarray, "V h w"] | None,
) -> Rendered:
    """Render a batch on the CPU.

    Args:
        pack, numbers, size: fields, which of them each object has (the pusher's last), and h, w of the images [px].
        table, batch, cameras, quality, outputs, only: as in `SceneRenderer` and its `render`.
    """
    rotations, positions = poses_of(batch)
    scenes, views, count = len(batch.lights), len(cameras), len(batch.names)
    lenses = np.array([camera_numbers(camera) for camera in cameras])
    corners = _corners_world(pack.extents[numbers], rotations, positions)
    if table is None:
        boxes, outline = _on_screen(corners, cameras)
        shadows, shadow_outline = np.zeros_like(boxes), np.zeros_like(outline)
    else:
        dropped = _on_table(corners, batch.lights) if batch.spots is None else below_lamps(corners, batch.spots)
        both = _on_screen(np.concatenate([corners, dropped], axis=1), cameras)
        (boxes, shadows), (outline, shadow_outline) = (_halves(part) for part in both)
    shape = (scenes, views, *size)
    rgb = np.empty((*shape, 3), np.float32)
    wants_opacity = bool({"opacity", "masks"} & set(outputs))
    opacity = np.zeros((scenes, views, count, *size) if wants_opacity else (0,) * 5, np.float32)
    distance = np.empty(shape if "depth" in outputs else (0,) * 4, np.float32)
    plain, rules = plain_table(table), _rules(quality)
    lenses_f32 = np.array(lenses, np.float32, order="C")
    directs = np.zeros((scenes, 3), np.float32) if table is None else table.direct(batch.lights)
    lamps = None if batch.spots is None else place_lamps(batch.spots, pack, numbers, rotations, positions, table)
    scene = _scene(pack, numbers, rotations, positions, batch.lights, lenses)
    mask = np.zeros((0, 0, 0), np.uint8) if only is None else np.ascontiguousarray(only).view(np.uint8)
    with ONE_AT_A_TIME:
        base = _empty_tables(plain, table, batch, lamps, lenses_f32, size, quality.samples_per_side)
        render_batch(pack, plain, numbers, scene, directs, lamps, lenses_f32, *base, boxes, shadows,
                     Outlines(outline, shadow_outline), rules, mask, _stride(rgb), rgb, opacity, distance)  # fmt: skip
    return Rendered(
        rgb,
        opacity if "opacity" in outputs else None,
        opacity >= MASK_OPACITY if "masks" in outputs else None,
        z_depth(distance, cameras) if "depth" in outputs else None,
    )


def _empty_tables(
    plain: Table,
    table: TableField | None,
    batch: SceneBatch,
    lamps: Lamps | None,
    lenses: Float32[np.ndarray, "V 12"],
    size: tuple[int, int],
    samples: int,
) -> tuple[Float32[np.ndarray, "L V h w 3"], Float32[np.ndarray, "L V h w"], Int[np.ndarray, "B"]]:
    """Colours and distances of the empty table under each of L different lights, and which of them each scene has.

    Where no scenes share one, L is 0.
    """
    lights = batch.lights.astype(np.float32)
    rows = lights if batch.spots is None else numbers_of_lamps(batch.spots)
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    shape = len(first) if len(first) < len(rows) else 0, len(lenses), *size
    rgb, distance = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    if table is not None and len(rgb):
        different = None if lamps is None else over_the_table(lamps, first)
        render_base(plain, lenses, table.direct(lights[first]), different, samples, rgb, distance)
    return rgb, distance, which.reshape(-1)


def _stride(images: Float32[np.ndarray, "B V h w 3"]) -> int:
    """A number coprime to the number of bands, about the golden section of it, so that multiples spread evenly."""
    bands = images.shape[0] * images.shape[1] * -(-images.shape[2] // BAND_ROWS)
    return next(s for s in range(max(round(0.618 * bands), 1), 2 * bands + 2) if math.gcd(s, bands) == 1)


def _scene(
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    lights: Float[np.ndarray, "B 3"],
    lenses: Float[np.ndarray, "V 12"],
) -> Scene:
    """Everything in voxel coordinates, worked out in double precision."""
    scales = pack.scales[numbers].astype(float)
    origin, voxel = scales[:, :3], scales[:, 3:]
    into = rotations / voxel[..., None]  # from the world
    offset = -np.einsum("bnij,bnj->bni", into, positions) - origin / voxel
    eye = np.einsum("bnij,vj->bvni", into, lenses[:, :3]) + offset[:, None]
    ray = np.einsum("bnij,vjk->bvnik", into, lenses[:, 3:].reshape(-1, 3, 3))
    lit = np.einsum("bnij,bj->bni", into, lights)
    # From object n: x_world = R_n^T (voxel_n * x + origin_n) + position_n; the world comes as it is.
    scenes, count = positions.shape[:2]
    linear = np.concatenate(
        [np.swapaxes(rotations, -1, -2) * voxel[..., None], np.tile(np.eye(3), (scenes, 1, 1, 1))], 1
    )
    shift = np.einsum("bnji,nj->bni", rotations, origin) + positions
    shift = np.concatenate([shift, np.zeros((scenes, 1, 3))], axis=1)
    between = np.empty((scenes, count + 1, count, 3, 4))
    between[..., :3] = np.einsum("bmij,bnjk->bnmik", into, linear)
    between[..., 3] = np.einsum("bmij,bnj->bnmi", into, shift) + offset[:, None]
    reach = (pack.extents[numbers].reshape(-1, 2, 3) - origin[:, None]) / voxel[:, None]
    most = pack.shapes[numbers, :3] - _LAST_CORNER
    reach = np.stack([np.maximum(reach[:, 0], 0), np.minimum(reach[:, 1], most)], axis=1)
    inverse = 1 / np.where(np.abs(lit) > _TINY, lit, _TINY)
    arrays = (eye, ray.reshape(*ray.shape[:3], 9), lit, inverse, between.reshape(scenes, count + 1, count, 12))
    # One memory layout for all batches: any other would be compiled anew, which takes half a minute.
    return Scene(*(np.array(array, np.float32, order="C") for array in (*arrays, reach.reshape(-1, 6))))


def _rules(quality: Quality) -> Rules:
    f = np.float32
    return Rules(f(quality.step_voxels), f(quality.min_weight), f(quality.stop), f(-np.log(quality.stop)),
                 quality.one_shadow, f(quality.shadow_voxels), quality.samples_per_side)  # fmt: skip


def _corners_world(
    extents: Float[np.ndarray, "N 6"], rotations: Float[np.ndarray, "B N 3 3"], positions: Float[np.ndarray, "B N 3"]
) -> Float[np.ndarray, "B N 8 3"]:
    """The corners of the objects' boxes [m]."""
    choice = np.array(list(np.ndindex(2, 2, 2)), bool)
    corners = np.where(choice, extents[:, None, 3:], extents[:, None, :3])
    return np.einsum("bnji,ncj->bnci", rotations, corners) + positions[:, :, None]


def _on_screen(
    points: Float[np.ndarray, "B N 8 3"], cameras: Sequence[Camera]
) -> tuple[Int[np.ndarray, "B V N 4"], Float32[np.ndarray, "B V N 8 2"]]:
    """Boxes of pixels and outlines of boxes' corners, from every camera."""
    boxes, outlines = zip(*(screen_boxes(points, camera) for camera in cameras), strict=True)
    return np.stack(boxes, axis=1), np.stack(outlines, axis=1)


def _halves(array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first and the second half along the third axis, each in one piece."""
    count = array.shape[2] // 2
    return np.ascontiguousarray(array[:, :, :count]), np.ascontiguousarray(array[:, :, count:])


def screen_boxes(
    points: Float[np.ndarray, "B N 8 3"], camera: Camera
) -> tuple[Int[np.ndarray, "B N 4"], Float32[np.ndarray, "B N 8 2"]]:
    """The pixels that hold the projections of boxes' corners: columns from, to, rows from, to (not included).

    And the projections themselves [px]; `NO_OUTLINE` where a box reaches behind the camera.
    """
    pose = camera.T_world_camera
    local = (points - pose.position) @ quaternion_to_matrix(pose.quaternion)
    depth = local[..., 2]
    projected = local @ camera.intrinsics.T
    pixels = projected[..., :2] / np.maximum(depth, _NEAREST_M)[..., None]
    limits = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=2)), 0, limits)
    high = np.clip(np.ceil(pixels.max(axis=2)), 0, limits)
    behind = np.all(depth <= 0, axis=2)[..., None]
    is_sane = np.all(np.isfinite(pixels), axis=(2, 3))
    cut = (np.any(depth < _NEAREST_M, axis=2) | ~is_sane)[..., None] & ~behind
    low, high = np.where(cut, 0, low), np.where(cut, limits, high)
    high = np.where(behind, low, high)
    boxes = np.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], axis=-1).astype(np.int64)
    return boxes, np.where(cut[..., None], NO_OUTLINE, pixels).astype(np.float32)


def _on_table(points: Float[np.ndarray, "B N 8 3"], lights: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B N 8 3"]:
    """Where the light drops points onto the plane z = 0. Lights below it drop nothing."""
    elevation = np.maximum(lights[:, 2], 1e-3)[:, None, None, None]
    dropped = points - lights[:, None, None] * points[..., 2:] / elevation  # points below it rise: none is left out
    dropped[..., 2] = 0
    return dropped


def plain_table(table: TableField | None) -> Table:
    """A table for compiled code."""
    if table is None:
        nothing = np.zeros(3, np.float32)
        return Table(False, np.float32(1), np.zeros((2, 2, 3), np.float32), nothing, nothing)
    return Table(True, np.float32(table.half_side), table.albedo, table.ambient, table.background)


def z_depth(distance: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Distances along rays as distances along the cameras' z axes."""
    result = np.empty_like(distance)
    for view, camera in enumerate(cameras):
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        result[:, view] = distance[:, view] / np.linalg.norm(pixels, axis=-1)
    return result
