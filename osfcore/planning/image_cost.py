"""Image cost of rollouts: squared difference from the goal image (line 15 of the paper's Algorithm 1)."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import MIN_IMAGE_SIDE, Camera
from osfcore.geometry.light import Light
from osfcore.geometry.rollouts import Rollouts
from osfcore.render.types import PLANNING, Renderer, SceneBatch

SIDE = 64  # longest side of the images that are compared [px]
EVERY = 3  # actions between rendered states
_SAME = 5  # decimals of metres and quaternions up to which states count as one


class ImageCost:
    """S = sum over t of |I(t) - I_goal|^2 with I(t) rendered from the goal camera, as a mean over pixels.

    Deviations: futures are rendered in 64 pixels a side, at every third state and the last; states that are the same in
    several sequences, as the beginnings mostly are, once. The pusher is left out, for the goal image shows none.

    Args:
        renderer: of the objects on the table.
        camera: of the goal image.
        image: that camera's, linear RGB.
        light: under which futures are rendered: that of the goal image.
        every: actions between rendered states; 1 for the paper's sum over all of them.

    Raises:
        InvalidInput: if the image has another size than its camera's.
    """

    def __init__(
        self, renderer: Renderer, camera: Camera, image: Float[np.ndarray, "h w 3"], light: Light, *, every: int = EVERY
    ) -> None:
        if image.shape != (camera.height, camera.width, 3):
            raise InvalidInput("shape of the goal image", image.shape, f"{(camera.height, camera.width, 3)}")
        scale = min(1.0, SIDE / max(camera.width, camera.height))
        size = max(round(camera.width * scale), MIN_IMAGE_SIDE), max(round(camera.height * scale), MIN_IMAGE_SIDE)
        self._renderer, self._light, self._every = renderer, light, every
        self._camera = camera.resized(*size)
        self._image = cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA)

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """The cost of each sequence."""
        horizon = rollouts.positions.shape[1] - 1
        times = np.arange(horizon, 0, -self._every)
        states = np.concatenate([rollouts.positions[:, times], rollouts.quaternions[:, times]], axis=-1)
        count = states.shape[0] * states.shape[1]
        shown, which = np.unique(states.round(_SAME).reshape(count, -1), axis=0, return_inverse=True)
        costs = self._costs(rollouts.names, shown.reshape(len(shown), -1, 7))[which.reshape(-1)]
        return horizon * costs.reshape(states.shape[:2]).mean(axis=1)

    def _costs(self, names: tuple[str, ...], states: Float[np.ndarray, "B N 7"]) -> Float[np.ndarray, "B"]:
        """Mean squared differences of single states."""
        quaternions = states[..., 3:] / np.linalg.norm(states[..., 3:], axis=-1, keepdims=True)
        lights = np.tile(self._light.direction, (len(states), 1))
        batch = SceneBatch(names, states[..., :3], quaternions, lights, None)
        images = self._renderer.render(batch, (self._camera,), quality=PLANNING).rgb[:, 0]
        return ((images - self._image) ** 2).mean(axis=(1, 2, 3), dtype=float)
