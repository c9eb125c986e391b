"""The nodes that show a scene in the 3D view, and its shadows."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
import viser
from jaxtyping import Float

from osfcore.errors import OsfError
from osfcore.geometry.light import AMBIENT, DIFFUSE, MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, quaternion_multiply, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import TABLE_ALBEDO

from .ghosts import UNKNOWN_M, Mesh, box, size_m
from .room import AT, GAMMA, LAMP_COLOUR, NO_TURN, LightMarker, Target, atomic, colour_of, put, send_again

# Everything that is drawn of the live table, here and elsewhere; the room around it is not.
LIVE_NODES = (
    "/objects", "/handles", "/shadows", "/pusher", "/light", "/light_ray", "/light_name",
    "/episode", "/estimate", "/push", "/goal",
)  # fmt: skip
# A browser's own lamp takes the place of the one for all, wherever its other nodes are: the table is dark while a lamp
# that was hidden is put up again.
LAMP = "/lamp"
_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])  # of the corners of a box
_PUSHER_M = np.array([2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M])
PUSHER_NAME, LAMP_NAME = "pusher", "lamp"  # of what is no object
_MARK_RAD = 0.02  # as seen from the eye, half of the lamp's mark
_BALL_M, _BALL_OPACITY = 0.025, 0.06
_BELOW_M = 0.06  # a hand that takes the lowest light by the lower half of its ball points below the table
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
        root: below which everything but the lamp is drawn.

    Attributes:
        pusher: its node.
    """

    def __init__(
        self,
        server: Target,
        library: AssetLibrary,
        on_move: Callable[[str, Pose, Client], None] | None = None,
        on_light: Callable[[Light, Client], None] | None = None,
        *,
        root: str = "",
    ) -> None:
        self._server, self._root = server, root
        self._scene = server.scene
        self._library = library
        self._on_move = on_move
        self._on_change: Callable[[], object] = tuple
        self._lock = threading.RLock()
        self._bodies: dict[str, viser.SceneNodeHandle] = {}
        self._gizmos: dict[str, viser.SceneNodeHandle] = {}
        # What someone is dragging follows the hand, not the scene.
        self._grabbed: dict[str, np.ndarray] = {}
        self._is_light_held = False
        self._has_gizmos = self._is_grabbable = False
        self._shadows = ShadowNodes(self._scene, library, f"{root}/shadows")
        self.pusher = self._scene.add_cylinder(
            f"{root}/pusher",
            radius=PUSHER_RADIUS_M,
            height=PUSHER_HEIGHT_M,
            color=colour_of(PUSHER_ALBEDO),
            visible=False,
        )
        start = (0.0, 0.0, 1.0)
        # three.js divides by pi what Lambert's law does not
        self._lamp = self._scene.add_light_directional(LAMP, intensity=float(np.pi * DIFFUSE), position=start)
        self._marker = LightMarker(self._scene, f"{root}/light")
        self._place_light(np.array(start))
        if on_light is not None:
            self._let_drag_light(on_light)

    def show(self, state: SceneState | None) -> None:
        """Begin with a state of any objects, or clear the table."""
        names = () if state is None else state.names
        with self._lock, atomic(self._server):  # what was on the table before is never seen on the new one
            for name in set(self._bodies) - set(names):
                for nodes in (self._bodies, self._gizmos):
                    if name in nodes:
                        nodes.pop(name).remove()
            for name in names:
                if name not in self._bodies:
                    self._add_object(name)
            self._grabbed.clear()
            self._is_light_held = False
            self.pusher.visible = state is not None
            self._marker.show(has_ray=state is not None, colour=LAMP_COLOUR)
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
            pusher = np.array(self.pusher.position, float) if self.pusher.visible else None
            return SceneState(names, Pose(positions, quaternions), Light(np.array(self._lamp.position)), pusher)

    def place(self, state: SceneState) -> None:
        """Move everything to where it is in a state."""
        with self._lock, atomic(self._server):
            for name in state.names:
                if name in self._bodies and name not in self._grabbed:
                    pose = state.pose(name)
                    put(self._bodies[name], pose.position, pose.quaternion)
                    if name in self._gizmos:
                        put(self._gizmos[name], pose.position, NO_TURN)
            if state.pusher is not None:
                put(self.pusher, state.pusher)
            if not self._is_light_held:
                self._place_light(state.light.position)
            self._draw_shadows()
        self._on_change()

    def show_gizmos(self, is_on: bool) -> None:
        """Show or hide the handles for moving objects."""
        with self._lock:
            self._has_gizmos = is_on
            for gizmo in self._gizmos.values():
                gizmo.visible = is_on

    def let_grab(self, is_on: bool) -> None:
        """Let objects be dragged over the table, or drags turn the view wherever they begin."""
        with self._lock:
            if is_on != self._is_grabbable:
                self._is_grabbable = is_on
                for name in self._bodies:
                    self._bind_drag(name)

    def put_handles_back(self) -> None:
        """Send where the handles are once more: a browser may have moved its own."""
        with self._lock:
            for handle in self._gizmos.values():
                send_again(handle)

    def _let_drag_light(self, on_light: Callable[[Light, Client], None]) -> None:
        """Let a hand take hold of the light's mark, and lead it over the dome on which it stands."""
        # Below the mark, and so where it is; larger than it looks, so that a finger finds it.
        ball = self._scene.add_icosphere(
            f"{self._root}/light/ball",
            _BALL_M,
            LAMP_COLOUR,
            opacity=_BALL_OPACITY,
            cast_shadow=False,
            receive_shadow=False,
        )
        is_far = is_beside = False

        async def drag(event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
            nonlocal is_far, is_beside
            eye, is_over = np.asarray(event.client.camera.position), event.phase == "end"
            with self._lock:  # another thread may be placing what the scene says
                if event.phase == "start":
                    mark = AT * np.asarray(self._lamp.position)
                    is_far, is_beside = bool(mark @ (mark - eye) > 0), False
                was_beside = is_beside
                point, is_beside = dome_point(eye, np.asarray(event.end_position, float), is_far=is_far)
                is_far ^= is_beside and not was_beside  # beyond the edge it comes back on the other side
                self._is_light_held = not is_over
                light = light_toward(point)
                if light is None:
                    return
                self._place_light(light.position)
                self._draw_shadows()
            self._on_change()
            if is_over:
                on_light(light, event.client)

        ball.on_drag(drag)

    def _add_object(self, name: str) -> None:
        try:
            body = self._scene.add_glb(f"{self._root}/objects/{name}", self._library.viewer_glb(name))
        except OsfError as error:  # removed or damaged since the scene was made: a mark still shows where it is
            _log.warning("%s is not drawn: %s", name, error)
            body = self._scene.add_frame(f"{self._root}/objects/{name}", axes_length=0.05, axes_radius=0.002)
        self._bodies[name] = body
        if self._on_move is not None:
            self._gizmos[name] = self._add_handle(name, self._on_move)
            self._bind_drag(name)

    def _bind_drag(self, name: str) -> None:
        """Let a hand take hold of an object itself, or no longer."""
        body, on_move = self._bodies[name], self._on_move
        if not isinstance(body, viser.GlbHandle) or on_move is None:
            return
        if not self._is_grabbable:
            body.remove_drag_callback()
            return
        offset_m = np.zeros(3)  # from the object's origin to where the hand has it

        async def drag(event: viser.SceneNodeDragEvent[viser.GlbHandle]) -> None:
            nonlocal offset_m
            with self._lock:
                if (held := self._bodies.get(name)) is None:
                    return
                before = np.asarray(held.position, float)
                if event.phase == "start":
                    self._grabbed[name] = np.array(held.wxyz)
                    offset_m = np.asarray(event.start_position, float) - before
                pointed = np.asarray(event.end_position, float)
                at = level_point(np.asarray(event.client.camera.position), pointed, before[2] + offset_m[2])
                pose = Pose(before if at is None else at - offset_m, np.array(held.wxyz, float))
                self._carry(held, pose)
            self._on_change()
            if event.phase == "end":
                self._grabbed.pop(name, None)
                on_move(name, pose, event.client)

        body.on_drag(drag)

    def _carry(self, body: viser.SceneNodeHandle, pose: Pose) -> None:
        """Move an object with a hand, and with it the shadows."""
        put(body, pose.position, pose.quaternion)
        self._draw_shadows()

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
                self._carry(body, pose)
            self._on_change()
            if event.phase == "end":
                self._grabbed.pop(name, None)
                on_move(name, pose, event.client)

        gizmo.on_update(drag)
        return gizmo

    def _draw_shadows(self) -> None:
        if self._bodies:
            self._shadows.show(self.state())

    def _place_light(self, position: np.ndarray) -> None:
        put(self._lamp, position)
        self._marker.place(position)


def level_point(
    eye: Float[np.ndarray, "3"], through: Float[np.ndarray, "3"], height_m: float
) -> Float[np.ndarray, "3"] | None:
    """Return where a ray from the eye through a point meets a level; None off the table, or if it never does.

    Args:
        eye: where the ray begins [m].
        through: a point on it [m].
        height_m: of the level above the table [m].
    """
    slope = eye[2] - through[2]
    if not slope > 1e-6 or not eye[2] > height_m:
        return None
    point = eye + (eye[2] - height_m) / slope * (through - eye)
    return point if np.abs(point[:2]).max() <= TABLE_SIDE_M / 2 else None


def dome_point(
    eye: Float[np.ndarray, "3"], through: Float[np.ndarray, "3"], *, is_far: bool
) -> tuple[Float[np.ndarray, "3"], bool]:
    """Return where a ray from the eye through a point meets the dome of the lights' marks, and whether it passes by.

    With u the direction of the ray, f = eye - (eye . u) u is nearest to the table's centre, and the ray meets the
    dome's sphere of radius r at f -+ sqrt(r^2 - |f|^2) u. Beside the sphere, the point of it that is nearest counts.

    Args:
        eye: where the ray begins [m].
        through: a point on it [m].
        is_far: whether the far one of two points counts, unless it is far below the table; before an eye that is in
            the dome there is no other.
    """
    way = (through - eye) / max(float(np.linalg.norm(through - eye)), 1e-9)
    nearest = eye - (eye @ way) * way
    half_m = np.sqrt(max(AT**2 - float(nearest @ nearest), 0.0))
    if half_m == 0.0:
        return AT * nearest / np.linalg.norm(nearest), True
    near, far = nearest - half_m * way, nearest + half_m * way
    is_inside = bool(eye @ eye < AT**2)
    return (far if is_inside or (is_far and far[2] >= -_BELOW_M) else near), False


def extent_m(
    state: SceneState, library: AssetLibrary, goal: Sequence[tuple[str, Pose]] = ()
) -> Float[np.ndarray, "P 3"]:
    """Return points around all that is on view: corners of boxes around things, and the lamp's mark [m].

    Args:
        state: the scene.
        library: sizes of the objects.
        goal: objects, and where they should be.
    """
    corners = [np.asarray(AT * state.light.position)[None]]
    if state.pusher is not None:
        corners.append(state.pusher + _PUSHER_M / 2 * _SIGNS)
    for name, pose in (*((name, state.pose(name)) for name in state.names), *goal):
        corners.append(pose.apply(size_m(library, name) / 2 * _SIGNS))
    return np.concatenate(corners)


def pointed_at(
    state: SceneState, library: AssetLibrary, eye: Float[np.ndarray, "3"], way: Float[np.ndarray, "3"]
) -> str | None:
    """Return what a ray meets first: an object by the box around it, the pusher, the lamp by its mark, or nothing.

    Args:
        state: the scene.
        library: sizes of the objects.
        eye: where the ray begins [m].
        way: where it leads.
    """
    mark = AT * state.light.position - eye
    if mark @ way > np.cos(_MARK_RAD) * np.linalg.norm(mark) * np.linalg.norm(way):
        return LAMP_NAME
    boxes = [(name, state.pose(name), size_m(library, name)) for name in state.names]
    if state.pusher is not None:
        boxes.append((PUSHER_NAME, Pose(state.pusher, NO_TURN), _PUSHER_M))
    met = {name: at for name, pose, sides_m in boxes if np.isfinite(at := _enters(pose, sides_m, eye, way))}
    return min(met, key=met.__getitem__, default=None)


def _enters(pose: Pose, sides_m: np.ndarray, eye: np.ndarray, way: np.ndarray) -> float:
    """Where a ray enters a box around a pose, in lengths of the ray; infinite if it misses (Kay and Kajiya 1986)."""
    axes = quaternion_to_matrix(pose.quaternion)
    start, slope = (eye - pose.position) @ axes, way @ axes
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(-sides_m / 2 - start) / slope, (sides_m / 2 - start) / slope])
    near, far = np.nanmax(sides.min(axis=0)), np.nanmin(sides.max(axis=0))
    return float(near) if 0 < near <= far else np.inf


def light_toward(position: np.ndarray) -> Light | None:
    """The light in the direction of a point [m], kept above the lowest elevation; None for the table's centre."""
    if not np.all(np.isfinite(position)) or not np.linalg.norm(position) > 1e-6:
        return None
    x, y, z = position / np.linalg.norm(position)
    lowest_rad = float(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))
    return Light.from_angles(float(np.arctan2(y, x)), max(float(np.arcsin(np.clip(z, -1, 1))), lowest_rad))


# Shadows

_ABOVE_M = 0.0007  # the table, so that it does not flicker
_CORNERS = 20  # of the pusher's rim
_NOTHING = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
Polygon = Float[np.ndarray, "K 2"]


class ShadowNodes:
    """One flat node with the hard shadows of all objects and the pusher on the table.

    viser's own shadows are blurred over eight centimetres at the scale of a tabletop. A parallel light maps every
    convex part of an object onto the plane z = 0 along its direction, x - z l_xy / l_z; the shadow of the part is the
    convex hull of its mapped vertices, clipped to the table. Shadows that fall on other objects are left to the
    rendered pictures. See `osfcore.world.imaging` for the images that the cameras take.

    Args:
        scene: to draw in.
        library: convex parts of the objects.
        path: of the node.
    """

    def __init__(self, scene: viser.SceneApi, library: AssetLibrary, path: str) -> None:
        self._library = library
        self._parts: dict[str, list[np.ndarray]] = {}
        self._is_on = False
        self._node = scene.add_mesh_simple(
            path, *_NOTHING, side="double", visible=False, cast_shadow=False, receive_shadow=False
        )

    def show(self, state: SceneState | None) -> None:
        """Draw the shadows of a state, or none."""
        if self._is_on != (state is not None):  # else it may be hidden, and stay so
            self._node.visible = self._is_on = state is not None
        if state is None:
            return
        self._node.vertices, self._node.faces = shadow_mesh(self._hulls(state), state.light.position)
        self._node.color = shadow_colour(float(state.light.position[2]))

    def _hulls(self, state: SceneState) -> Iterable[Float[np.ndarray, "P 3"]]:
        """Yield world vertices of every convex part [m]."""
        for name in state.names:
            pose = state.pose(name)
            for part in self._parts_of(name):
                yield pose.apply(part)
        if state.pusher is not None:
            yield state.pusher + _cylinder()

    def _parts_of(self, name: str) -> list[np.ndarray]:
        if name not in self._parts:
            try:
                self._parts[name] = [part.astype(float) for part in self._library.load_geometry(name).parts]
            except OsfError as error:
                _log.info("%s casts the shadow of a cube: %s", name, error)
                return [box(UNKNOWN_M)[0].astype(float)]
        return self._parts[name]


def shadow_mesh(bodies: Iterable[Float[np.ndarray, "P 3"]], light: Float[np.ndarray, "3"]) -> Mesh:
    """Flat triangles that cover the shadows of convex bodies on the table.

    Args:
        bodies: vertices of each [m, world].
        light: direction toward it.
    """
    slope = light[:2] / light[2]
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], 0
    for body in bodies:
        above = body[:, 2].clip(0)[:, None]
        hull = cv2.convexHull((body[:, :2] - above * slope).astype(np.float32))[:, 0].astype(float)
        polygon = clipped(hull, TABLE_SIDE_M / 2)
        if len(polygon) < 3:
            continue
        vertices.append(np.column_stack([polygon, np.full(len(polygon), _ABOVE_M)]))
        fan = np.arange(1, len(polygon) - 1)
        faces.append(count + np.column_stack([np.zeros_like(fan), fan, fan + 1]))
        count += len(polygon)
    if not count:
        return _NOTHING
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


def clipped(polygon: Polygon, half_m: float) -> Polygon:
    """The part of a convex polygon within a square around the origin (Sutherland and Hodgman 1974)."""
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            inside = half_m - sign * polygon[:, axis]
            after, polygon_after = np.roll(inside, -1), np.roll(polygon, -1, axis=0)
            kept = []
            for k in range(len(polygon)):
                if inside[k] >= 0:
                    kept.append(polygon[k])
                if (inside[k] >= 0) != (after[k] >= 0):
                    share = inside[k] / (inside[k] - after[k])
                    kept.append(polygon[k] + share * (polygon_after[k] - polygon[k]))
            polygon = np.array(kept).reshape(-1, 2)
    return polygon


def shadow_colour(cosine: float) -> tuple[int, int, int]:
    """The table's colour with the lamp's share taken out, since the node itself is lit like the table.

    Args:
        cosine: of the angle between light and vertical.
    """
    share = AMBIENT / (AMBIENT + DIFFUSE * cosine)
    return colour_of(albedo * share ** (1 / GAMMA) for albedo in TABLE_ALBEDO)


def _cylinder() -> Float[np.ndarray, "P 3"]:
    """Vertices around the pusher's centre [m]."""
    angles = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
    rim = PUSHER_RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [np.column_stack([rim, np.full(_CORNERS, z)]) for z in (-PUSHER_HEIGHT_M / 2, PUSHER_HEIGHT_M / 2)]
    return np.concatenate(ends)
