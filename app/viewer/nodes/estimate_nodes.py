"""The nodes that show an estimate in the 3D view: candidates as ghosts, the guess, the light, and how sure it is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import viser

from app.viewer.nodes.ghosts import (
    Mesh,
    add_ghosts,
    below_table,
    box,
    footprint_m,
    heading_rad,
    mesh_of,
    move_ghosts,
    sector,
    spread,
    top_m,
)
from app.viewer.nodes.room import AT, LIGHT_COLOUR, NO_TURN, Colour, Label, LightMarker, Target, atomic, separated
from osfcore.estimation.steps import UNPLACED_BELOW_M
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.objects.asset_library import AssetLibrary

GHOSTS = 24  # candidates of each object that are drawn
GUESS = (20, 120, 200)
TRACKED = "tracked"  # below which things on their way are drawn
_TRIED, _SURE, _DOUBTED = (90, 205, 255), (10, 150, 110), (235, 115, 15)
_TRIED_LIGHT_M = 0.018
_SIGMAS = 2.0
_LEAST_BALL_M, _MOST_BALL_M = 0.006, 0.1
_LEAST_TURN_RAD, _MOST_TURN_RAD = 0.06, np.pi
_RING_M = (0.008, 0.035)  # from the object's footprint outwards
_TABLE_M = 0.0015  # above it, so that it does not flicker
_LABEL_M = 0.045
_WIRES, _FAINT_WIRES = 0.9, 0.35  # opacity; things on their way are to be seen through them
_WIRE_SCALE = 1.01  # or wires and the surface below them would flicker
Copies = viser.BatchedMeshHandle


class EstimateNodes:
    """Nodes below one of their own. Any thread may call.

    Args:
        server: to draw in.
        library: meshes of the objects.
        names: the objects' names that are on view already, by object.
        root: the node.
        colour: of the guess.
        has_light: whether the light is drawn, too.
    """

    def __init__(
        self,
        server: Target,
        library: AssetLibrary,
        names: Callable[[], Mapping[str, Label]] = dict,
        *,
        root: str = "/estimate",
        colour: Colour = GUESS,
        has_light: bool = True,
    ) -> None:
        self._root, self._colour, self._has_light = root, colour, has_light
        self._server = server
        self._named = names
        self._scene = server.scene
        self._library = library
        self._lock = threading.RLock()
        self._names: tuple[str, ...] = ()
        self._meshes: dict[str, Mesh] = {}
        self._tried: dict[str, Copies] = {}
        self._guesses: dict[str, Copies] = {}
        self._tracked: dict[str, Copies] = {}
        self._verdicts: list[viser.SceneNodeHandle] = []
        self._has_candidates = True
        self._lamp: LightMarker | None = None
        self._tried_lights = self._add_tried("tried_lights", box(_TRIED_LIGHT_M), LIGHT_COLOUR, 0.5)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is drawn."""
        return not self._names and self._lamp is None

    def show(
        self,
        state: SceneState,
        candidates: Pose | None = None,
        lights: np.ndarray | None = None,
        estimate: EstimatedState | None = None,
    ) -> None:
        """Draw an estimator at work in place of what was drawn before; its result with the verdict.

        Args:
            state: the best scene so far.
            candidates: poses that are tried, a (C, N) batch.
            lights: directions toward the light that are tried, C x 3.
            estimate: the result.
        """
        with self._lock, atomic(self._server):
            self._begin(state.names)
            for n, name in enumerate(state.names):
                self._show_guess(name, state.poses[n], self._guesses, self._tracked)
                self._show_tried(name, None if candidates is None else candidates[:, n])
            self._show_light(state.light, lights, "guessed light")
            if estimate is not None:
                self._judge(estimate)

    def follow(self, state: SceneState, doubts: Sequence[str]) -> None:
        """Draw one of many estimates of things on their way: where they are, and which are doubted, without a word.

        Args:
            state: the estimate.
            doubts: why each object is doubted, or "".
        """
        with self._lock, atomic(self._server):
            self._begin(state.names)
            for n, name in enumerate(state.names):
                self._show_guess(name, state.poses[n], self._tracked, self._guesses)
                self._show_tried(name, None)
                self._mark(name, doubts[n])
            self._show_light(state.light, None, "estimated light")

    def show_candidates(self, is_on: bool) -> None:
        """Show or hide what is tried."""
        with self._lock:
            self._has_candidates = is_on
            for node in (*self._tried.values(), self._tried_lights):
                node.visible = is_on and node.visible

    def clear(self) -> None:
        """Remove everything."""
        with self._lock, atomic(self._server):
            self._begin(())
            if self._lamp is not None:
                self._lamp.remove()
            self._lamp, self._tried_lights.visible = None, False

    def _begin(self, names: tuple[str, ...]) -> None:
        """Make nodes for other objects than before, and remove the last verdict."""
        for node in self._verdicts:
            node.remove()
        self._verdicts = []
        for guess in (*self._guesses.values(), *self._tracked.values()):
            guess.batched_colors = np.array(self._colour, np.uint8)
        if names == self._names:
            return
        for node in (*self._tried.values(), *self._guesses.values(), *self._tracked.values()):
            node.remove()
        self._names = names
        self._meshes = {name: mesh_of(self._library, name) for name in names}
        self._tried = {name: self._add_tried(f"tried/{name}", mesh) for name, mesh in self._meshes.items()}
        self._guesses = {name: self._add_wires(f"guess/{name}", mesh, _WIRES) for name, mesh in self._meshes.items()}
        self._tracked = {
            name: self._add_wires(f"{TRACKED}/{name}", mesh, _FAINT_WIRES) for name, mesh in self._meshes.items()
        }

    def _add_tried(self, path: str, mesh: Mesh, colour: Colour = _TRIED, opacity: float = 0.2) -> Copies:
        path = f"{self._root}/{path}"
        return add_ghosts(self._scene, path, mesh, below_table(GHOSTS), colour, opacity, visible=False)

    def _add_wires(self, path: str, mesh: Mesh, opacity: float) -> Copies:
        path, place = f"{self._root}/{path}", below_table(1)
        return add_ghosts(
            self._scene, path, mesh, place, self._colour, opacity, scale=_WIRE_SCALE, is_wire=True, visible=False
        )

    @staticmethod
    def _show_guess(name: str, pose: Pose, shown: Mapping[str, Copies], hidden: Mapping[str, Copies]) -> None:
        hidden[name].visible = False
        move_ghosts(shown[name], Pose(pose.position[None], pose.quaternion[None]))
        shown[name].visible = bool(pose.position[2] > UNPLACED_BELOW_M)

    def _show_tried(self, name: str, candidates: Pose | None) -> None:
        node = self._tried[name]
        if candidates is not None:
            move_ghosts(node, spread(candidates, GHOSTS))
        node.visible = candidates is not None and self._has_candidates

    def _show_light(self, light: Light, tried: np.ndarray | None, text: str) -> None:
        if not self._has_light:
            return
        self._lamp = self._lamp or LightMarker(self._scene, f"{self._root}/light", is_below=True)
        self._lamp.place(light.position)
        self._lamp.show(text=text)
        if tried is not None:
            turns = np.tile(NO_TURN, (len(tried), 1))
            move_ghosts(self._tried_lights, spread(Pose(AT * np.asarray(tried, float), turns), GHOSTS))
        self._tried_lights.visible = tried is not None and self._has_candidates

    # The verdict

    def _judge(self, estimate: EstimatedState) -> None:
        for n, name in enumerate(estimate.state.names):
            pose, doubt = estimate.state.poses[n], estimate.doubts[n]
            self._mark(name, doubt)
            self._add_bounds(name, pose, float(estimate.position_std[n]), float(estimate.rotation_std[n]), doubt)
        self._add_words(estimate)
        within = f"± {_two_digits(np.rad2deg(_SIGMAS * estimate.light_std))}° ({_SIGMAS:.0f}σ)"
        self._show_light(estimate.state.light, None, f"estimated light {within}")

    def _mark(self, name: str, doubt: str) -> None:
        self._guesses[name].batched_colors = self._tracked[name].batched_colors = np.array(
            _DOUBTED if doubt else _SURE, np.uint8
        )

    def _add_words(self, estimate: EstimatedState) -> None:
        """How sure each pose is, or why it is doubted, above the object and clear of all names."""
        standing, texts, anchors = self._named(), [], []
        for n, name in enumerate(estimate.state.names):
            pose = estimate.state.poses[n]
            far_mm, turn_deg = 1000 * _SIGMAS * estimate.position_std[n], np.rad2deg(_SIGMAS * estimate.rotation_std[n])
            text = f"± {_two_digits(far_mm)} mm, ± {_two_digits(turn_deg)}° ({_SIGMAS:.0f}σ)"
            text = f"DOUBTFUL: {estimate.doubts[n]}" if estimate.doubts[n] else text
            texts.append(text if name in standing else f"{self._library.label(name)}: {text}")
            anchors.append(pose.position + np.array([0, 0, top_m(self._meshes[name][0], pose.quaternion) + _LABEL_M]))
        places = separated(np.array(anchors).reshape(-1, 3), texts, tuple(standing.values()))
        self._verdicts += [
            self._scene.add_label(
                f"{self._root}/verdict/{name}/words",
                text,
                position=place,
                font_screen_scale=0.75,
                anchor="bottom-center",
            )
            for name, text, place in zip(estimate.state.names, texts, places, strict=True)
        ]

    def _add_bounds(self, name: str, pose: Pose, position_std: float, rotation_std: float, doubt: str) -> None:
        """A ball of two standard deviations on the object's top, and a sector of two around its heading."""
        scene, (vertices, _) = self._scene, self._meshes[name]
        colour = _DOUBTED if doubt else _SURE
        top = pose.position + np.array([0.0, 0.0, top_m(vertices, pose.quaternion)])
        ball_m = float(np.clip(_SIGMAS * position_std, _LEAST_BALL_M, _MOST_BALL_M))
        turn_rad = float(np.clip(_SIGMAS * rotation_std, _LEAST_TURN_RAD, _MOST_TURN_RAD))
        reach_m = footprint_m(vertices, pose.quaternion)
        flat = sector(heading_rad(pose.quaternion), turn_rad, reach_m + _RING_M[0], reach_m + _RING_M[1])
        self._verdicts += [
            scene.add_icosphere(
                f"{self._root}/verdict/{name}/position", ball_m, colour, position=top, opacity=0.7, cast_shadow=False
            ),
            scene.add_mesh_simple(
                f"{self._root}/verdict/{name}/turn",
                *flat,
                color=colour,
                opacity=0.8,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
                position=(pose.position[0], pose.position[1], _TABLE_M),
            ),
        ]


def _two_digits(value: float) -> str:
    """Two digits, or words for what is without bounds."""
    return f"{value:.2g}" if np.isfinite(value) else "any"
