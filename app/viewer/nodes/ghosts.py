"""Translucent copies of objects: coarse meshes, places on a way, and shapes that say how sure a pose is."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import viser
from jaxtyping import Float, Float32, Int

from osfcore.errors import OsfError
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.objects.asset_library import AssetLibrary

from .room import NO_TURN, Colour

CELLS, FINE_CELLS = 14, 28  # along the longest side of an object; a coarse ghost has some hundred triangles
PREDICTED, TRUE = (190, 50, 210), (25, 25, 25)  # neither is a colour of estimates
UNKNOWN_M = 0.05  # the side of the cube for an object without a mesh
_ARC_STEPS = 24
_PUSHER_OPACITY = 0.35
_RIM_M = 0.002  # of a ghost around what stands in its place
_VESSEL = 0.4  # a mesh that fills less than this share of its hull is a vessel
_ARM_M = 0.05  # what turning by 1 rad counts on a way
MOVED_M, _TURNED_RAD = 3e-3, 0.05  # what moves and turns less does not do so to the eye
_log = logging.getLogger(__name__)
Mesh = tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 3"]]


def coarse(vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], cells: int = CELLS) -> Mesh:
    """Draw together all vertices of one cell of a grid; triangles that vanish are left out.

    Args:
        vertices: of the mesh [m].
        faces: vertex indices.
        cells: of the grid along the longest side.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cell_m = max(float((high - low).max()) / cells, 1e-9)
    keys = np.minimum((vertices - low) / cell_m, cells - 1e-6).astype(np.int64)
    _, own = np.unique(keys, axis=0, return_inverse=True)
    own = own.reshape(-1)
    count = np.bincount(own)
    merged = np.stack([np.bincount(own, vertices[:, axis]) / count for axis in range(3)], axis=1)
    corners = own[faces]
    kept = corners[(np.diff(np.sort(corners, axis=1), axis=1) > 0).all(axis=1)]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return merged.astype(np.float32), kept[np.sort(first)].astype(np.uint32)


def size_m(library: AssetLibrary, name: str) -> Float[np.ndarray, "3"]:
    """Return the size of an object [m]; that of a cube for one that was removed since."""
    try:
        return library.size_m(name)
    except OsfError:
        return np.full(3, UNKNOWN_M)


def mesh_of(library: AssetLibrary, name: str, cells: int = CELLS) -> Mesh:
    """Load the coarse mesh of an object.

    What is recognised by its field needs no mesh on this machine, and what is on a table may have been removed since:
    such an object is a cube.

    Args:
        library: meshes of the objects.
        name: of the object.
        cells: along its longest side.
    """
    try:
        mesh = library.load_geometry(name)
    except OsfError as error:
        _log.info("%s is drawn as a cube: %s", name, error)
        return box(UNKNOWN_M)
    return coarse(mesh.vertices, mesh.faces, cells)


def shell(mesh: Mesh, by_m: float) -> Mesh:
    """Move the surface of a mesh outward.

    Of a shell only the far side is drawn: around a thing that stands in it a rim shows, and where nothing stands, all.

    Args:
        mesh: vertices [m] and faces.
        by_m: how far [m].
    """
    vertices, faces = _without_inside(mesh)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))  # larger faces count more
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return vertices + np.float32(by_m) * normals, faces


def _without_inside(mesh: Mesh) -> Mesh:
    """Replace a vessel by its convex hull: both sides of its walls would lie in the same cells."""
    import trimesh  # which the page's start need not wait for

    solid = trimesh.Trimesh(*mesh, process=False)
    hull = solid.convex_hull
    if solid.volume > _VESSEL * hull.volume:
        return mesh
    return hull.vertices.astype(np.float32), hull.faces.astype(np.uint32)


def add_ghosts(
    scene: viser.SceneApi,
    path: str,
    mesh: Mesh,
    count: int,
    colour: Colour,
    opacity: float,
    *,
    scale: float = 1.0,
    shares: Float[np.ndarray, "N"] | None = None,
    is_wire: bool = False,
    side: Literal["front", "back"] = "front",
) -> viser.BatchedMeshHandle:
    """Add a hidden node with translucent copies of a mesh, which cast no shadows and have no place yet.

    Args:
        scene: to draw in.
        path: of the node.
        mesh: vertices [m] and faces.
        count: of the copies.
        colour: of the copies, taken for linear light.
        opacity: of the copies.
        scale: of the mesh; copies as large as the surfaces below them would flicker.
        shares: of the opacity that each copy has; None is all of it.
        is_wire: whether edges are drawn in place of faces.
        side: of the faces that is drawn; of wires both are.
    """
    return scene.add_batched_meshes_simple(
        path,
        *mesh,
        np.tile(NO_TURN, (count, 1)).astype(np.float32),
        np.tile([0.0, 0.0, -1.0], (count, 1)).astype(np.float32),
        batched_scales=np.full(count, scale),
        batched_colors=colour,
        batched_opacities=shares,
        opacity=opacity,
        wireframe=is_wire,
        side="double" if is_wire else side,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
        visible=False,
    )


def move_ghosts(node: viser.BatchedMeshHandle, poses: Pose) -> None:
    """Move the copies of a node to a batch of poses (N,)."""
    node.batched_positions = poses.position.astype(np.float32)
    node.batched_wxyzs = poses.quaternion.astype(np.float32)


def box(side_m: float) -> Mesh:
    """Make a cube around the origin."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) * side_m / 2
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
             (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    return corners, np.array(faces, np.uint32)


def sector(heading_rad: float, half_rad: float, inner_m: float, outer_m: float) -> Mesh:
    """Make a flat piece of a ring around the origin, seen from above: headings from -half to +half about one.

    Args:
        heading_rad: of its middle, from +x toward +y.
        half_rad: half its opening.
        inner_m: where it begins.
        outer_m: where it ends.
    """
    angles = heading_rad + np.linspace(-half_rad, half_rad, _ARC_STEPS + 1)
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    vertices = np.concatenate([inner_m * rim, outer_m * rim]).astype(np.float32)
    a = np.arange(_ARC_STEPS)
    b = a + _ARC_STEPS + 1
    faces = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
    return vertices, faces.astype(np.uint32)


def spread(poses: Pose, count: int) -> Pose:
    """Choose `count` of a batch of poses evenly; some more than once if there are fewer."""
    rows = np.round(np.linspace(0, len(poses.position) - 1, count)).astype(int)
    return poses[rows]


def moves(poses: Pose) -> bool:
    """Check whether an object on its way goes or turns far enough to be seen."""
    shift = np.abs(poses.position - poses.position[0]).max()
    turn_rad = rotation_angle(poses.quaternion, poses.quaternion[0]).max()
    return bool(shift > MOVED_M or turn_rad > _TURNED_RAD)


def way_of(rollouts: Rollouts, number: int) -> Pose:
    """Take the poses of an object in the first of some rollouts, one after each action."""
    return Pose(rollouts.positions[0, :, number], rollouts.quaternions[0, :, number])


def segments(lines: Iterable[Float[np.ndarray, "_ 3"]]) -> Float32[np.ndarray, "S 2 3"]:
    """Cut one or more lines through points into pieces from point to point, as viser draws them."""
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines]).astype(np.float32)


def between(rows: Float[np.ndarray, "T C"], step: float) -> Float[np.ndarray, "C"]:
    """Interpolate between two rows; the first and the last one reach beyond the ends."""
    step = min(max(step, 0.0), len(rows) - 1.0)
    before = int(step)
    after = min(before + 1, len(rows) - 1)
    return rows[before] + (step - before) * (rows[after] - rows[before])


def along_way(poses: Pose, count: int) -> list[int]:
    """Choose rows that lie about evenly along a way, not in time: most futures begin with a gap.

    Args:
        poses: on the way, a batch (T,).
        count: of rows; some may be equal.
    """
    shifts = np.linalg.norm(np.diff(poses.position, axis=0), axis=1)
    turns = rotation_angle(poses.quaternion[:-1], poses.quaternion[1:])
    gone = np.cumsum(shifts + _ARM_M * turns)
    rows = np.searchsorted(gone, gone[-1] * np.arange(1, count + 1) / (count + 1))
    return [min(int(row) + 1, len(gone)) for row in rows]


def pose_at(poses: Pose, step: float) -> Pose:
    """Compute where something is on its way after some steps, which turn it by less than half a turn each."""
    signs = np.where(np.sum(poses.quaternion[1:] * poses.quaternion[:-1], axis=1) < 0, -1.0, 1.0)
    aligned = poses.quaternion * np.cumprod(np.concatenate([[1.0], signs]))[:, None]
    turn = between(aligned, step)
    return Pose(between(poses.position, step), turn / np.linalg.norm(turn))


def top_m(vertices: Float[np.ndarray, "P 3"], quaternion: Float[np.ndarray, "4"]) -> float:
    """Compute how far a turned mesh reaches above its origin [m]."""
    return float(rotate(quaternion, vertices)[:, 2].max())


def footprint_m(vertices: Float[np.ndarray, "P 3"], quaternion: Float[np.ndarray, "4"]) -> float:
    """Compute how far a turned mesh reaches sideways from its origin [m]."""
    return float(np.linalg.norm(rotate(quaternion, vertices)[:, :2], axis=1).max())


def heading_rad(quaternion: Float[np.ndarray, "4"]) -> float:
    """Compute where that axis of an object points, seen from above, that lies flattest; from +x toward +y."""
    axes = rotate(quaternion, np.eye(3))
    x, y, _ = axes[int(np.abs(axes[:, 2]).argmin())]
    return float(np.arctan2(y, x))


# Predicted futures


@dataclass(frozen=True, slots=True)
class FutureStyle:
    """How the ghosts of a future look.

    Attributes:
        colour: of all.
        opacity: of the one that goes along.
        on_the_way: how many pale ones there are between now and the end.
        pale: share of the opacity that these have.
        has_end: whether one stands at the end all the time.
    """

    colour: Colour
    opacity: float = 0.45
    on_the_way: int = 3
    pale: float = 0.3
    has_end: bool = True


class FutureNodes:
    """One future of the objects that move in it: ghosts on the way, at its end, and moving with the pusher.

    Args:
        scene: to draw in.
        library: meshes of the objects.
        root: of its nodes.
        style: how the ghosts look.
    """

    def __init__(self, scene: viser.SceneApi, library: AssetLibrary, root: str, style: FutureStyle) -> None:
        self._scene = scene
        self._library = library
        self._root, self._style = root, style
        self._future: Rollouts | None = None
        self._ghosts: dict[str, viser.BatchedMeshHandle] = {}
        self._pusher = scene.add_cylinder(
            f"{root}/pusher",
            radius=PUSHER_RADIUS_M + _RIM_M,
            height=PUSHER_HEIGHT_M,
            color=PREDICTED,
            opacity=_PUSHER_OPACITY,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )

    @property
    def steps(self) -> int:
        """Actions until its end; 0 while none is shown."""
        return 0 if self._future is None else len(self._future.pusher[0]) - 1

    def show(self, future: Rollouts | None) -> None:
        """Show the first of some rollouts, from its beginning, in place of the one before."""
        self._future = future
        self._pusher.visible = future is not None
        if future is None:
            for node in self._ghosts.values():
                node.visible = False
            return
        if set(future.names) != set(self._ghosts):
            for node in self._ghosts.values():
                node.remove()
            self._ghosts = {name: self._add_ghosts(name) for name in future.names}
        for n, name in enumerate(future.names):
            self._ghosts[name].visible = moves(way_of(future, n))
        self.at(0.0)

    def at(self, step: float) -> None:
        """Move the ghosts that go along to where things are after some actions; in between, halfway."""
        future = self._future
        if future is None:
            return
        for n, name in enumerate(future.names):
            if self._ghosts[name].visible:
                poses = way_of(future, n)
                still = poses[[*along_way(poses, self._style.on_the_way), *[-1] * self._style.has_end]]
                move_ghosts(self._ghosts[name], Pose.joined(still, pose_at(poses, step)[None]))
        self._pusher.position = between(future.pusher[0], step)

    def _add_ghosts(self, name: str) -> viser.BatchedMeshHandle:
        style = self._style
        shares = np.array([*[style.pale] * style.on_the_way, *[1.0] * style.has_end, 1.0])
        mesh, path = shell(mesh_of(self._library, name, FINE_CELLS), _RIM_M), f"{self._root}/{name}"
        return add_ghosts(self._scene, path, mesh, len(shares), style.colour, style.opacity, shares=shares, side="back")
