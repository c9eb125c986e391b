"""The push that is tried, in the 3D view: the pusher is dragged at an object, and what comes of it is drawn.

Changes of the push are only stored; drawing happens in the thread.
"""

from __future__ import annotations

import time
from concurrent.futures import Executor

import numpy as np
import viser
from jaxtyping import Float

from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.objects.asset_library import AssetLibrary

from ..services.pushes import Push, PushChanged, Pushes
from .drawing import Panel, RunCommand
from .nodes.push_nodes import PushNodes
from .nodes.scene_nodes import level_point

TICK_S = 0.03  # between two pictures of a moving ghost


class PushPanel(Panel):
    """The nodes of the push that is tried; the same in all browsers.

    Args:
        server: to draw in.
        library: meshes of the objects.
        pusher: the node that is dragged to choose a push.
        pushes: predicts the push.
        commands: carries out what hands do; viser's loop must not wait for it.
        run_command: carries out a command and notifies its client if it is refused.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: AssetLibrary,
        pusher: viser.CylinderHandle,
        pushes: Pushes,
        commands: Executor,
        run_command: RunCommand,
    ) -> None:
        super().__init__("push-panel", TICK_S)
        self._pushes, self._commands, self._run_command = pushes, commands, run_command
        self._nodes = PushNodes(server, library)
        self._push = pushes.current
        self._hand: Float[np.ndarray, "2 2"] | None = None  # the way that a hand is showing
        self._drawn: Push | None = None
        self._began = 0.0  # when its future began to play
        pusher.on_drag(self._drag)

    def _store(self, event: object) -> bool:
        if isinstance(event, PushChanged):
            self._push = event.push
        return isinstance(event, PushChanged)

    async def _drag(self, event: viser.SceneNodeDragEvent[viser.CylinderHandle]) -> None:
        """Let the way of the pusher follow a hand, and predict where it leads once it is let go."""
        start = np.asarray(event.target.position, float)
        grip = np.asarray(event.start_position, float) - start
        eye, through = np.asarray(event.client.camera.position), np.asarray(event.end_position, float)
        pointed = level_point(eye, through, start[2] + grip[2])
        with self._thread.changing():
            if pointed is not None:
                end = np.clip((pointed - grip)[:2], -PUSHER_REACH_M, PUSHER_REACH_M)
                self._hand = np.stack([start[:2], end])
            way = self._hand
        if event.phase == "end" and way is not None:
            self._commands.submit(self._run_command, lambda: self._predict(way), event.client)

    def _predict(self, way: Float[np.ndarray, "2 2"]) -> None:
        try:
            self._pushes.predict(way[1])
        finally:
            with self._thread.changing():
                if self._hand is way:
                    self._hand = None

    def _draw(self) -> None:
        with self._thread.changed:
            push, hand = self._push, self._hand
        self._nodes.plan(hand if hand is not None else _way_ahead(push))
        drawn = self._drawn
        if push is None or push.rollouts is None:
            self._nodes.clear()
            self._drawn = None
            return
        if drawn is None or drawn.rollouts is not push.rollouts:
            self._nodes.show(push.rollouts)
            self._began = time.monotonic()
        if drawn is not push:
            self._nodes.show_truth(push.truth)
            self._drawn = push
        passed_s, lasts_s = time.monotonic() - self._began, len(push.actions) * STEP_S
        self._nodes.at(min(passed_s, lasts_s) / STEP_S)
        if passed_s < lasts_s:
            self._thread.wake(TICK_S)


def _way_ahead(push: Push | None) -> Float[np.ndarray, "2 2"] | None:
    """The way that the pusher is still to go; none once it has, or where it would lead on from elsewhere."""
    return push.way if push is not None and push.state in ("predicting", "predicted", "executing") else None
