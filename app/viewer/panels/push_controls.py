"""The controls with which a push is chosen: straight ahead, or along waypoints that are dragged over the table."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import viser
from jaxtyping import Float

from app.processes.messages.scene_messages import SceneRecord
from app.services.pushes import MAX_ACTIONS, along, straight, toward_nearest, way
from app.viewer.nodes.waypoints import FEWEST, MOST, Waypoints
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S

STRAIGHT, PATH = "Straight", "Waypoints"
COMPASS = {"→": 0, "↗": 45, "↑": 90, "↖": 135, "←": 180, "↙": 225, "↓": 270, "↘": 315}
_SPEED = (0.05, MAX_SPEED_M_S)
_DEFAULT_STEPS = 6
_FURTHER_M = 0.05


class PushControls:
    """Elements for the kind of push, its heading, speed and length, and the waypoints.

    Args:
        server: whose open folder gets the elements, and whose scene gets the waypoints.
        on_change: called when somebody has chosen another push; must be quick.
    """

    def __init__(self, server: viser.ViserServer, on_change: Callable[[], None]) -> None:
        gui = server.gui
        self._on_change = on_change
        self._waypoints = Waypoints(server, on_change)
        self._laid_for: tuple[str, tuple[float, ...]] | None = None  # scene and pusher position
        self._kind = gui.add_dropdown("Push", (STRAIGHT, PATH), hint="Straight ahead, or along handles to drag.")
        self._compass = gui.add_button_group("Direction", tuple(COMPASS), hint="As seen from above, +y up.")
        self._heading = gui.add_slider("Heading, °", 0, 355, 5, 0, hint="From +x toward +y.")
        self._speed = gui.add_slider("Speed, m/s", *_SPEED, 0.01, 0.25)
        self._steps = gui.add_slider("Steps", 1, MAX_ACTIONS, 1, _DEFAULT_STEPS, hint=f"Of {STEP_S} s each.")
        self._count = gui.add_slider("Waypoints", FEWEST, MOST, 1, 3, visible=False)
        for control in (self._heading, self._speed, self._steps, self._count):
            control.on_update(lambda event: None if event.client is None else on_change())
        self._kind.on_update(lambda _: self._choose_kind())
        self._compass.on_click(lambda event: self._turn(event.target.value))

    def actions(self, state: SceneState) -> Float[np.ndarray, "T 3"]:
        """The chosen actions [m/s] from a state; values from browsers are clipped to the sliders' ranges.

        Raises:
            InvalidInput: if a path is empty or takes too many actions.
        """
        start = np.zeros(2) if state.pusher is None else state.pusher[:2]
        speed_m_s = number_between(self._speed.value, *_SPEED)
        if self._is_path:
            return along(start, self._waypoints.places(self._waypoint_count), speed_m_s)
        heading_rad = math.radians(number_between(self._heading.value, 0.0, 360.0))
        return straight(heading_rad, speed_m_s, int(number_between(self._steps.value, 1, MAX_ACTIONS)))

    def path(self, state: SceneState) -> Float[np.ndarray, "P 2"] | None:
        """The chosen way of the pusher on the table [m], its start included; None without a pusher."""
        if state.pusher is None:
            return None
        if self._is_path:  # straight through the handles, even where that takes too many actions
            return np.concatenate([state.pusher[None, :2], self._waypoints.places(self._waypoint_count)])
        return way(state.pusher[:2], self.actions(state))

    def follow(self, record: SceneRecord, *, is_chosen: bool) -> None:
        """Lay the waypoints out anew when the pusher has moved, and propose a push unless one was chosen here."""
        if record.state.pusher is None:
            return
        pusher = record.state.pusher[:2]
        laid_for = (record.id, tuple(pusher))
        if laid_for != self._laid_for:
            if self._laid_for is None or self._laid_for[0] != record.id or not is_chosen:
                self._aim(record.state)
            self._waypoints.lay(pusher, toward_nearest(record.state)[0])
            self._laid_for = laid_for

    def show_waypoints(self, is_on: bool) -> None:
        """Show the handles, if the push is a path, or hide them."""
        self._waypoints.show(self._waypoint_count if is_on and self._is_path else 0)

    @property
    def _is_path(self) -> bool:
        return self._kind.value == PATH

    @property
    def _waypoint_count(self) -> int:
        return int(number_between(self._count.value, FEWEST, MOST))

    def _choose_kind(self) -> None:
        is_path = self._is_path
        for control in (self._compass, self._heading, self._steps):
            control.visible = not is_path
        self._count.visible = is_path
        self._on_change()

    def _turn(self, arrow: str) -> None:
        if arrow in COMPASS:  # clients may send anything
            self._heading.value = COMPASS[arrow]
            self._on_change()

    def _aim(self, state: SceneState) -> None:
        """Propose a push that reaches the nearest object and goes on for a few centimetres."""
        heading_rad, distance_m = toward_nearest(state)
        self._heading.value = int(5 * round(math.degrees(heading_rad) / 5)) % 360
        step_m = STEP_S * number_between(self._speed.value, *_SPEED)
        self._steps.value = min(max(math.ceil((distance_m + _FURTHER_M) / step_m - 1e-9), 1), MAX_ACTIONS)


def number_between(value: object, low: float, high: float) -> float:
    """A number that a browser sent, clipped to [low, high].

    Args:
        value: which may be anything.
        low: of the range, and the result for what is not a finite number.
        high: of the range.
    """
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return low
    return min(max(number, low), high) if math.isfinite(number) else low
