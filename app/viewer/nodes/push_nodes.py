"""The nodes of pushes: handles for the way of the pusher, and a prediction with the ways that things go."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

import numpy as np
import viser
from jaxtyping import Float

from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.objects.asset_library import AssetLibrary

from .ghosts import FINE_CELLS, PREDICTED, TRUE, FutureNodes, FutureStyle, mesh_of, moves, segments, top_m, way_of
from .room import NO_LINES, atomic

TRAIL = 5  # pale ghosts between start and end
_STYLE = FutureStyle(PREDICTED, opacity=0.5, on_the_way=TRAIL, pale=0.26, has_end=False)
_ABOVE_M = 0.012  # ways of objects are drawn above them, that of the pusher above the table
_FLOOR_M = 0.004
_LINE_M = 0.004


class PushNodes:
    """A prediction: ghosts that move with time, a trail of paler ones, and the ways things go. Any thread may call.

    Args:
        server: to draw in, below /push.
        library: meshes of the objects.
    """

    def __init__(self, server: viser.ViserServer, library: AssetLibrary) -> None:
        self._server = server
        self._library = library
        self._lock = threading.RLock()
        self._step = 0.0
        self._vertices: dict[str, np.ndarray] = {}  # of what is on view; objects may be removed, and come back
        self._future = FutureNodes(server.scene, library, "/push/future", _STYLE)
        add = server.scene.add_line_segments
        self._plan = add("/push/plan", NO_LINES, PREDICTED, thickness=0.006, visible=False)
        self._ways = add("/push/ways", NO_LINES, PREDICTED, thickness=_LINE_M, visible=False)
        self._true_ways = add("/push/true_ways", NO_LINES, TRUE, thickness=_LINE_M, visible=False)

    def plan(self, places: Float[np.ndarray, "P 2"] | None) -> None:
        """Show the way of the pusher on the table [m], or none."""
        with self._lock:
            lines = [] if places is None else [np.column_stack([places, np.full(len(places), _FLOOR_M)])]
            _draw(self._plan, lines)

    def show(self, rollouts: Rollouts) -> None:
        """Show the first of some rollouts in place of the one before, at its end."""
        with self._lock, atomic(self._server):
            self._true_ways.visible, self._vertices = False, {}
            self._future.show(rollouts)
            self._step = float(self._future.steps)
            self._future.at(self._step)
            self._draw_ways(self._ways, {name: way_of(rollouts, n) for n, name in enumerate(rollouts.names)})

    def at(self, step: float) -> None:
        """Move the ghosts to where things are after some actions; in between, halfway."""
        with self._lock:
            if step != self._step:
                self._step = step
                with atomic(self._server):
                    self._future.at(step)

    def show_truth(self, states: Sequence[SceneState]) -> None:
        """Show the ways that predicted objects, and others that moved, went in the simulation."""
        with self._lock, atomic(self._server):
            names = states[0].names if states else ()
            ways = {name: Pose.stacked(state.pose(name) for state in states) for name in names}
            self._draw_ways(self._true_ways, ways)

    def clear(self) -> None:
        """Remove the prediction and the truth beside it; the plan stays."""
        with self._lock, atomic(self._server):
            self._future.show(None)
            self._ways.visible = self._true_ways.visible = False

    def _draw_ways(self, node: viser.LineSegmentsHandle, ways: Mapping[str, Pose]) -> None:
        """Draw the ways of objects' centres, as high as they were at the start, so that they stay in view."""
        lines = []
        for name, poses in ways.items():
            if moves(poses):
                if name not in self._vertices:
                    self._vertices[name], _ = mesh_of(self._library, name, FINE_CELLS)
                height_m = top_m(self._vertices[name], poses.quaternion[0]) + _ABOVE_M
                lines.append(poses.position + np.array([0.0, 0.0, height_m]))
        _draw(node, lines)


def _draw(node: viser.LineSegmentsHandle, lines: Sequence[np.ndarray]) -> None:
    """Put lines through points (P, 3) into one node; without lines it is hidden."""
    if lines:
        node.points = segments(lines)
    node.visible = bool(lines)
