"""The nodes that show an episode in the 3D view: the goal, the estimate, the plan and the future that it predicts."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

import numpy as np
import viser
from jaxtyping import Float, UInt8

from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.planning.mppi import PlanSketch

from .estimate_nodes import EstimateNodes
from .ghosts import FINE_CELLS, PREDICTED, FutureNodes, FutureStyle, mesh_of, segments, shell
from .room import GAMMA, NO_LINES, Colour, Target, atomic, colour_of

GOAL = (245, 140, 0)
CHEAP, DEAR = (45, 215, 90), (150, 62, 58)
GOAL_OPACITY = 0.6
PLAY_S, REST_S = 2.0, 0.7  # how long the best future is played, and stands at its end
_RIM_M = 0.004  # of gold around what stands in its place
_WAY_M, _BEST_M = 0.0025, 0.007  # thickness
_DEAREST_Z_M, _CHEAPEST_Z_M, _BEST_Z_M = 0.003, 0.006, 0.008  # cheap ways lie above dear ones


class EpisodeNodes:
    """Nodes below one of their own. Any thread may call.

    Args:
        server: to draw in.
        library: meshes of the objects.
        root: below which everything is drawn.
    """

    def __init__(self, server: Target, library: AssetLibrary, *, root: str = "/episode") -> None:
        self._root = root
        self._server = server
        self._scene = server.scene
        self._library = library
        self._lock = threading.RLock()
        self._now = EstimateNodes(server, library, root=f"{root}/estimate")
        self._goal_look = EstimateNodes(
            server, library, root=f"{root}/goal/look", colour=_linear(GOAL), has_light=False
        )
        self._goal: dict[str, viser.MeshHandle] = {}
        self._future = FutureNodes(server.scene, library, f"{root}/plan/future", FutureStyle(_linear(PREDICTED)))
        add = self._scene.add_line_segments
        # Lines that begin in one colour for all would stay white once each has its own.
        each = np.array([[_linear(CHEAP)] * 2], np.uint8)
        self._ways = add(f"{root}/plan/ways", NO_LINES, each, thickness=_WAY_M, visible=False)
        self._best = add(f"{root}/plan/best", NO_LINES, PREDICTED, thickness=_BEST_M, visible=False)

    def show_goal(self, poses: Mapping[str, Pose]) -> None:
        """Show where objects should be in place of the former goal; of none, nothing."""
        with self._lock, atomic(self._server):
            if set(poses) != set(self._goal):
                for node in self._goal.values():
                    node.remove()
                where = f"{self._root}/goal/where"
                self._goal = {name: add_copy(self._scene, f"{where}/{name}", self._library, name) for name in poses}
            for name, pose in poses.items():
                self._goal[name].position, self._goal[name].wxyz = pose.position, pose.quaternion
            self._goal_look.clear()

    def show_look(
        self,
        state: SceneState,
        candidates: Pose | None = None,
        lights: np.ndarray | None = None,
        estimate: EstimatedState | None = None,
        *,
        of_goal: bool = False,
    ) -> None:
        """Show an estimator at work, on the table or on the goal image; see `EstimateNodes.show`."""
        (self._goal_look if of_goal else self._now).show(state, candidates, lights, estimate)

    def show_estimate(self, state: SceneState | None, doubts: Sequence[str] = ()) -> None:
        """Show the estimated poses and light, or none.

        Args:
            state: the estimate.
            doubts: why each object is doubted, or "".
        """
        with self._lock, atomic(self._server):
            if state is None:
                self._now.clear()
            else:
                self._now.follow(state, doubts)
            self._goal_look.clear()

    def show_plan(self, sketch: PlanSketch | None) -> None:
        """Show a round of planning in place of the one before: ways of the pusher, and the best future."""
        with self._lock, atomic(self._server):
            self._future.show(None if sketch is None else sketch.best)
            self._ways.visible = self._best.visible = sketch is not None
            if sketch is not None:
                self._draw_ways(sketch)

    def play(self, seconds: float) -> None:
        """Let the best future be as it is some time after it began; over and over, faster than it would be."""
        self.play_to(min(seconds % (PLAY_S + REST_S) / PLAY_S, 1.0))

    def play_to(self, share: float) -> None:
        """Let the best future be as it is after a share of its time."""
        with self._lock:
            if self._future.steps:
                with atomic(self._server):
                    self._future.at(self._future.steps * share)

    def clear(self) -> None:
        """Remove everything."""
        with self._lock, atomic(self._server):
            self.show_goal({})
            self.show_estimate(None)
            self.show_plan(None)

    def _draw_ways(self, sketch: PlanSketch) -> None:
        count, moments, _ = sketch.ways.shape
        heights = np.linspace(_CHEAPEST_Z_M, _DEAREST_Z_M, count)  # or lines that cross would flicker
        points = np.concatenate([sketch.ways, np.tile(heights[:, None, None], (1, moments, 1))], axis=2)
        colours = np.repeat(cost_colours(sketch.costs), moments - 1, axis=0)  # one for each segment
        self._ways.points = segments(points)
        self._ways.colors = np.repeat(colours[:, None], 2, axis=1)
        best = sketch.best.pusher[:1].copy()
        best[..., 2] = _BEST_Z_M
        self._best.points = segments(best)


def add_copy(scene: viser.SceneApi, path: str, library: AssetLibrary, name: str) -> viser.MeshHandle:
    """Add a golden shell of an object, which shows where it should be and leaves what stands there as it is."""
    return scene.add_mesh_simple(
        path,
        *shell(mesh_of(library, name, FINE_CELLS), _RIM_M),
        color=GOAL,
        opacity=GOAL_OPACITY,
        side="back",
        cast_shadow=False,
        receive_shadow=False,
    )


def cost_colours(costs: Float[np.ndarray, "W"]) -> UInt8[np.ndarray, "W 3"]:
    """Colour lines by cost: the cheapest bright green, those of twice the median's surplus dim red.

    The dearest would be no measure: a single sequence that goes badly wrong would paint all others green.
    """
    surplus = costs - costs.min()
    share = np.clip(surplus / max(2 * float(np.median(surplus)), 1e-9), 0, 1)[:, None]
    return np.round((1 - share) * np.array(_linear(CHEAP)) + share * np.array(_linear(DEAR))).astype(np.uint8)


def _linear(colour: Colour) -> Colour:
    """Convert a colour for batches and for single points of lines: viser's client takes those for linear light."""
    return colour_of((channel / 255) ** GAMMA for channel in colour)
