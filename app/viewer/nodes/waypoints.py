"""Handles on the table that people drag to tell where the pusher shall go."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from jaxtyping import Float

from osfcore.geometry.workspace import PUSHER_REACH_M

FEWEST, MOST = 2, 5
SPACING_M = 0.07
_HEIGHT_M = 0.01
_COLOUR = (190, 50, 210)


class Waypoints:
    """Up to five handles, made once and shown on demand.

    Args:
        server: to draw in.
        on_drag: called on viser's loop when one was moved by hand; must be quick.
    """

    def __init__(self, server: viser.ViserServer, on_drag: Callable[[], None]) -> None:
        self._on_drag = on_drag
        self._handles = [self._handle(server, number) for number in range(MOST)]
        self._is_on = False

    def _handle(self, server: viser.ViserServer, number: int) -> viser.TransformControlsHandle:
        path = f"/push/waypoints/{number}"
        handle = server.scene.add_transform_controls(
            path, scale=0.07, active_axes=(True, True, False), disable_rotations=True, depth_test=False, visible=False
        )
        server.scene.add_icosphere(f"{path}/ball", 0.008, _COLOUR, cast_shadow=False, receive_shadow=False)
        server.scene.add_label(f"{path}/number", str(number + 1), font_screen_scale=0.8, anchor="bottom-center")

        async def drag(_: viser.TransformControlsEvent) -> None:
            self._on_drag()

        handle.on_update(drag)
        return handle

    def show(self, count: int) -> None:
        """Show the first few handles; 0 hides all."""
        for number, handle in enumerate(self._handles):
            if handle.visible != (number < count):
                handle.visible = number < count

    def lay(self, start: Float[np.ndarray, "2"], heading_rad: float) -> None:
        """Put them in a row that begins at the pusher [m], within its reach."""
        step = SPACING_M * np.array([np.cos(heading_rad), np.sin(heading_rad)])
        for number, handle in enumerate(self._handles, 1):
            x, y = np.clip(start + number * step, -PUSHER_REACH_M, PUSHER_REACH_M)
            handle.position = (float(x), float(y), _HEIGHT_M)

    def places(self, count: int) -> Float[np.ndarray, "P 2"]:
        """Where the first few are [m]."""
        return np.array([handle.position[:2] for handle in self._handles[:count]], float)
