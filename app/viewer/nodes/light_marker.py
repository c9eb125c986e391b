"""Where a light is, as a dot of one size on the screen and a stretch of the line along which it falls.

Only a light's direction can be observed, so the dot stands nearer than the light does: at the height of the cameras,
where it is in view and seldom before an object.
"""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

AT = 0.66  # where the dot stands on the way from the table's centre to the light
_RAY = (0.46, AT)  # where the line begins and ends
_DOT_PX, _RAY_PX = 15.0, 2.5
_DOT = np.array([[[0, 0, 0], [0, 0, 1e-4]]], np.float32)  # a line this short is its own two round ends
Colour = tuple[int, int, int]


class LightMarker:
    """A dot, a line and words.

    Args:
        scene: to draw in.
        path: of the dot; the others are beside it, with `_ray` and `_name` at the end.
        colour: of dot and line.
        is_below: whether the words stand below the dot.
    """

    def __init__(self, scene: viser.SceneApi, path: str, colour: Colour, *, is_below: bool = False) -> None:
        add = scene.add_line_segments
        self._dot = add(path, _DOT, colour, thickness=_DOT_PX, thickness_units="screen")
        self._ray = add(f"{path}_ray", _DOT, colour, thickness=_RAY_PX, thickness_units="screen")
        anchor = "top-center" if is_below else "bottom-center"
        self._name = scene.add_label(f"{path}_name", "", visible=False, font_screen_scale=0.8, anchor=anchor)

    @property
    def nodes(self) -> tuple[viser.SceneNodeHandle, ...]:
        """Everything that is drawn."""
        return self._dot, self._ray, self._name

    def place(self, position: Float[np.ndarray, "3"]) -> None:
        """Mark a light at a position 1 m from the table's centre."""
        at = np.asarray(position, float)
        if np.abs(np.asarray(self._dot.position) - AT * at).max() > 1e-6:
            self._dot.position = self._name.position = AT * at
            self._ray.points = np.stack([_RAY[0] * at, _RAY[1] * at])[None].astype(np.float32)

    def show(self, *, is_on: bool, has_ray: bool = True, text: str = "", colour: Colour | None = None) -> None:
        """Show or hide it.

        Args:
            is_on: whether it is visible.
            has_ray: whether the line is, too.
            text: the words, if any.
            colour: another one from now on; None for as it is.
        """
        self._dot.visible, self._ray.visible = is_on, is_on and has_ray
        self._name.text, self._name.visible = text, is_on and bool(text)
        if colour is not None:
            self._dot.colors = self._ray.colors = np.array(colour, np.uint8)

    def remove(self) -> None:
        """Remove it."""
        for node in self.nodes:
            node.remove()
