"""What is around every scene in the 3D view: the table, its axes, the ambient light, and where one looks from."""

from __future__ import annotations

import numpy as np
import viser

from osfcore.geometry.light import AMBIENT
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO

# From where the goal camera is, further back: the whole table is in view, and left is left as in the goal image.
VIEW_FROM, VIEW_AT, VIEW_FOV_RAD = (0.0, -1.31, 0.97), (0.0, 0.02, 0.0), 0.7
TABLE_THICKNESS_M = 0.04
AXES_M = 0.12  # arrows on the table's corner, so that "push toward +x" means something


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
    scene.add_box(
        "/table",
        color=colour_of(TABLE_ALBEDO),
        dimensions=(TABLE_SIDE_M, TABLE_SIDE_M, TABLE_THICKNESS_M),
        position=(0.0, 0.0, -TABLE_THICKNESS_M / 2),
        cast_shadow=False,
    )
    corner = (0.06 - TABLE_SIDE_M / 2, 0.06 - TABLE_SIDE_M / 2, 0.002)
    scene.add_frame("/axes", position=corner, axes_length=AXES_M, axes_radius=0.004, origin_radius=0.006)
    for name, offset in (("x", (AXES_M, 0, 0)), ("y", (0, AXES_M, 0))):
        scene.add_label(f"/axes/{name}", name, position=offset, font_screen_scale=0.8)


def colour_of(albedo: tuple[float, float, float]) -> tuple[int, int, int]:
    """An albedo as viser takes colours."""
    red, green, blue = (round(255 * channel) for channel in albedo)
    return red, green, blue
