"""What an estimator believes while it works, rendered and compared with the images, for whoever watches."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from osfcore.control.events import Event, Look, Looking, Observed
from osfcore.control.goal import GoalImage
from osfcore.estimation.steps import UNPLACED_BELOW_M
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import to_uint8
from osfcore.planning.costs import PoseGoal
from osfcore.render.types import PLANNING, Renderer, SceneBatch

SIDE = 160  # of a picture [px]
_EVERY_S = 0.4
_MOST_SHARE = 0.06  # of the time goes into pictures


class LookPictures:
    """Renders the steps of estimators, as often as costs the search little; steps between show the latest pictures.

    Args:
        renderer: of the episode's objects and the table.
        goal: of the episode.
        clock: returns the time [s].
    """

    def __init__(
        self, renderer: Renderer, goal: GoalImage | PoseGoal, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._renderer, self._clock = renderer, clock
        self._goal = _small([goal.camera], goal.image[None]) if isinstance(goal, GoalImage) else None
        self._table: tuple[list[Camera], Float32[np.ndarray, "V s s 3"]] | None = None
        self._pusher: Float[np.ndarray, "3"] | None = None
        self._next_at = clock()
        self._latest: tuple[Look | None, dict[str, np.ndarray], float] = None, {}, float("nan")

    def drawn(self, event: Event) -> Event:
        """The event; with pictures, and their difference from the images, if it is a step that can be looked at.

        Args:
            event: of the episode; all that happens must come this way.
        """
        if isinstance(event, Observed):
            observation = event.observation
            self._table, self._pusher = _small(observation.cameras, observation.images), observation.pusher
        if not isinstance(event, Looking) or event.look == "next":
            return event
        if event.look != self._latest[0] or event.step.estimate is not None or self._clock() >= self._next_at:
            began = self._clock()
            self._latest = event.look, *self._render(event.look, event.step.state)
            self._next_at = self._clock() + max(_EVERY_S, (self._clock() - began) / _MOST_SHARE)
        _, rendered, difference = self._latest
        return replace(event, rendered=rendered, difference=difference)

    def _render(self, look: Look, state: SceneState) -> tuple[dict[str, np.ndarray], float]:
        views = self._goal if look == "goal" else self._table
        if views is None:
            return {}, float("nan")
        cameras, observed = views
        placed = state.poses.position[:, 2] > UNPLACED_BELOW_M
        seen = state.reordered(tuple(name for name, is_placed in zip(state.names, placed, strict=True) if is_placed))
        seen = replace(seen, pusher=None if look == "goal" else self._pusher)
        images = self._renderer.render(SceneBatch.of(seen), cameras, quality=PLANNING).rgb[0]
        difference = float(np.sqrt(np.mean((images - observed) ** 2)))
        return {camera.name: to_uint8(image) for camera, image in zip(cameras, images, strict=True)}, difference


def _small(
    cameras: Sequence[Camera], images: Float[np.ndarray, "V h w 3"]
) -> tuple[list[Camera], Float32[np.ndarray, "V s s 3"]]:
    sized = [cv2.resize(image.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA) for image in images]
    return [camera.resized(SIDE, SIDE) for camera in cameras], np.stack(sized)
