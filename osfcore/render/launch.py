"""From scenes and cameras to the arrays that the compiled renderer works on, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from osfcore.fields.table import TableField
from osfcore.render.kernels import render_base, render_batch
from osfcore.render.packing import Packed
from osfcore.render.scene_renderer import (
    MASK_OPACITY,
    Quality,
    Rendered,
    SceneBatch,
    camera_numbers,
    poses_of,
)
from osfcore.scene import Camera

_NEAREST_M = 1e-3  # corners of boxes closer than that make a box fill the screen


class _Table(NamedTuple):
    """What compiled code needs of a table."""

    half_side: np.float32
    albedo: np.ndarray
    ambient: np.ndarray
    background: np.ndarray


def launch(
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    corners: Float[np.ndarray, "N 8 3"],
    table: TableField | None,
    batch: SceneBatch,
    cameras: Sequence[Camera],
    size: tuple[int, int],
    quality: Quality,
    outputs: frozenset[str] | set[str],
) -> Rendered:
    """Render a batch; `numbers` are the objects' fields in the pack, `corners` the corners of their boxes."""
    rotations, positions = poses_of(batch)
    scenes, views, count = len(batch.lights), len(cameras), len(batch.names)
    lights = batch.lights.astype(np.float32)
    directs = np.zeros((scenes, 3), np.float32) if table is None else table.direct(lights)
    shape = (scenes, views, *size)
    rgb = np.empty((*shape, 3), np.float32)
    wants_opacity = bool({"opacity", "masks"} & set(outputs))
    opacity = np.zeros((scenes, views, count, *size) if wants_opacity else (0,) * 5, np.float32)
    distance = np.empty(shape if "depth" in outputs else (0,) * 4, np.float32)
    corners_world = np.einsum("bnji,ncj->bnci", rotations, corners) + positions[:, :, None]
    boxes = np.stack([screen_boxes(corners_world, camera) for camera in cameras], axis=1)
    dropped = _on_table(corners_world, batch.lights) if table is not None else corners_world
    shadows = np.stack([screen_boxes(dropped, camera) for camera in cameras], axis=1)
    if table is None:
        shadows[...] = 0
    # A shadow lies on the table between the foot of its object and the far end: both boxes together hold it.
    numbers_f32 = np.array([camera_numbers(camera) for camera in cameras], np.float32)
    plain = _plain_table(table)
    bases, base_of = _bases(plain, table is not None, numbers_f32, directs, size, quality.samples_per_side)
    f = np.float32
    rules = (f(quality.step_voxels), f(quality.min_weight), f(quality.stop), quality.one_shadow, f(quality.shadow_voxels))
    render_batch(
        pack, plain, table is not None, numbers, rotations.astype(f), positions.astype(f), lights, directs, numbers_f32,
        bases, base_of, boxes, shadows, rules, quality.samples_per_side, rgb, opacity, distance,
    )  # fmt: skip
    return Rendered(
        rgb,
        opacity if "opacity" in outputs else None,
        opacity >= MASK_OPACITY if "masks" in outputs else None,
        _z_depth(distance, cameras) if "depth" in outputs else None,
    )


def screen_boxes(points: Float[np.ndarray, "B N 8 3"], camera: Camera) -> Int[np.ndarray, "B N 4"]:
    """The pixels that hold the projections of boxes' corners: columns from, to, rows from, to (not included)."""
    inverse = camera.T_world_camera.inverse().matrix()
    local = points @ inverse[:3, :3].T + inverse[:3, 3]
    depth = local[..., 2]
    projected = local @ camera.intrinsics.T
    pixels = projected[..., :2] / np.maximum(depth, _NEAREST_M)[..., None]
    limits = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=2)), 0, limits)
    high = np.clip(np.ceil(pixels.max(axis=2)), 0, limits)
    behind = np.all(depth <= 0, axis=2)[..., None]
    cut = np.any(depth < _NEAREST_M, axis=2)[..., None] & ~behind
    low, high = np.where(cut, 0, low), np.where(cut, limits, high)
    high = np.where(behind, low, high)
    return np.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], axis=-1).astype(np.int64)


def _on_table(points: Float[np.ndarray, "B N 8 3"], lights: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B N 8 3"]:
    """Where the light drops points onto the plane z = 0. Lights below it drop nothing."""
    height = np.maximum(points[..., 2:], 0)
    elevation = np.maximum(lights[:, 2], 1e-3)[:, None, None, None]
    dropped = points - lights[:, None, None] * height / elevation
    dropped[..., 2] = 0
    return dropped


def _plain_table(table: TableField | None) -> _Table:
    if table is None:
        nothing = np.zeros(3, np.float32)
        return _Table(np.float32(1), np.zeros((2, 2, 3), np.float32), nothing, nothing)
    return _Table(np.float32(table.half_side), table.albedo, table.ambient, table.background)


def _bases(
    table: _Table, has_table: bool, cameras: np.ndarray, directs: np.ndarray, size: tuple[int, int], samples: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The empty table once per different light and camera, and which of them each image begins with."""
    different, which = np.unique(directs, axis=0, return_inverse=True)
    views = len(cameras)
    if not has_table:
        return (np.zeros((1, *size, 3), np.float32), np.zeros((1, *size), np.float32)), np.zeros(
            (len(directs), views), np.int64
        )
    drawn = [render_base(table, has_table, camera, direct, size, samples) for direct in different for camera in cameras]
    base_of = which.reshape(-1, 1) * views + np.arange(views)
    return (np.stack([rgb for rgb, _ in drawn]), np.stack([distance for _, distance in drawn])), base_of


def _z_depth(distance: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Distances along rays as distances along the cameras' z axes."""
    result = np.empty_like(distance)
    for view, camera in enumerate(cameras):
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        result[:, view] = distance[:, view] / np.linalg.norm(pixels, axis=-1)
    return result
