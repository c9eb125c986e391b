"""The nodes that show a prediction: ghosts that move with time, a trail of paler ones, and the ways things go."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float

from app.viewer.nodes.atomic import atomic
from app.viewer.nodes.ghosts import Mesh, add_ghosts, between, mesh_of, move_ghosts, moves, pose_at, top_m, way_of
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.objects.asset_library import AssetLibrary

PREDICTED, TRUE = (190, 50, 210), (25, 25, 25)  # neither is a colour of estimates
TRAIL = 5  # pale ghosts between start and end
_CELLS = 28
_GHOST_OPACITY, _TRAIL_OPACITY, _PUSHER_OPACITY = 0.5, 0.13, 0.35
_GHOST_SCALE, _TRAIL_SCALE = 1.01, 1.005  # or ghosts and the surface below them would flicker
_ABOVE_M = 0.012  # ways of objects are drawn above them, that of the pusher above the table
_FLOOR_M = 0.004
_LINE_M = 0.004
_MOVED_M = 5e-4
_NOWHERE = np.zeros((1, 2, 3), np.float32)


class PushNodes:
    """Nodes below /push. Any thread may call.

    Args:
        server: to draw in.
        library: meshes of the objects.
    """

    def __init__(self, server: viser.ViserServer, library: AssetLibrary) -> None:
        self._server = server
        self._scene = server.scene
        self._library = library
        self._lock = threading.RLock()
        self._meshes: dict[str, Mesh] = {}
        self._rollouts: Rollouts | None = None
        self._step = 0.0
        self._ghosts: dict[str, viser.BatchedMeshHandle] = {}
        self._trails: list[viser.SceneNodeHandle] = []
        self._heights_m: dict[str, float] = {}
        add = self._scene.add_line_segments
        self._plan = add("/push/plan", _NOWHERE, PREDICTED, thickness=0.006, visible=False)
        self._ways = add("/push/ways", _NOWHERE, PREDICTED, thickness=_LINE_M, visible=False)
        self._true_ways = add("/push/true_ways", _NOWHERE, TRUE, thickness=_LINE_M, visible=False)
        self._pusher = pusher_ghost(self._scene, "/push/pusher")

    @property
    def moving(self) -> tuple[str, ...]:
        """Objects that are predicted to move."""
        return tuple(self._ghosts)

    def plan(self, places: Float[np.ndarray, "P 2"] | None) -> None:
        """Show the way of the pusher on the table [m], or none."""
        with self._lock:
            lines = [] if places is None else [np.column_stack([places, np.full(len(places), _FLOOR_M)])]
            _draw(self._plan, lines)

    def show(self, rollouts: Rollouts) -> None:
        """Show the first of some rollouts in place of the one before, at its end."""
        with self._lock, atomic(self._server):
            self._remove()
            self._rollouts = rollouts
            lines = []
            for n, name in enumerate(rollouts.names):
                poses = way_of(rollouts, n)
                if moves(poses):
                    lines.append(self._add_object(name, poses))
            _draw(self._ways, lines)
            self._pusher.visible = True
            self._at(len(rollouts.pusher[0]) - 1.0)

    def at(self, step: float) -> None:
        """Move the ghosts to where things are after some actions; in between, halfway."""
        with self._lock:
            if step != self._step:
                with atomic(self._server):
                    self._at(step)

    def show_truth(self, states: Sequence[SceneState]) -> None:
        """Show the ways that predicted objects, and others that moved, went in the simulation."""
        with self._lock, atomic(self._server):
            lines = []
            for name in states[0].names if states else ():
                poses = Pose(
                    np.array([state.pose(name).position for state in states]),
                    np.array([state.pose(name).quaternion for state in states]),
                )
                if moves(poses):
                    lines.append(self._way(name, poses))
            _draw(self._true_ways, lines)

    def clear(self) -> None:
        """Remove the prediction and the truth beside it; the plan stays."""
        with self._lock, atomic(self._server):
            self._remove()
            self._pusher.visible = self._ways.visible = self._true_ways.visible = False

    def _remove(self) -> None:
        for node in (*self._ghosts.values(), *self._trails):
            node.remove()
        self._rollouts, self._ghosts, self._trails, self._heights_m = None, {}, [], {}
        self._true_ways.visible = False

    def _add_object(self, name: str, poses: Pose) -> np.ndarray:
        """Ghost and trail of an object; returns the line of its way (T, 3) [m]."""
        mesh = self._mesh(name)
        rows = _spaced(poses, TRAIL)
        if len(rows):
            self._trails.append(self._copies(f"/push/trail/{name}", mesh, poses[rows], _TRAIL_OPACITY, _TRAIL_SCALE))
        self._ghosts[name] = self._copies(f"/push/ghost/{name}", mesh, poses[-1:], _GHOST_OPACITY, _GHOST_SCALE)
        return self._way(name, poses)

    def _copies(self, path: str, mesh: Mesh, poses: Pose, opacity: float, scale: float) -> viser.BatchedMeshHandle:
        scales = np.full(len(poses.position), scale)
        return add_ghosts(
            self._scene, path, mesh, poses, batched_scales=scales, batched_colors=PREDICTED, opacity=opacity
        )

    def _at(self, step: float) -> None:
        if self._rollouts is None:
            return
        self._step = step
        for name, node in self._ghosts.items():
            pose = pose_at(way_of(self._rollouts, self._rollouts.names.index(name)), step)
            move_ghosts(node, Pose(pose.position[None], pose.quaternion[None]))
        self._pusher.position = between(self._rollouts.pusher[0], step)

    def _way(self, name: str, poses: Pose) -> np.ndarray:
        """The way of an object's centre, as high as the object was at the start, so that it stays in view."""
        if name not in self._heights_m:
            self._heights_m[name] = top_m(self._mesh(name)[0], poses.quaternion[0]) + _ABOVE_M
        return poses.position + np.array([0.0, 0.0, self._heights_m[name]])

    def _mesh(self, name: str) -> Mesh:
        if not self._library.has(name):  # removed since the scene was made, and may come back
            return mesh_of(self._library, name)
        if name not in self._meshes:
            self._meshes[name] = mesh_of(self._library, name, _CELLS)
        return self._meshes[name]


def pusher_ghost(scene: viser.SceneApi, path: str) -> viser.CylinderHandle:
    """A ghost of the pusher, hidden until it has somewhere to be."""
    return scene.add_cylinder(
        path,
        radius=PUSHER_RADIUS_M * _GHOST_SCALE,
        height=PUSHER_HEIGHT_M,
        color=PREDICTED,
        opacity=_PUSHER_OPACITY,
        cast_shadow=False,
        receive_shadow=False,
        visible=False,
    )


def _spaced(poses: Pose, count: int) -> np.ndarray:
    """Rows between start and end that lie about evenly along the way, not in time: most pushes begin with a gap."""
    gone = np.cumsum(np.linalg.norm(np.diff(poses.position, axis=0), axis=1))
    rows = 1 + np.searchsorted(gone, gone[-1] * np.arange(1, count + 1) / (count + 1))
    return np.unique(rows[(rows < len(gone)) & (gone[-1] > _MOVED_M)])


def _draw(node: viser.LineSegmentsHandle, lines: Sequence[np.ndarray]) -> None:
    """Put lines through points (P, 3) into one node; without lines it is hidden."""
    parts = [np.stack([line[:-1], line[1:]], axis=1) for line in lines if len(line) > 1]
    if parts:
        points = np.concatenate(parts).astype(np.float32)
        if not np.array_equal(node.points, points):
            node.points = points
    if node.visible != bool(parts):
        node.visible = bool(parts)
