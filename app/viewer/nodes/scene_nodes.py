"""The nodes that show a scene in the 3D view."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import numpy as np
import viser
from jaxtyping import Float

from app.processes.messages.scene_messages import SceneRecord
from app.viewer.nodes.atomic import Target, atomic, put
from app.viewer.nodes.label_layout import Label, separated
from app.viewer.nodes.light_marker import AT, LightMarker
from app.viewer.nodes.room import colour_of
from app.viewer.nodes.shadow_nodes import ShadowNodes
from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import DIFFUSE, MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, quaternion_multiply, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.objects.asset_library import AssetLibrary

# Everything that is drawn of the live table, here and elsewhere; the room around it is not.
LIVE_NODES = (
    "/objects", "/names", "/handles", "/shadows", "/cameras", "/pusher", "/light", "/light_ray", "/light_name",
    "/light_handle", "/episode", "/estimate", "/push", "/goal",
)  # fmt: skip
# A browser's own lamp takes the place of the one for all, wherever its other nodes are: the table is dark while a lamp
# that was hidden is put up again.
LAMP = "/lamp"
LIGHT_COLOUR, NAMED_LIGHT_COLOUR = (40, 200, 60), (230, 185, 40)
LABEL_GAP_M = 0.01
_NUDGE = 1e-7  # viser sends nothing that is as it was
NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
_log = logging.getLogger(__name__)
Client = viser.ClientHandle | None


class SceneNodes:
    """The nodes of one viser scene. Nodes are made once; afterwards only what changes is assigned.

    Args:
        server: to draw in, for all browsers or for one.
        library: meshes, sizes and labels of the objects.
        on_move: called on viser's loop with name, pose [m, world] and client when an object was let go; None where
            objects have no handles.
        on_light: called on viser's loop with light and client when the light was let go; None likewise.
        cameras: that are drawn.
        root: below which everything but the lamp is drawn.
    """

    def __init__(
        self,
        server: Target,
        library: AssetLibrary,
        on_move: Callable[[str, Pose, Client], None] | None = None,
        on_light: Callable[[Light, Client], None] | None = None,
        *,
        cameras: tuple[Camera, ...] = (),
        root: str = "",
    ) -> None:
        self._server, self._root = server, root
        self._scene = server.scene
        self._library = library
        self._on_move = on_move
        self._on_light = on_light
        self._on_change: Callable[[], None] = _nothing
        self._lock = threading.RLock()
        self._bodies: dict[str, viser.SceneNodeHandle] = {}
        self._labels: dict[str, viser.LabelHandle] = {}
        self._gizmos: dict[str, viser.SceneNodeHandle] = {}
        self._sizes_m: dict[str, np.ndarray] = {}
        # What someone is dragging follows the hand, not the scene.
        self._grabbed: dict[str, np.ndarray] = {}
        self._is_light_held = False
        self._has_names = True
        self._has_gizmos = False
        self._light_requests: dict[str, tuple[bool, str]] = {}
        self._lamp_look = True, ""
        self._shadows = ShadowNodes(self._scene, library, f"{root}/shadows")
        self._add_pusher()
        self._add_light()
        self._frustums = {camera.name: self._frustum(camera) for camera in cameras}

    def show(self, record: SceneRecord | None) -> None:
        """Begin with a scene, or clear the table."""
        self.begin(None if record is None else record.state)

    def begin(self, state: SceneState | None) -> None:
        """Begin with a state of any objects, or clear the table."""
        names = () if state is None else state.names
        with self._lock, atomic(self._server):  # what was on the table before is never seen on the new one
            for name in set(self._bodies) - set(names):
                for nodes in (self._bodies, self._labels, self._gizmos):
                    if name in nodes:
                        nodes.pop(name).remove()
            for name in names:
                if name not in self._bodies:
                    self._add_object(name)
            self._grabbed.clear()
            self._is_light_held = False
            self._pusher.visible = state is not None
            self._show_marker()
            for frustum in self._frustums.values():
                frustum.image = None
            self._shadows.show(None)
            if state is not None:
                self.place(state)
        self._on_change()

    def watch(self, on_change: Callable[[], None]) -> None:
        """Call a function, which must be quick, whenever something has moved. Any thread may call it back."""
        self._on_change = on_change

    def state(self) -> SceneState:
        """The poses on view, also those of objects that are being dragged."""
        with self._lock:
            names = tuple(self._bodies)
            positions = np.array([self._bodies[name].position for name in names], float).reshape(-1, 3)
            quaternions = np.array([self._bodies[name].wxyz for name in names], float).reshape(-1, 4)
            pusher = np.array(self._pusher.position, float) if self._pusher.visible else None
            return SceneState(names, Pose(positions, quaternions), Light(np.array(self._lamp.position)), pusher)

    def place(self, state: SceneState) -> None:
        """Move everything to where it is in a state."""
        with self._lock, atomic(self._server):
            for name in state.names:
                if name in self._bodies and name not in self._grabbed:
                    self._place_object(name, state.pose(name))
            self._place_labels()
            if state.pusher is not None:
                put(self._pusher, state.pusher)
            if not self._is_light_held:
                self._place_light(state.light.position)
                if self._light_gizmo is not None:
                    put(self._light_gizmo, AT * state.light.position)
            self._draw_shadows()
        self._on_change()

    def show_frames(self, names: tuple[str, ...], images: np.ndarray) -> None:
        """Put live images into the cameras' frustums."""
        with self._lock:
            for name, image in zip(names, images, strict=True):
                if name in self._frustums:
                    self._frustums[name].image = image

    def names(self) -> dict[str, Label]:
        """The names of objects that are on view, by object."""
        with self._lock:
            shown = {name: label for name, label in self._labels.items() if label.visible}
            return {name: Label(label.text, np.asarray(label.position, float)) for name, label in shown.items()}

    def show_cameras(self, is_on: bool) -> None:
        """Show or hide the cameras."""
        for frustum in self._frustums.values():
            frustum.visible = is_on

    def show_lamp(self, *, is_on: bool, name: str = "", by: str = "") -> None:
        """Show or hide the scene's own light; with a name, in another colour than estimated lights.

        Each panel that draws estimates has a request of its own: the light is as usual once all requests are the usual.

        Args:
            is_on: whether it is visible.
            name: text beside it.
            by: the panel that requests it.
        """
        with self._lock:
            self._light_requests[by] = is_on, name
            others = [request for request in self._light_requests.values() if request != (True, "")]
            is_on, name = max(others, default=(True, ""))
            self._lamp_look = is_on, name
            if self._light_gizmo is not None:
                self._light_gizmo.visible = is_on
            self._show_marker()

    def show_names(self, is_on: bool) -> None:
        """Show or hide the objects' names."""
        with self._lock:
            self._has_names = is_on
            for label in self._labels.values():
                label.visible = is_on

    def show_gizmos(self, is_on: bool) -> None:
        """Show or hide the handles for moving objects."""
        with self._lock:
            if is_on != self._has_gizmos:
                self._has_gizmos = is_on
                for gizmo in self._gizmos.values():
                    gizmo.visible = is_on

    def put_handles_back(self) -> None:
        """Send where the handles are once more: a browser may have moved its own."""
        with self._lock:
            for handle in (self._light_gizmo, *self._gizmos.values()):
                if handle is not None:
                    handle.position = np.asarray(handle.position, float) + _NUDGE
                    handle.wxyz = np.asarray(handle.wxyz, float) * (1 + _NUDGE)

    def _add_pusher(self) -> None:
        self._pusher = self._scene.add_cylinder(
            f"{self._root}/pusher",
            radius=PUSHER_RADIUS_M,
            height=PUSHER_HEIGHT_M,
            color=colour_of(PUSHER_ALBEDO),
            visible=False,
        )

    def _add_light(self) -> None:
        scene = self._scene
        start = (0.0, 0.0, 1.0)
        root = self._root
        # three.js divides by pi what Lambert's law does not
        self._lamp = scene.add_light_directional(LAMP, intensity=float(np.pi * DIFFUSE), position=start)
        self._marker = LightMarker(scene, f"{root}/light", LIGHT_COLOUR)
        self._place_light(np.array(start))
        self._light_gizmo = None if self._on_light is None else self._add_light_handle(self._on_light, start)

    def _add_light_handle(
        self, on_light: Callable[[Light, Client], None], start: tuple[float, float, float]
    ) -> viser.TransformControlsHandle:
        gizmo = self._scene.add_transform_controls(
            f"{self._root}/light_handle", scale=0.12, disable_rotations=True, position=start, depth_test=False
        )

        async def drag(event: viser.TransformControlsEvent) -> None:
            light = light_toward(np.asarray(event.target.position))
            if event.phase != "end":
                self._is_light_held = True
                if light is not None:
                    self._place_light(light.position)
                    self._draw_shadows()
                    self._on_change()
                return
            self._is_light_held = False
            if light is not None:
                self._place_light(light.position)
                event.target.position = tuple(AT * light.position)
                on_light(light, event.client)

        gizmo.on_update(drag)
        return gizmo

    def _frustum(self, camera: Camera) -> viser.CameraFrustumHandle:
        pose = camera.T_world_camera
        return self._scene.add_camera_frustum(
            f"/cameras/{camera.name}",
            fov=camera.fov_y_rad,
            aspect=camera.width / camera.height,
            scale=0.06,
            thickness=0.003,
            color=(90, 100, 115),
            wxyz=pose.quaternion,
            position=pose.position,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,  # one stands between most views and the table
        )

    def _add_object(self, name: str) -> None:
        try:
            body = self._scene.add_glb(f"{self._root}/objects/{name}", self._library.viewer_glb(name))
            self._sizes_m[name] = self._library.size_m(name)
            label = self._library.info(name).label
        except OsfError as error:  # removed or damaged since the scene was made: its name still shows where it is
            _log.warning("%s is not drawn: %s", name, error)
            body, label = (
                self._scene.add_frame(f"{self._root}/objects/{name}", axes_length=0.05, axes_radius=0.002),
                name,
            )
        self._bodies[name] = body
        self._labels[name] = self._scene.add_label(
            f"{self._root}/names/{name}", label, visible=self._has_names, font_screen_scale=0.8, anchor="bottom-center"
        )
        if self._on_move is not None:
            self._gizmos[name] = self._add_handle(name, self._on_move)

    def _add_handle(self, name: str, on_move: Callable[[str, Pose, Client], None]) -> viser.TransformControlsHandle:
        gizmo = self._scene.add_transform_controls(
            f"{self._root}/handles/{name}", scale=0.12, visible=self._has_gizmos, depth_test=False
        )

        async def drag(event: viser.TransformControlsEvent) -> None:
            with self._lock:  # another thread may be changing which objects there are
                if (body := self._bodies.get(name)) is None:
                    return
                # Handles stay along the axes of the table: what they turn is added to how the object lay before.
                turn, before = np.array(event.target.wxyz), self._grabbed.setdefault(name, np.array(body.wxyz))
                pose = Pose(np.array(event.target.position, float), quaternion_multiply(turn, before))
                self._follow(name, pose)
                self._place_labels()
                self._draw_shadows()
            self._on_change()
            if event.phase == "end":
                self._grabbed.pop(name, None)
                on_move(name, pose, event.client)

        gizmo.on_update(drag)
        return gizmo

    def _follow(self, name: str, pose: Pose) -> None:
        body = self._bodies.get(name)
        if body is not None:
            put(body, pose.position, pose.quaternion)

    def _place_labels(self) -> None:
        anchors = [self._anchor(name) for name in self._labels]
        if not anchors:
            return
        texts = [label.text for label in self._labels.values()]
        for label, anchor in zip(self._labels.values(), separated(np.array(anchors), texts), strict=True):
            put(label, anchor)

    def _anchor(self, name: str) -> Float[np.ndarray, "3"]:
        """Above the top of an object [m]."""
        body, size_m = self._bodies[name], self._sizes_m.get(name, np.zeros(3))
        top_m = float(np.abs(quaternion_to_matrix(np.asarray(body.wxyz))[2]) @ size_m / 2)
        return np.asarray(body.position, float) + np.array([0.0, 0.0, top_m + LABEL_GAP_M])

    def _place_object(self, name: str, pose: Pose) -> None:
        self._follow(name, pose)
        if name in self._gizmos:
            put(self._gizmos[name], pose.position, NO_TURN)

    def _draw_shadows(self) -> None:
        if self._bodies:
            self._shadows.show(self.state())

    def _place_light(self, position: np.ndarray) -> None:
        put(self._lamp, position)
        self._marker.place(position)

    def _show_marker(self) -> None:
        is_on, name = self._lamp_look
        colour = NAMED_LIGHT_COLOUR if name else LIGHT_COLOUR
        self._marker.show(is_on=is_on, has_ray=self._pusher.visible, text=name, colour=colour)


def _nothing() -> None:
    """The callback until `watch` is called."""


def light_toward(position: np.ndarray) -> Light | None:
    """The light in the direction of a point [m], kept above the lowest elevation; None for the table's centre."""
    if not np.all(np.isfinite(position)) or not np.linalg.norm(position) > 1e-6:
        return None
    x, y, z = position / np.linalg.norm(position)
    lowest_rad = float(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))
    return Light.from_angles(float(np.arctan2(y, x)), max(float(np.arcsin(np.clip(z, -1, 1))), lowest_rad))
