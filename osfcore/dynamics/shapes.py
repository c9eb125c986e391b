"""Shapes of objects from their fields: convex parts, outlines, and where outlines touch."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy import ndimage
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn import functional

from osfcore.errors import InvalidInput, OsfError
from osfcore.fields.kiloosf import EMPTY_G, KiloOSF
from osfcore.geometry.convex_parts import convex_parts
from osfcore.geometry.polygons import Gap, circle, direction_index, dot, gap_between, gap_to_point
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.io.files import write_atomically

# The shape of an object, derived from its field.
#
# The paper thresholds the KiloOSF's density on a grid of points (section 4.3). We take the points where the density
# crosses the threshold along the grid's edges, which places the surface within about a millimetre instead of a
# voxel, and keep the support function of their convex hull: the farthest point in every direction. Footprint,
# height and size all follow from it, for any orientation; contact too, but that hollow objects are touched at one
# of several convex parts.


SURFACE_G = -1.5  # density feature at which fields and collision shapes of the shipped objects agree best
MAP_SIDE = 128  # of the octahedral map of directions


@dataclass(frozen=True, eq=False, slots=True)
class ObjectShape:
    """The convex hull of what is solid in a field.

    Attributes:
        half_extents: half the sides of its bounding box, in the object's frame [m].
        centre: centre of mass of the solid, of uniform density, in the object's frame [m].
        radius: radius of the sphere around the centre that holds the object [m].
        support: farthest point from the centre in each direction of the octahedral map, relative to the centre [m].
        parts: the same of each convex part; none if the hull is good enough.
    """

    half_extents: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]
    radius: float
    support: Float32[np.ndarray, "D 3"]
    parts: tuple[Float32[np.ndarray, "_ 3"], ...] = ()


def object_shape(field: KiloOSF, parts: Sequence[Float[np.ndarray, "_ 3"]] = ()) -> ObjectShape:
    """Return the shape that a field describes.

    Args:
        field: field of the object.
        parts: corners of convex parts that together fill it; none if its hull is good enough.

    Raises:
        OsfError: if nothing in the field is solid.
    """
    surface = _surface(field.density.astype(float))
    if len(surface) < 4 or np.ptp(surface, axis=0).min() <= 0:
        raise OsfError("A field without any solid part has no shape to predict the motion of.")
    surface = field.origin + field.voxel * surface
    solid = np.asarray(ndimage.binary_fill_holes(field.density > SURFACE_G))
    centre = field.origin + field.voxel * np.argwhere(solid).mean(axis=0)
    return solid_shape(surface[ConvexHull(surface).vertices], centre, parts)


def solid_shape(
    corners: Float[np.ndarray, "M 3"], centre: Float[np.ndarray, "3"], parts: Sequence[Float[np.ndarray, "_ 3"]] = ()
) -> ObjectShape:
    """Return the shape of a solid whose corners are known.

    Args:
        corners: corners of its convex hull, in the object's frame [m].
        centre: centre of mass [m].
        parts: corners of convex parts that together fill it; none if its hull is good enough.
    """
    return ObjectShape(
        half_extents=np.ptp(corners, axis=0) / 2,
        centre=centre,
        radius=float(np.linalg.norm(corners - centre, axis=1).max()),
        support=_support_map(corners - centre),
        parts=tuple(_support_map(part - centre) for part in parts),
    )


def _support_map(corners: Float[np.ndarray, "M 3"]) -> Float32[np.ndarray, "D 3"]:
    """Return the farthest corner in each direction of the octahedral map."""
    around = corners.astype(np.float32)
    return around[np.argmax(octahedral_directions(MAP_SIDE).astype(np.float32) @ around.T, axis=1)]


def _surface(density: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "n 3"]:
    """Return where the density crosses the threshold along the edges of the grid [voxels]; empty space surrounds it."""
    density = np.pad(density, 1, constant_values=float(density.min()))
    points = []
    for axis in range(3):
        along = np.moveaxis(density, axis, 0)
        low, high = along[:-1], along[1:]
        crossing = (low > SURFACE_G) != (high > SURFACE_G)
        place = np.argwhere(crossing).astype(float)
        place[:, 0] += (SURFACE_G - low[crossing]) / (high[crossing] - low[crossing])
        points.append(place[:, ((0, 1, 2), (1, 0, 2), (1, 2, 0))[axis]])
    return np.concatenate(points) - 1


def octahedral_directions(side: int) -> Float[np.ndarray, "D 3"]:
    """Return the unit vector of each cell of an octahedral map, the sphere unfolded into `side` x `side` cells."""
    u = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(u, u, indexing="ij")
    z = 1 - np.abs(x) - np.abs(y)
    x, y = (np.where(z < 0, (1 - np.abs(y)) * np.sign(x), x), np.where(z < 0, (1 - np.abs(x)) * np.sign(y), y))
    d = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def octahedral_index(directions: Float[Tensor, "*batch 3"], side: int) -> Tensor:
    """Return the cell of each direction, of any length but 0."""
    x, y, z = directions.unbind(-1)
    length = x.abs() + y.abs() + z.abs()
    x, y = x / length, y / length
    folded_x = torch.where(z < 0, torch.copysign(1 - y.abs(), x), x)
    folded_y = torch.where(z < 0, torch.copysign(1 - x.abs(), y), y)
    i = ((folded_x + 1) * (side / 2)).long().clamp(0, side - 1)
    j = ((folded_y + 1) * (side / 2)).long().clamp(0, side - 1)
    return i * side + j


class ShapeTable:
    """The shapes of some objects side by side, for lookups by number.

    Convex parts are bodies as well, numbered after all objects; an object without any is its own only part.

    Args:
        shapes: shapes of the objects, in the order of their numbers.
        device: that looks them up.
    """

    def __init__(self, shapes: tuple[ObjectShape, ...], device: torch.device | str = "cpu") -> None:
        bodies = [s.support for s in shapes] + [part for s in shapes for part in s.parts]
        counts = np.array([len(s.parts) for s in shapes])
        first = np.where(counts > 0, len(shapes) + counts.cumsum() - counts, np.arange(len(shapes)))
        self.support = torch.as_tensor(np.concatenate(bodies), device=device)
        self.first_part = torch.as_tensor(first, device=device)
        self.part_count = torch.as_tensor(counts.clip(1), device=device)
        self.centre = torch.as_tensor(np.array([s.centre for s in shapes]), device=device)
        self.radius = torch.as_tensor(np.array([s.radius for s in shapes]), dtype=torch.float32, device=device)
        extents = np.array([s.half_extents.max() for s in shapes])
        self.half_extent = torch.as_tensor(extents, dtype=torch.float32, device=device)

    def farthest(
        self, number: Tensor, rotation: Float[Tensor, "A 3 3"], directions: Float[Tensor, "... D 3"]
    ) -> Tensor:
        """Return the farthest points of A bodies in D directions, relative to their centres of mass (A, D, 3) [m].

        The points are those of the nearest direction on the map, 3.6 deg away at most: they reach 0.03 to 0.25 mm less
        far than the farthest ones (rms over all directions), and some millimetres less beside the normal of a face.

        Args:
            number: index of each body in the table.
            rotation: from each body's frame to the world.
            directions: directions of any length but 0, the same for all bodies or for each its own.
        """
        local = directions @ rotation  # R^T d for every d
        return self._support(number, local) @ rotation.transpose(1, 2)

    def extents(self, number: Tensor, rotation: Float[Tensor, "A 3 3"], directions: Float[Tensor, "... D 3"]) -> Tensor:
        """Return how far A bodies reach in D directions of the world from their centres of mass (A, D) [m].

        Args:
            number: index of each body in the table.
            rotation: from each body's frame to the world.
            directions: unit vectors, the same for all bodies or for each its own.
        """
        local = directions @ rotation
        reach = self._support(number, local) * local
        return reach[..., 0] + reach[..., 1] + reach[..., 2]

    def _support(self, number: Tensor, local: Float[Tensor, "A D 3"]) -> Float[Tensor, "A D 3"]:
        cell = octahedral_index(local, MAP_SIDE) + number[:, None] * MAP_SIDE**2
        return functional.embedding(cell, self.support)


# Convex parts of what is solid in a field, and the files that keep them.
#
# The hull of a drill or a mug does not show where it is touched. To cut a field into convex parts takes up to half a
# minute, so the parts are kept in a file that names its field.


FORMAT = "parts-1"
_INSIDE_G = 5.0  # deep inside, where no training says how dense it is
_SPECK = 0.02  # of the largest body: smaller ones are noise
_EDGE_G = 0.01  # by which corners are on their side of the surface at least

Parts = tuple[Float32[np.ndarray, "_ 3"], ...]


def field_parts(field: KiloOSF) -> Parts:
    """Return corners of convex parts that fill what is solid in a field [m]; none if it is as good as convex."""
    try:
        parts = convex_parts(*field_mesh(field))
    except InvalidInput:  # thinner than a voxel somewhere: its hull has to do
        return ()
    return parts if len(parts) > 1 else ()


def field_mesh(field: KiloOSF) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 3"]]:
    """Return the closed surface of what is solid in a field: vertices in the object's frame [m] and triangles.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    from skimage.measure import marching_cubes

    density = np.pad(field.density.astype(np.float32), 1, constant_values=EMPTY_G)
    # a thin neck may be lost in a field: bodies of some size stay, specks go
    labels, count = ndimage.label(ndimage.binary_fill_holes(density > SURFACE_G))  # pyright: ignore[reportGeneralTypeIssues]
    if not count:
        raise InvalidInput("field", "without any solid part", "a solid body")
    sizes = ndimage.sum_labels(labels > 0, labels, range(1, count + 1))
    solid = np.isin(labels, 1 + np.flatnonzero(sizes >= _SPECK * sizes.max()))
    density = np.where(solid, np.maximum(density, SURFACE_G + _EDGE_G), np.minimum(density, SURFACE_G - _EDGE_G))
    density[np.asarray(ndimage.binary_erosion(solid), bool)] = _INSIDE_G
    vertices, faces, _, _ = marching_cubes(density, SURFACE_G, gradient_direction="ascent")
    return field.origin + field.voxel * (vertices.astype(float) - 1), faces


def write_parts(path: Path, parts: Parts, field_digest: str) -> None:
    """Write the parts of a field.

    Args:
        path: path of the file.
        parts: corners of each part, in the object's frame [m].
        field_digest: digest of the field's file; `read_parts` refuses the parts of another.

    Raises:
        CannotWrite: if the disk refuses.
    """
    tensors = {str(number): np.ascontiguousarray(part, np.float32) for number, part in enumerate(parts)}
    write_atomically(path, save(tensors, {"format": FORMAT, "field": field_digest}))


def read_parts(path: Path, field_digest: str) -> Parts | None:
    """Return the parts of a field; None if the file is missing, broken or of another field: they can be made again."""
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT or metadata.get("field") != field_digest:
                return None
            known = set(file.keys())
            names = itertools.takewhile(known.__contains__, map(str, itertools.count()))
            parts = tuple(file.get_tensor(name) for name in names)
    except (SafetensorError, OSError, ValueError):
        return None
    is_sound = all(p.ndim == 2 and p.shape[1] == 3 and len(p) > 0 and np.isfinite(p).all() for p in parts)
    return parts if is_sound else None


# Where objects touch: outlines of their convex parts against the pusher and against each other.
#
# Seen from above, an object touches with whichever of its convex parts is nearest; most objects are one part. What
# is wholly above the pusher's top cannot meet it, nor can parts meet that lie one well above the other.


OUTLINE = 64  # corners of an outline
TOUCH_M = 0.008  # a substep's sweep is sampled at three points: nothing nearer than this is missed
PAIR_REACH_M = 0.025  # objects closer than this may touch within a substep
PAIR_STRIDE = 2  # pairs are compared with every second corner
PUSHER_TOP_M = PUSHER_CENTRE_Z_M + PUSHER_HEIGHT_M / 2
CLEAR_M = 0.02  # parts this far above others are not met within a substep
FAR_M = 1.0  # distance that stands for never
SLACK_M = 0.006  # by how much the bound of the nearest parts may exceed that of others


class Solids(NamedTuple):
    """The R convex parts of A objects, those of each side by side.

    Attributes:
        owner: object of each part.
        first: number of each object's first part.
        many: how many parts each object has.
        outline: seen from above [m].
        low, high: heights of the lowest and the highest point [m].
    """

    owner: Int[Tensor, "R"]
    first: Int[Tensor, "A"]
    many: Int[Tensor, "A"]
    outline: Float[Tensor, "R K 2"]
    low: Float[Tensor, "R"]
    high: Float[Tensor, "R"]


class PusherContact(NamedTuple):
    """Gaps between A objects and the pusher's rim, if nothing moved.

    Attributes:
        before, halfway, after: at the pusher's start, halfway and at its end.
        face: both ends of the side that faces the pusher at its start [m].
    """

    before: Gap
    halfway: Gap
    after: Gap
    face: Float[Tensor, "A 2 2"]


class PairContact(NamedTuple):
    """Gaps between E pairs of objects.

    Attributes:
        gap: out of the first one.
        first_face, second_face: both ends of the sides that face each other [m].
    """

    gap: Gap
    first_face: Float[Tensor, "E 2 2"]
    second_face: Float[Tensor, "E 2 2"]


def outlines(
    table: ShapeTable, body: Int[Tensor, "A"], rotation: Float[Tensor, "A 3 3"], centre: Float[Tensor, "A 3"]
) -> Float[Tensor, "A K 2"]:
    """Return outlines of bodies seen from above [m], in the frame of `centre`.

    Args:
        table: shapes.
        body: rows of the table: whole objects or convex parts.
        rotation: rotation of each body.
        centre: centre of mass of each body's object [m].
    """
    flat = functional.pad(circle(OUTLINE, centre.device), (0, 1))
    return table.farthest(body, rotation, flat)[..., :2] + centre[:, None, :2]


def part_outlines(table: ShapeTable, number: int, pose: Pose) -> Float[np.ndarray, "R K 2"]:
    """Return outlines of one object's convex parts, seen from above in the world [m].

    Args:
        table: shapes, on the CPU.
        number: which of them the object is.
        pose: T_world_object.
    """
    body = table.first_part[number] + torch.arange(int(table.part_count[number]))
    rotation = torch.as_tensor(quaternion_to_matrix(pose.quaternion), dtype=torch.float32)
    centre = torch.as_tensor(pose.apply(table.centre[number].numpy()), dtype=torch.float32)
    return outlines(table, body, rotation.expand(len(body), 3, 3), centre.expand(len(body), 3)).numpy()


def solids(
    table: ShapeTable,
    number: Int[Tensor, "A"],
    rotation: Float[Tensor, "A 3 3"],
    centre: Float[Tensor, "A 3"],
    outline: Float[Tensor, "A K 2"],
) -> Solids:
    """Return all convex parts of some objects.

    Args:
        table: shapes.
        number: shape of each object.
        rotation: rotation of each object.
        centre: centre of mass [m].
        outline: outline of the whole objects, which serves those of one part [m].
    """
    count = table.part_count[number]
    first = count.cumsum(0) - count
    owner = torch.arange(len(number), device=number.device).repeat_interleave(count)
    body = table.first_part[number][owner] + torch.arange(len(owner), device=number.device) - first[owner]
    shown = outline[owner]
    rows = (count[owner] > 1).nonzero()[:, 0]
    if len(rows):
        parts = owner[rows]
        shown = shown.index_put((rows,), outlines(table, body[rows], rotation[parts], centre[parts]))
    vertical = centre.new_tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    reach = table.extents(body, rotation[owner], vertical)
    height = centre[owner, 2]
    return Solids(owner, first, count, shown, height - reach[:, 0], height + reach[:, 1])


def pusher_contact(parts: Solids, shift: Float[Tensor, "A 2"]) -> PusherContact:
    """Return the gaps between a pusher that starts at the origin and the nearest part of each object."""
    own = shift[parts.owner]
    halfway = _rim_gap(parts.outline, 0.5 * own)
    halfway = halfway._replace(distance=torch.where(parts.low < PUSHER_TOP_M, halfway.distance, FAR_M))
    # where the pusher does not come near halfway, neither end does: the gap halfway stands for both
    rows = (halfway.distance - 0.5 * own.norm(dim=1) < TOUCH_M).nonzero()[:, 0]
    before, after = (
        _with_rows(halfway, rows, _rim_gap(parts.outline[rows], (share * own)[rows])) for share in (0.0, 1.0)
    )
    nearest = [_nearest(parts.owner, gap.distance, len(shift)) for gap in (before, halfway, after)]
    gaps = [_rows(gap, rows) for gap, rows in zip((before, halfway, after), nearest, strict=True)]
    return PusherContact(*gaps, face=_face(parts.outline[nearest[0]], gaps[0].normal))


def _rim_gap(outline: Float[Tensor, "A K 2"], centre: Float[Tensor, "A 2"]) -> Gap:
    """Return the gaps from outlines to the pusher's rim."""
    gap = gap_to_point(outline, centre)
    return gap._replace(distance=gap.distance - PUSHER_RADIUS_M)


def pair_contact(
    parts: Solids, outline: Float[Tensor, "A K 2"], first: Int[Tensor, "E"], second: Int[Tensor, "E"]
) -> PairContact:
    """Return the gaps between the nearest parts of pairs of objects.

    Args:
        parts: parts of all objects.
        outline: outline of the whole objects [m].
        first: object of each pair.
        second: the other one.
    """
    gap = gap_between(*(outline[place, ::PAIR_STRIDE] for place in (first, second)))
    a, b = parts.first[first], parts.first[second]
    many = ((parts.many[first] * parts.many[second] > 1) & (gap.distance < PAIR_REACH_M)).nonzero()[:, 0]
    if len(many):
        left, right, nearest = _nearest_parts(parts, first[many], second[many])
        gap = _with_rows(gap, many, nearest)
        a, b = a.index_put((many,), left), b.index_put((many,), right)
    return PairContact(gap, _face(parts.outline[a], gap.normal), _face(parts.outline[b], -gap.normal))


def _nearest_parts(parts: Solids, first: Int[Tensor, "E"], second: Int[Tensor, "E"]) -> tuple[Tensor, Tensor, Gap]:
    """Return the two nearest among all parts of one object and all of another, and their gap."""
    width = parts.many[second]
    total = parts.many[first] * width
    pair = torch.arange(len(first), device=first.device).repeat_interleave(total)
    local = torch.arange(len(pair), device=first.device) - (total.cumsum(0) - total)[pair]
    a = parts.first[first][pair] + local // width[pair]
    b = parts.first[second][pair] + local % width[pair]
    bound = _separation_bound(parts, a, b)
    least = bound.new_full((len(first),), torch.inf).scatter_reduce(0, pair, bound, "amin")
    close = (bound <= least[pair] + SLACK_M).nonzero()[:, 0]
    a, b, pair = a[close], b[close], pair[close]
    gap = gap_between(*(parts.outline[place, ::PAIR_STRIDE] for place in (a, b)))
    gap = gap._replace(distance=torch.where(bound[close] < FAR_M, gap.distance, FAR_M))
    best = _nearest(pair, gap.distance, len(first))
    return a[best], b[best], _rows(gap, best)


def _separation_bound(parts: Solids, a: Int[Tensor, "R"], b: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
    """Return the largest separation of two parts along the directions of outlines [m]; `FAR_M` if one is well above.

    It is a few millimetres less than their distance at most. Only pairs that it does not rule out are compared exactly,
    for two hollow objects side by side have hundreds.
    """
    count = parts.outline.shape[1]
    reach = dot(parts.outline, circle(count, parts.outline.device))
    bound = -(reach[a] + reach.roll(count // 2, dims=1)[b]).amin(dim=1)
    apart = torch.maximum(parts.low[a] - parts.high[b], parts.low[b] - parts.high[a]) > CLEAR_M
    return torch.where(apart, FAR_M, bound)


def _nearest(owner: Int[Tensor, "R"], distance: Float[Tensor, "R"], count: int) -> Int[Tensor, "A"]:
    """Return the number of the nearest row of each of `count` owners, the first one where several are."""
    rows = torch.arange(len(owner), device=owner.device)
    if len(owner) == count:
        return rows
    least = distance.new_full((count,), torch.inf).scatter_reduce(0, owner, distance.detach(), "amin")
    candidate = torch.where(distance > least[owner], len(owner) - 1, rows)
    return rows.new_full((count,), len(owner) - 1).scatter_reduce(0, owner, candidate, "amin")


def _rows(gap: Gap, rows: Int[Tensor, "E"]) -> Gap:
    return Gap(*(part[rows] for part in gap))


def _with_rows(gap: Gap, rows: Int[Tensor, "E"], new: Gap) -> Gap:
    return Gap(*(part.index_put((rows,), other) for part, other in zip(gap, new, strict=True)))


def _face(outline: Float[Tensor, "A K 2"], normal: Float[Tensor, "A 2"]) -> Float[Tensor, "A 2 2"]:
    """Return both ends of the side of an outline that faces a direction; a corner gives about the same point twice."""
    count = outline.shape[1]
    middle = direction_index(normal, count)
    rows = torch.arange(len(outline), device=outline.device)
    return torch.stack([outline[rows, (middle + step) % count] for step in (-1, 1)], dim=1)
