"""The fast renderer, which draws batches of scenes from several cameras in one call of compiled code."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from osfcore.errors import InvalidInput
from osfcore.fields.devices import pick_device
from osfcore.fields.kiloosf import MOST_HIDDEN, KiloOSF
from osfcore.fields.rays import ONE_AT_A_TIME
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import MIN_PENUMBRA_RAD, SpotLamp
from osfcore.geometry.poses import quaternion_to_matrix
from osfcore.render.kernels import BAND_ROWS, GONE, MOVES, NO_OUTLINE, STILL, render_batch
from osfcore.render.reference import pusher_field, render_on_device
from osfcore.render.types import EXACT, Quality, Rendered, SceneBatch, camera_numbers, check_request, poses_of

# Fields in flat arrays, one after the other, as compiled code needs them.


class Packed(NamedTuple):
    """N fields. `starts` holds where each one begins in the flat arrays.

    Attributes:
        density: g on all corners.
        index: rows of all corners.
        rows: features, one after another.
        macro: distances between blocks and density.
        cells: numbers of networks.
        networks: parameters, one network after another.
        starts: N x 5: offsets into density and index, rows, macro, cells, networks.
        shapes: N x 9: grid, blocks, cells.
        scales: N x 4: origin [m], voxel [m].
        extents: N x 6: lowest and highest corner of the occupied part [m].
        ambient: N x 3.
        hidden: width of the networks, the same for all.
        parameters: parameters of one network.
    """

    density: np.ndarray
    index: np.ndarray  # pyright: ignore[reportIncompatibleMethodOverride]
    rows: np.ndarray
    macro: np.ndarray
    cells: np.ndarray
    networks: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray
    scales: np.ndarray
    extents: np.ndarray
    ambient: np.ndarray
    hidden: int
    parameters: int


def pack(fields: Sequence[KiloOSF]) -> Packed:
    """Return fields in flat arrays, one after the other.

    Raises:
        InvalidInput: if their networks differ in width, or are too wide.
    """
    widths = {field.hidden for field in fields}
    if len(widths) > 1:
        raise InvalidInput("widths of the fields' networks", sorted(widths), "the same for all fields of a scene")
    if max(widths) > MOST_HIDDEN:
        raise InvalidInput("width of the fields' networks", max(widths), f"at most {MOST_HIDDEN}")
    counts = [[f.density.size, len(f.rows), f.macro.size, f.cells.size, len(f.networks)] for f in fields]
    starts = np.zeros((len(fields), 5), np.int64)
    starts[1:] = np.cumsum(counts, axis=0)[:-1]
    flat = ("density", "index", "rows", "macro", "cells", "networks")
    return Packed(
        **{name: np.concatenate([getattr(f, name).reshape(-1) for f in fields]) for name in flat},
        starts=starts,
        shapes=np.array([[*f.index.shape, *f.macro.shape, *f.cells.shape] for f in fields], np.int64),
        scales=np.array([[*f.origin, f.voxel] for f in fields], np.float32),
        extents=np.array([_reach(f).reshape(-1) for f in fields], np.float32),
        ambient=np.array([f.ambient for f in fields], np.float32),
        hidden=fields[0].hidden,
        parameters=fields[0].networks.shape[1],
    )


def _reach(field: KiloOSF) -> np.ndarray:
    """Return the occupied part and one voxel more: between an occupied corner and an empty one there is density too."""
    low, high = field.extent
    return np.stack([low - field.voxel, high + field.voxel])


# Near lamps for the compiled renderer: their positions in every object's coordinates, and their shadows.


_HIGHEST = 0.98  # of a lamp's height: what reaches higher may cast its shadow anywhere


class Lamps(NamedTuple):
    """The near lamps of B scenes.

    Attributes:
        position: B x (N + 1) x 3, in the voxel coordinates of each object; the last: in the world [m].
        axis: B x (N + 1) x 3, unit vectors from the lamp toward what it looks at, along the same axes.
        cone: B x 3, outer half-angle [rad], 1 / the width of the penumbra [1/rad], squared distance from the table's
            centre [m^2].
        w1, b1, w2, b2: how the table answers to light from a direction (`TableField`).
    """

    position: np.ndarray
    axis: np.ndarray
    cone: np.ndarray
    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray

    def of(self, chosen: Int[np.ndarray, "L"]) -> Lamps:
        """Return the lamps of some of the scenes."""
        return Lamps(self.position[chosen], self.axis[chosen], self.cone[chosen], *self[3:])


def place_lamps(
    spots: Sequence[SpotLamp],
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    table: TableField | None,
) -> Lamps:
    """Return the lamps of B scenes, computed in double precision.

    Args:
        spots: one lamp for each scene.
        pack: the fields.
        numbers: index of each object's field.
        rotations: rotations from the world to each object's frame.
        positions: positions of the objects [m].
        table: field of the table; None if there is none.
    """
    scales = pack.scales[numbers].astype(float)
    place, axis = (np.array([getattr(spot, name) for spot in spots]) for name in ("position", "axis"))
    local = np.einsum("bnij,bnj->bni", rotations, place[:, None] - positions)
    local = (local - scales[:, :3]) / scales[:, 3:]
    cone = [(outer, 1 / max(outer - inner, MIN_PENUMBRA_RAD)) for inner, outer in (spot.cone_rad for spot in spots)]
    if table is None:
        network = np.zeros((3, 0)), np.zeros(0), np.zeros((0, 3)), np.zeros(3)
    else:
        network = table.w1, table.b1, table.w2, table.b2
    arrays = (
        np.concatenate([local, place[:, None]], axis=1),
        np.concatenate([np.einsum("bnij,bj->bni", rotations, axis), axis[:, None]], axis=1),
        np.column_stack([cone, np.sum(place**2, axis=1)]),
        *network,
    )
    return Lamps(*(np.array(array, np.float32, order="C") for array in arrays))  # any other layout is compiled anew


def below_lamps(points: Float[np.ndarray, "B N 8 3"], spots: Sequence[SpotLamp]) -> Float[np.ndarray, "B N 8 3"]:
    """Project points from lamps onto the plane z = 0; NaN for points about as high as the lamp, or higher."""
    lamps = np.array([spot.position for spot in spots])[:, None, None]
    height = lamps[..., 2:]
    is_below = points[..., 2:] < _HIGHEST * height
    dropped = lamps + (points - lamps) * height / np.where(is_below, height - points[..., 2:], 1)
    dropped[..., 2] = 0
    return np.where(is_below, dropped, np.nan)


# From scenes and cameras to the arrays that the compiled renderer works on, and back.


_LAST_CORNER = 1.001  # interpolation needs the corner after
_TINY = 1e-9
_LOWEST = 0.02  # of a light that drops shadows onto the table
_NEAREST_M = 1e-3  # corners of boxes closer than that make a box fill the screen


class Table(NamedTuple):
    """What compiled code needs of a table; background is black where there is none."""

    exists: bool
    half_side: np.float32
    albedo: np.ndarray
    ambient: np.ndarray
    background: np.ndarray


class Scene(NamedTuple):
    """Geometry of the scenes, in the voxel coordinates of each object and on the screens.

    Outlines are convex hulls of points on the screen [px], `NO_OUTLINE` where some are behind the camera; boxes hold
    them, or the whole screen: columns from, to, rows from, to.

    Attributes:
        eye: B x V x N x 3, the cameras.
        ray: B x V x N x 9, from pixel coordinates (u, v, 1) to directions, of the length that they have in pixels.
        lit: B x N x 3, toward the light, per metre.
        lit_inverse: the same, each number inverted.
        between: B x (N + 1) x N x 12, from the voxel coordinates of one object to another's; the last: the world.
        direct: B x 3, direct light on a white table.
        part: B x N, whether an object is `GONE`, or `STILL` and in the base, or `MOVES`.
        box, outline: B x V x N x 4 and x 8 x 2, of the objects.
        shadow_box, shadow: likewise, of their shadows on the table.
        swept_box, swept: B x V x N x 4 and x 16 x 2, of the objects, their shadows and all between.
        reach: N x 6, lowest and highest corner of what is occupied.
    """

    eye: np.ndarray
    ray: np.ndarray
    lit: np.ndarray
    lit_inverse: np.ndarray
    between: np.ndarray
    direct: np.ndarray
    part: np.ndarray
    box: np.ndarray
    outline: np.ndarray
    shadow_box: np.ndarray
    shadow: np.ndarray
    swept_box: np.ndarray
    swept: np.ndarray
    reach: np.ndarray

    def of(self, chosen: Int[np.ndarray, "L"], part: Int[np.ndarray, "L N"]) -> Scene:
        """Return some of the scenes, with other parts."""
        return Scene._make([*(array[chosen] for array in self[:-1]), self.reach])._replace(part=part)


class Base(NamedTuple):
    """Images of the common parts of a batch's scenes: the table, and objects with the same pose in many scenes.

    Attributes:
        of: B, which of L images each scene has; -1 for none.
        rgb, opacity, distance: L x V x h x w x 3 and so on, as results of `render_batch`.
    """

    of: np.ndarray
    rgb: np.ndarray
    opacity: np.ndarray
    distance: np.ndarray


class Rules(NamedTuple):
    """`Quality` for compiled code; `enough` is the optical depth past which no light counts."""

    step_voxels: np.float32
    min_weight: np.float32
    stop: np.float32
    enough: np.float32
    one_shadow: bool
    shadow_voxels: np.float32
    samples: int


def _shared(
    batch: SceneBatch,
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    *,
    has_table: bool,
) -> tuple[Bool[np.ndarray, "B N"], Int[np.ndarray, "L"], Int[np.ndarray, "B"]]:
    """Find the common parts of scenes, which are drawn once. Planning and derivatives move only one object of many.

    Returns:
        For each scene, the objects with the most common pose of that object; L scenes, one for each set of two or more
        with the same light and the same such objects; and the index of each scene's set, -1 for none.
    """
    scenes, count = positions.shape[:2]
    still = np.zeros((scenes, count), bool)
    if scenes < 2:
        return still, np.zeros(0, int), np.full(scenes, -1)
    if has_table and batch.lights[:, 2].min() > _LOWEST:
        poses = np.concatenate([rotations.reshape(scenes, count, 9), positions], axis=-1)
        for n in range(count):
            _, which, many = np.unique(poses[:, n], axis=0, return_inverse=True, return_counts=True)
            still[:, n] = (which == many.argmax()).reshape(-1) if many.max() > 1 else False
    lights = batch.lights
    if batch.spots is not None:
        lights = np.array([(*spot.position, *spot.aim, spot.inner_deg, spot.outer_deg) for spot in batch.spots])
    rows = np.concatenate([lights, still], axis=1)
    _, first, which, many = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)
    number = np.where(many > 1, np.cumsum(many > 1) - 1, -1)
    return still, first[many > 1], number[which.reshape(-1)]


def _stride(images: Float32[np.ndarray, "B V h w 3"]) -> int:
    """Return a number coprime to that of the bands, near its golden section, so that multiples spread evenly."""
    bands = images.shape[0] * images.shape[1] * -(-images.shape[2] // BAND_ROWS)
    return next(s for s in range(max(round(0.618 * bands), 1), 2 * bands + 2) if math.gcd(s, bands) == 1)


def _scene(
    pack: Packed,
    numbers: Int[np.ndarray, "N"],
    table: TableField | None,
    batch: SceneBatch,
    cameras: Sequence[Camera],
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    lenses: Float[np.ndarray, "V 12"],
) -> Scene:
    """Return the geometry of the scenes, computed in double precision, with all objects marked as moving."""
    scales = pack.scales[numbers].astype(float)
    origin, voxel = scales[:, :3], scales[:, 3:]
    into = rotations / voxel[..., None]  # from the world
    offset = -np.einsum("bnij,bnj->bni", into, positions) - origin / voxel
    eye = np.einsum("bnij,vj->bvni", into, lenses[:, :3]) + offset[:, None]
    ray = np.einsum("bnij,vjk->bvnik", into, lenses[:, 3:].reshape(-1, 3, 3))
    lit = np.einsum("bnij,bj->bni", into, batch.lights)
    # From object n: x_world = R_n^T (voxel_n * x + origin_n) + position_n; the world comes as it is.
    scenes, count = positions.shape[:2]
    world = np.tile(np.eye(3), (scenes, 1, 1, 1))
    linear = np.concatenate([np.swapaxes(rotations, -1, -2) * voxel[..., None], world], axis=1)
    shift = np.einsum("bnji,nj->bni", rotations, origin) + positions
    shift = np.concatenate([shift, np.zeros((scenes, 1, 3))], axis=1)
    between = np.empty((scenes, count + 1, count, 3, 4))
    between[..., :3] = np.einsum("bmij,bnjk->bnmik", into, linear)
    between[..., 3] = np.einsum("bmij,bnj->bnmi", into, shift) + offset[:, None]
    reach = (pack.extents[numbers].reshape(-1, 2, 3) - origin[:, None]) / voxel[:, None]
    most = pack.shapes[numbers, :3] - _LAST_CORNER
    reach = np.stack([np.maximum(reach[:, 0], 0), np.minimum(reach[:, 1], most)], axis=1)
    inverse = 1 / np.where(np.abs(lit) > _TINY, lit, _TINY)
    direct = np.zeros((scenes, 3)) if table is None else table.direct(batch.lights)
    arrays = (
        *(eye, ray.reshape(*ray.shape[:3], 9), lit, inverse, between.reshape(scenes, count + 1, count, 12), direct),
        reach.reshape(-1, 6),
    )
    # One memory layout for all batches: another one would need another compilation, which takes half a minute.
    *places, reach = (np.array(array, np.float32, order="C") for array in arrays)
    outlines = _outlines(pack.extents[numbers], rotations, positions, batch, cameras, has_table=table is not None)
    return Scene._make([*places, np.full((scenes, count), MOVES), *outlines, reach])


def _outlines(
    extents: Float[np.ndarray, "N 6"],
    rotations: Float[np.ndarray, "B N 3 3"],
    positions: Float[np.ndarray, "B N 3"],
    batch: SceneBatch,
    cameras: Sequence[Camera],
    *,
    has_table: bool,
) -> list[np.ndarray]:
    """Return the boxes and outlines of `Scene`: of objects, of shadows, of both with what is between."""
    choice = np.array(list(np.ndindex(2, 2, 2)), bool)
    local = np.where(choice, extents[:, None, 3:], extents[:, None, :3])  # corners of the objects' boxes [m]
    corners = np.einsum("bnji,ncj->bnci", rotations, local) + positions[:, :, None]
    if not has_table:
        box, outline = _on_screen(corners, cameras)
        return [box, outline, np.zeros_like(box), np.zeros_like(outline), box, np.concatenate([outline] * 2, axis=3)]
    dropped = _on_table(corners, batch.lights) if batch.spots is None else below_lamps(corners, batch.spots)
    boxes, outlines = _on_screen(np.concatenate([corners, dropped], axis=1), cameras)
    count = len(extents)
    halves = [
        np.ascontiguousarray(a[:, :, part]) for part in (slice(count), slice(count, None)) for a in (boxes, outlines)
    ]
    return [*halves, *_on_screen(np.concatenate([corners, dropped], axis=2), cameras)]


def _on_screen(
    points: Float[np.ndarray, "B N P 3"], cameras: Sequence[Camera]
) -> tuple[Int[np.ndarray, "B V N 4"], Float32[np.ndarray, "B V N P 2"]]:
    """Return boxes of pixels and outlines of points, from every camera."""
    boxes, outlines = zip(*(screen_boxes(points, camera) for camera in cameras), strict=True)
    return np.stack(boxes, axis=1), np.stack(outlines, axis=1)


def screen_boxes(
    points: Float[np.ndarray, "B N P 3"], camera: Camera
) -> tuple[Int[np.ndarray, "B N 4"], Float32[np.ndarray, "B N P 2"]]:
    """Return boxes of pixels that hold the projections of bodies' points, and the projections themselves [px].

    A box is columns from, to, rows from, to (not included). The projections are `NO_OUTLINE` where a body reaches
    behind the camera.
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
    """Project points along the light onto the plane z = 0. Lights below the plane count as just above it."""
    elevation = np.maximum(lights[:, 2], 1e-3)[:, None, None, None]
    dropped = points - lights[:, None, None] * points[..., 2:] / elevation  # points below it rise: none is left out
    dropped[..., 2] = 0
    return dropped


def plain_table(table: TableField | None) -> Table:
    """Prepare a table for compiled code."""
    if table is None:
        nothing = np.zeros(3, np.float32)
        return Table(False, np.float32(1), np.zeros((2, 2, 3), np.float32), nothing, nothing)
    return Table(True, np.float32(table.half_side), table.albedo, table.ambient, table.background)


def z_depth(distance: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Convert distances along rays to distances along the cameras' z axes."""
    result = np.empty_like(distance)
    for view, camera in enumerate(cameras):
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        result[:, view] = distance[:, view] / np.linalg.norm(pixels, axis=-1)
    return result


_MOST_PACKS = 8


class SceneRenderer:
    """Renders scenes of objects with known fields.

    It does volume rendering after paper eq. 3, weighted by density. Objects and pusher cast soft shadows on each other
    and on the table: the transmittance along the ray to the light. Shadows of an object on itself are part of its
    field.

    Args:
        fields: fields of the objects, by name.
        table: field of the table; None for a black background.
        device: "cpu" for compiled code on all cores, "cuda" for PyTorch on a GPU, "auto" for a GPU if there is one.

    Raises:
        InvalidInput: if there is no such device.

    Example:
        >>> renderer = SceneRenderer({name: fields.load(name)}, fields.load_table())
        >>> seen = renderer.render(SceneBatch.of(state), default_cameras(64), outputs={"rgb", "depth"})
        >>> seen.rgb.shape, seen.depth.shape
        ((1, 4, 64, 64, 3), (1, 4, 64, 64))
    """

    def __init__(self, fields: Mapping[str, KiloOSF], table: TableField | None, *, device: str = "cpu") -> None:
        self._fields = dict(fields)
        self._table = table
        self._device = "cpu" if device == "cpu" else pick_device(device).type
        self._packs: dict[tuple[tuple[str, ...], bool], tuple[Packed, np.ndarray]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects that can be drawn."""
        return tuple(self._fields)

    def render(
        self,
        batch: SceneBatch,
        cameras: Sequence[Camera],
        *,
        quality: Quality = EXACT,
        outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
        only: Bool[np.ndarray, "V h w"] | None = None,
    ) -> Rendered:
        """Render every scene of a batch from every camera.

        Args:
            batch: B scenes.
            cameras: V cameras of one image size.
            quality: accuracy of the images, exact by default.
            outputs: any of "rgb", "opacity", "masks", "depth". "rgb" is always returned.
            only: pixels to render; all others stay black and empty.

        Returns:
            The images, as arrays over B scenes and V views.

        Raises:
            UnknownName: if this renderer has no field of an object.
            InvalidInput: if there is no camera, the cameras differ in size, an output is unknown, or `only` has
                another shape.
        """
        size = check_request(self._fields, batch, cameras, outputs)
        if only is not None and only.shape != (len(cameras), *size):
            raise InvalidInput("shape of the pixels to look at", only.shape, f"{(len(cameras), *size)}")
        if self._device != "cpu":
            return render_on_device(self._fields, self._table, batch, cameras, self._device, quality, outputs, only)
        table, (pack, numbers) = self._table, self._packed(batch)
        rotations, positions = poses_of(batch)
        views = np.array([camera_numbers(camera) for camera in cameras])
        lamps = None if batch.spots is None else place_lamps(batch.spots, pack, numbers, rotations, positions, table)
        scene = _scene(pack, numbers, table, batch, cameras, rotations, positions, views)
        mask = np.zeros((0, 0, 0), np.uint8) if only is None else np.ascontiguousarray(only).view(np.uint8)
        lenses = np.array(views, np.float32, order="C")
        f = np.float32
        rules = Rules(f(quality.step_voxels), f(quality.min_weight), f(quality.stop), f(-np.log(quality.stop)),
                      quality.one_shadow, f(quality.shadow_voxels), quality.samples_per_side)  # fmt: skip

        def blank(scenes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Allocate colours, opacity and distance; empty where not asked for."""
            shape, per_object = (scenes, len(cameras), *size), (scenes, len(cameras), len(batch.names), *size)
            opacity = np.zeros(per_object if {"opacity", "masks"} & set(outputs) else (0,) * 5, f)
            return np.empty((*shape, 3), f), opacity, np.empty(shape if "depth" in outputs else (0,) * 4, f)

        def draw(scene: Scene, lamps: Lamps | None, base: Base) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            images = blank(len(scene.eye))
            render_batch(pack, plain_table(table), numbers, scene, lamps, lenses, base, rules, mask,
                         _stride(images[0]), *images)  # fmt: skip
            return images

        still, chosen, of = _shared(batch, rotations, positions, has_table=table is not None)
        base = Base(np.full(len(chosen), -1), *blank(0))
        with ONE_AT_A_TIME:
            if len(chosen):
                seen = scene.of(chosen, np.where(still[chosen], MOVES, GONE))
                base = Base(of, *draw(seen, None if lamps is None else lamps.of(chosen), base))
            scene = scene._replace(part=np.where(still & (of >= 0)[:, None], STILL, MOVES))
            rgb, opacity, distance = draw(scene, lamps, base._replace(of=of))
        depth = z_depth(distance, cameras) if "depth" in outputs else distance
        return Rendered.of(rgb, opacity, depth, outputs)

    def _packed(self, batch: SceneBatch) -> tuple[Packed, np.ndarray]:
        """Return the batch's fields, each packed once, and the index of each object's field."""
        key = (batch.names, batch.pusher is not None)
        packed = self._packs.get(key)
        if packed is None:
            if len(self._packs) > _MOST_PACKS:  # a viewer that goes through many scenes must not keep them all
                self._packs.clear()
            names = list(dict.fromkeys(batch.names))
            fields = [self._fields[name] for name in names]
            numbers = [names.index(name) for name in batch.names]
            if batch.pusher is not None or not fields:
                fields.append(pusher_field(fields[0].hidden if fields else 1))
            if batch.pusher is not None:
                numbers.append(len(fields) - 1)
            packed = pack(fields), np.array(numbers, np.int64)
            self._packs[key] = packed
        return packed
