"""The hard shadows of a scene on its table: viser's own are blurred over eight centimetres at the scale of a tabletop.

A parallel light maps every convex part of an object onto the plane z = 0 along its direction, x - z l_xy / l_z; the
shadow of the part is the convex hull of its mapped vertices, clipped to the table. Shadows that fall on other objects
are left to the rendered pictures. See `osfcore.world.imaging` for the images that the cameras take.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

import cv2
import numpy as np
import viser
from jaxtyping import Float, Int

from app.viewer.nodes.ghosts import box
from osfcore.errors import OsfError
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.poses import rotate
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import TABLE_ALBEDO

_ABOVE_M = 0.0007  # the table, so that it does not flicker
_CORNERS = 20  # of the pusher's rim
_UNKNOWN_M = 0.05
_GAMMA = 2.2  # of viser's colours
_NOTHING = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
_log = logging.getLogger(__name__)
Polygon = Float[np.ndarray, "K 2"]
Flat = tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "F 3"]]


class ShadowNodes:
    """One flat node with the shadows of all objects and the pusher.

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
            self._is_on = not self._is_on
            self._node.visible = self._is_on
        if state is None:
            return
        vertices, faces = shadow_mesh(self._bodies(state), state.light.position)
        if not np.array_equal(vertices, self._node.vertices):
            self._node.vertices, self._node.faces = vertices, faces
        colour = shadow_colour(float(state.light.position[2]))
        if tuple(self._node.color) != colour:
            self._node.color = colour

    def _bodies(self, state: SceneState) -> Iterable[Float[np.ndarray, "P 3"]]:
        """World vertices of every convex part [m]."""
        for name in state.names:
            pose = state.pose(name)
            for part in self._parts_of(name):
                yield rotate(pose.quaternion, part) + pose.position
        if state.pusher is not None:
            yield state.pusher + _cylinder()

    def _parts_of(self, name: str) -> list[np.ndarray]:
        if name not in self._parts:
            try:
                self._parts[name] = [part.astype(float) for part in self._library.load_geometry(name).parts]
            except OsfError as error:
                _log.info("%s casts the shadow of a cube: %s", name, error)
                return [box(_UNKNOWN_M)[0].astype(float)]
        return self._parts[name]


def shadow_mesh(bodies: Iterable[Float[np.ndarray, "P 3"]], light: Float[np.ndarray, "3"]) -> Flat:
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
    red, green, blue = (round(255 * albedo * share ** (1 / _GAMMA)) for albedo in TABLE_ALBEDO)
    return red, green, blue


def _cylinder() -> Float[np.ndarray, "P 3"]:
    """Vertices around the pusher's centre [m]."""
    angles = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
    rim = PUSHER_RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [np.column_stack([rim, np.full(_CORNERS, z)]) for z in (-PUSHER_HEIGHT_M / 2, PUSHER_HEIGHT_M / 2)]
    return np.concatenate(ends)
