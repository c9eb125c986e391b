"""The path of the pusher: position-controlled, so it follows from the actions alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S

SUBSTEPS = 4  # of one action: the pusher travels 6 cm in one, too far to see contact coming at once


def pusher_path(
    start: Float[np.ndarray, "*#batch 2"], velocity: Float[np.ndarray, "*batch T 2"]
) -> Float[np.ndarray, "*batch S1 2"]:
    """Where the pusher's centre is before the first and after each substep [m]; it stops where its reach ends."""
    place = np.broadcast_to(np.asarray(start, float), (*velocity.shape[:-2], 2))
    reach = np.maximum(PUSHER_REACH_M, np.abs(place))
    path = [place]
    for step in range(velocity.shape[-2]):
        for _ in range(SUBSTEPS):
            place = np.clip(place + velocity[..., step, :] * (STEP_S / SUBSTEPS), -reach, reach)
            path.append(place)
    return np.stack(path, axis=-2)
