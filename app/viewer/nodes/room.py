"""What is around every scene in the 3D view, and what all drawings share: changes at once, labels, marks of lights."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import viser
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO

# From where the goal camera is, further back: the whole table is in view, and left is left as in the goal image.
# `framing` looks from the same direction.
VIEW_FROM, VIEW_AT, VIEW_FOV_RAD = (0.0, -1.31, 0.97), (0.0, 0.02, 0.0), 0.7
TABLE_THICKNESS_M = 0.04
_BOUNCE = 0.4  # share of light that reaches what faces down; walls get half of it
NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
NO_LINES = np.zeros((1, 2, 3), np.float32)  # viser has no node of no lines
GAMMA = 2.2  # of viser's colours
_STILL = 1e-6  # poses that differ by less are not sent again
_ASIDE_M = 1e-3
Colour = tuple[int, int, int]
Target = viser.ViserServer | viser.ClientHandle  # what draws for all browsers, or for one


def add_room(server: viser.ViserServer) -> None:
    """Add the nodes that never change."""
    scene = server.scene
    scene.set_up_direction("+z")
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = VIEW_FROM, VIEW_AT, (0.0, 0.0, 1.0)
    camera.fov = VIEW_FOV_RAD
    camera.near, camera.far = 0.01, 20.0
    # three.js divides by pi what Lambert's law does not
    scene.add_light_ambient("/ambient", intensity=float(np.pi * AMBIENT))
    # What the table throws back softens the sides and undersides of things; what faces up, and so the table and the
    # shadows on it, has none of it.
    scene.add_light_hemisphere(
        "/bounce", intensity=float(np.pi * _BOUNCE), sky_color=(0, 0, 0), position=(0.0, 0.0, 1.0)
    )
    scene.add_box(
        "/table",
        color=colour_of(TABLE_ALBEDO),
        dimensions=(TABLE_SIDE_M, TABLE_SIDE_M, TABLE_THICKNESS_M),
        position=(0.0, 0.0, -TABLE_THICKNESS_M / 2),
        cast_shadow=False,
    )


def colour_of(shares: Iterable[float]) -> Colour:
    """Convert three shares of red, green and blue, such as an albedo, to a colour as viser takes it."""
    red, green, blue = (round(255 * share) for share in shares)
    return red, green, blue


# The camera

# Shares of half the view that stay free: left and right, below (where the page's own buttons are) and above (labels).
_FREE_SIDES, _FREE_BELOW, _FREE_ABOVE = 0.06, 0.2, 0.16
_NEAREST_M, _NEAREST_POINT_M = 0.6, 0.1  # before the camera: the points on average, and each of them


def framing(
    points_m: Float[np.ndarray, "N 3"], fov_rad: float, aspect: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Place a camera as near as it can be while all points are in view.

    With x, y, z along the camera's right, up and forward axes and the camera at (a, b, -d), a point is in view if
    -l (z + d) <= x - a <= r (z + d), and likewise for y. Both sides together bound d from below, as do the least
    distances of the points. The largest bound wins, and the points are put in the middle of what the other axis leaves
    free.

    Args:
        points_m: to be seen, in the world [m].
        fov_rad: vertical field of view [rad].
        aspect: the view's width divided by its height.

    Returns:
        Where the camera stands and the point that it looks at, in the world [m].
    """
    axes = Camera.look_at("view", VIEW_FROM, VIEW_AT).T_world_camera.apply(np.eye(3)) - np.asarray(VIEW_FROM)
    right, up, forward = axes[0], -axes[1], axes[2]
    reach = np.tan(fov_rad / 2)
    sides = [
        (points_m @ right, reach * aspect * (1 - _FREE_SIDES), reach * aspect * (1 - _FREE_SIDES)),
        (points_m @ up, reach * (1 - _FREE_BELOW), reach * (1 - _FREE_ABOVE)),
    ]
    depth = points_m @ forward
    bounds = [((-at - low * depth).max(), (at - high * depth).max(), low, high) for at, low, high in sides]
    least = _NEAREST_M - depth.mean(), _NEAREST_POINT_M - depth.min()
    back = max(*least, *((below + above) / (low + high) for below, above, low, high in bounds))
    a, b = ((above - high * back + low * back - below) / 2 for below, above, low, high in bounds)
    position = a * right + b * up - back * forward
    return position, position + (back + depth.mean()) * forward


# Changes


@contextlib.contextmanager
def atomic(server: Target) -> Iterator[None]:
    """Send what changes inside as one message, at once."""
    with server.atomic():
        yield
    server.flush()


def put(node: viser.SceneNodeHandle, position: np.ndarray, quaternion: np.ndarray | None = None) -> None:
    """Move a node [m], and turn it, if it is elsewhere or nowhere (NaN)."""
    if not np.abs(np.asarray(node.position) - position).max() <= _STILL:
        node.position = np.asarray(position, float)
    if quaternion is not None and not np.abs(np.asarray(node.wxyz) - quaternion).max() <= _STILL:
        node.wxyz = np.asarray(quaternion, float)


def send_again(node: viser.SceneNodeHandle) -> None:
    """Send where a node is once more: a browser may have moved its own."""
    position, quaternion = np.array(node.position), np.array(node.wxyz)
    node.position, node.wxyz = position + _ASIDE_M, -quaternion  # viser sends nothing that is as it was
    node.position, node.wxyz = position, quaternion


# Labels

CHARACTER, LINE = 0.011, 0.032  # width of a character and height of a label, as shares of the view's height
_RISE_M = 0.02


def separated(anchors_m: Float[np.ndarray, "N 3"], texts: Sequence[str]) -> Float[np.ndarray, "N 3"]:
    """Raise the anchors of labels where one would cover another, as the view is at first.

    A label stands on its anchor. From the lowest in the view to the highest, each is raised until it is clear of those
    before it.

    Args:
        anchors_m: where each would stand best, in the world [m].
        texts: of the labels.
    """
    view = Camera.look_at("view", VIEW_FROM, VIEW_AT, fov_y_deg=float(np.rad2deg(VIEW_FOV_RAD)))
    place = view.project(anchors_m) / view.height
    higher = view.project(anchors_m + np.array([0, 0, _RISE_M])) / view.height
    raised = anchors_m.copy()
    taken: list[tuple[float, float, float]] = []  # middle, half width and foot of labels that have their place
    for n in np.argsort(-place[:, 1], kind="stable"):
        (middle, foot), half = place[n], CHARACTER * len(texts[n]) / 2
        for other_middle, other_half, other_foot in sorted(taken, key=lambda label: -label[2]):
            if abs(middle - other_middle) < half + other_half and abs(foot - other_foot) < LINE:
                foot = other_foot - LINE
        raised[n, 2] += _RISE_M * (place[n, 1] - foot) / (place[n, 1] - higher[n, 1])
        taken.append((middle, half, foot))
    return raised


# Lights

LAMP_COLOUR, LIGHT_COLOUR = (255, 210, 70), (40, 200, 60)  # the true one, and what is taken for it
AT = 0.5  # where the dot stands on the way from the table's centre to the light
_RAY = (0.35, AT)  # where the line begins and ends
_DOT_PX, _RAY_PX = 15.0, 2.5
_DOT = np.array([[[0, 0, 0], [0, 0, 1e-4]]], np.float32)  # a line this short is its own two round ends


class LightMarker:
    """Where a light is: a dot of one size on the screen, a stretch of the line along which it falls, and words.

    Only a light's direction can be observed, so the dot stands nearer than the light does: at the height of the
    cameras, where it is in view and seldom before an object.

    Args:
        scene: to draw in.
        path: of the dot; the others are beside it, with `_ray` and `_name` at the end.
        is_below: whether the words stand below the dot.
    """

    def __init__(self, scene: viser.SceneApi, path: str, *, is_below: bool = False) -> None:
        add = scene.add_line_segments
        self._dot = add(path, _DOT, LIGHT_COLOUR, thickness=_DOT_PX, thickness_units="screen")
        self._ray = add(f"{path}_ray", _DOT, LIGHT_COLOUR, thickness=_RAY_PX, thickness_units="screen")
        anchor = "top-center" if is_below else "bottom-center"
        self._name = scene.add_label(f"{path}_name", "", visible=False, font_screen_scale=0.8, anchor=anchor)

    def place(self, position: Float[np.ndarray, "3"]) -> None:
        """Mark a light at a position 1 m from the table's centre."""
        at = np.asarray(position, float)
        if np.abs(np.asarray(self._dot.position) - AT * at).max() > _STILL:
            self._dot.position = self._name.position = AT * at
            self._ray.points = np.stack([_RAY[0] * at, _RAY[1] * at])[None].astype(np.float32)

    def show(self, *, is_on: bool = True, has_ray: bool = True, text: str = "", colour: Colour = LIGHT_COLOUR) -> None:
        """Show or hide it; without a text it has no words."""
        self._dot.visible, self._ray.visible = is_on, is_on and has_ray
        self._name.text, self._name.visible = text, is_on and bool(text)
        self._dot.colors = self._ray.colors = np.array(colour, np.uint8)

    def remove(self) -> None:
        """Remove it."""
        for node in (self._dot, self._ray, self._name):
            node.remove()
