"""The nodes that show an estimate in the 3D view: candidates as ghosts, the guess, the light, and how sure it is."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float

from osfcore.estimation.steps import UNPLACED_BELOW_M
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.objects.asset_library import AssetLibrary

from .ghosts import Mesh, add_ghosts, box, footprint_m, heading_rad, mesh_of, move_ghosts, sector, spread, top_m
from .room import AT, LIGHT_COLOUR, NO_TURN, Colour, LightMarker, Target, atomic, separated

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


@dataclass(frozen=True, eq=False, slots=True)
class _ObjectNodes:
    """What is drawn of one object.

    Attributes:
        vertices: of its mesh [m].
        tried: candidates.
        guess: the best pose so far.
        tracked: the pose of an object on its way.
    """

    vertices: Float[np.ndarray, "P 3"]
    tried: viser.BatchedMeshHandle
    guess: viser.BatchedMeshHandle
    tracked: viser.BatchedMeshHandle

    def place(self, pose: Pose, *, is_tracked: bool) -> None:
        """Show where the object is; what was not looked for yet is hidden."""
        shown, hidden = (self.tracked, self.guess) if is_tracked else (self.guess, self.tracked)
        hidden.visible = False
        move_ghosts(shown, pose[None])
        shown.visible = bool(pose.position[2] > UNPLACED_BELOW_M)

    def paint(self, colour: Colour) -> None:
        """Give the pose a colour."""
        self.guess.batched_colors = self.tracked.batched_colors = np.array(colour, np.uint8)

    def remove(self) -> None:
        """Remove all."""
        for node in (self.tried, self.guess, self.tracked):
            node.remove()


class EstimateNodes:
    """Nodes below one of their own. Any thread may call.

    Args:
        server: to draw in.
        library: meshes of the objects.
        root: the node.
        colour: of the guess.
        has_light: whether the light is drawn, too.
    """

    def __init__(
        self,
        server: Target,
        library: AssetLibrary,
        *,
        root: str = "/estimate",
        colour: Colour = GUESS,
        has_light: bool = True,
    ) -> None:
        self._root, self._colour, self._has_light = root, colour, has_light
        self._server = server
        self._scene = server.scene
        self._library = library
        self._lock = threading.RLock()
        self._objects: dict[str, _ObjectNodes] = {}
        self._verdicts: list[viser.SceneNodeHandle] = []
        self._lamps: dict[bool, LightMarker] = {}  # by whether things are on their way
        self._tried_lights = self._add_tried("tried_lights", box(_TRIED_LIGHT_M), LIGHT_COLOUR, 0.5)

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
            for n, nodes in enumerate(self._begun(state.names)):
                nodes.place(state.poses[n], is_tracked=False)
                if candidates is not None:
                    move_ghosts(nodes.tried, spread(candidates[:, n], GHOSTS))
                nodes.tried.visible = candidates is not None
            self._show_light(state.light, "guessed light", lights)
            if estimate is not None:
                self._judge(estimate)

    def follow(self, state: SceneState, doubts: Sequence[str]) -> None:
        """Draw one of many estimates of things on their way: where they are, and which are doubted, without a word.

        Args:
            state: the estimate.
            doubts: why each object is doubted, or "".
        """
        with self._lock, atomic(self._server):
            for n, nodes in enumerate(self._begun(state.names)):
                nodes.place(state.poses[n], is_tracked=True)
                nodes.tried.visible = False
                nodes.paint(_DOUBTED if doubts[n] else _SURE)
            self._show_light(state.light, is_tracked=True)

    def clear(self) -> None:
        """Remove everything."""
        with self._lock, atomic(self._server):
            self._begun(())
            while self._lamps:
                self._lamps.popitem()[1].remove()
            self._tried_lights.visible = False

    def _begun(self, names: tuple[str, ...]) -> Iterable[_ObjectNodes]:
        """Remove the last verdict, and make nodes if these are other objects than before."""
        for node in self._verdicts:
            node.remove()
        self._verdicts = []
        if names != tuple(self._objects):
            for nodes in self._objects.values():
                nodes.remove()
            self._objects = {name: self._add_object(name) for name in names}
        for nodes in self._objects.values():
            nodes.paint(self._colour)
        return self._objects.values()

    def _add_object(self, name: str) -> _ObjectNodes:
        root, mesh = self._root, mesh_of(self._library, name)
        guess, tracked = (
            add_ghosts(self._scene, path, mesh, 1, self._colour, opacity, scale=_WIRE_SCALE, is_wire=True)
            for path, opacity in ((f"{root}/guess/{name}", _WIRES), (f"{root}/{TRACKED}/{name}", _FAINT_WIRES))
        )
        return _ObjectNodes(mesh[0], self._add_tried(f"tried/{name}", mesh, _TRIED, 0.2), guess, tracked)

    def _add_tried(self, path: str, mesh: Mesh, colour: Colour, opacity: float) -> viser.BatchedMeshHandle:
        return add_ghosts(self._scene, f"{self._root}/{path}", mesh, GHOSTS, colour, opacity)

    def _show_light(
        self, light: Light, text: str = "", tried: np.ndarray | None = None, *, is_tracked: bool = False
    ) -> None:
        if not self._has_light:
            return
        if is_tracked not in self._lamps:
            path = f"{self._root}/{TRACKED}/light" if is_tracked else f"{self._root}/light"
            self._lamps[is_tracked] = LightMarker(self._scene, path, is_below=True)
        for of, lamp in self._lamps.items():
            lamp.show(is_on=of == is_tracked, text=text)
        self._lamps[is_tracked].place(light.position)
        if tried is not None:
            turns = np.tile(NO_TURN, (len(tried), 1))
            move_ghosts(self._tried_lights, spread(Pose(AT * np.asarray(tried, float), turns), GHOSTS))
        self._tried_lights.visible = tried is not None

    # The verdict

    def _judge(self, estimate: EstimatedState) -> None:
        """Say how sure each pose is, or why it is doubted, above the object and clear of the others."""
        texts, anchors = [], []
        for n, (name, nodes) in enumerate(self._objects.items()):
            pose, doubt = estimate.state.poses[n], estimate.doubts[n]
            nodes.paint(_DOUBTED if doubt else _SURE)
            top = pose.position + np.array([0.0, 0.0, top_m(nodes.vertices, pose.quaternion)])
            self._add_bounds(estimate, n, top)
            far_mm, turn_deg = 1000 * _SIGMAS * estimate.position_std[n], np.rad2deg(_SIGMAS * estimate.rotation_std[n])
            text = f"± {_two_digits(far_mm)} mm, ± {_two_digits(turn_deg)}° ({_SIGMAS:.0f}σ)"
            text = f"DOUBTFUL: {doubt}" if doubt else text
            texts.append(f"{self._library.label(name)}: {text}")
            anchors.append(top + np.array([0.0, 0.0, _LABEL_M]))
        places = separated(np.array(anchors).reshape(-1, 3), texts)
        for name, text, at in zip(self._objects, texts, places, strict=True):
            path = f"{self._root}/verdict/{name}/words"
            words = self._scene.add_label(path, text, position=at, font_screen_scale=0.75, anchor="bottom-center")
            self._verdicts.append(words)
        within = f"± {_two_digits(np.rad2deg(_SIGMAS * estimate.light_std))}° ({_SIGMAS:.0f}σ)"
        self._show_light(estimate.state.light, f"estimated light {within}")

    def _add_bounds(self, estimate: EstimatedState, n: int, top: Float[np.ndarray, "3"]) -> None:
        """Add a ball of two standard deviations on an object's top, and a sector of two around its heading."""
        name, pose = estimate.state.names[n], estimate.state.poses[n]
        colour = _DOUBTED if estimate.doubts[n] else _SURE
        ball_m = float(np.clip(_SIGMAS * estimate.position_std[n], _LEAST_BALL_M, _MOST_BALL_M))
        turn_rad = float(np.clip(_SIGMAS * estimate.rotation_std[n], _LEAST_TURN_RAD, _MOST_TURN_RAD))
        reach_m = footprint_m(self._objects[name].vertices, pose.quaternion)
        flat = sector(heading_rad(pose.quaternion), turn_rad, reach_m + _RING_M[0], reach_m + _RING_M[1])
        path = f"{self._root}/verdict/{name}"
        self._verdicts += [
            self._scene.add_icosphere(f"{path}/position", ball_m, colour, position=top, opacity=0.7, cast_shadow=False),
            self._scene.add_mesh_simple(
                f"{path}/turn",
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
