"""Changes of nodes: several that a browser draws at once, and none where nothing has changed."""

import contextlib
from collections.abc import Iterator

import numpy as np
import viser

_STILL = 1e-6  # poses that differ by less are not sent again
Target = viser.ViserServer | viser.ClientHandle  # what draws for all browsers, or for one


@contextlib.contextmanager
def atomic(server: Target) -> Iterator[None]:
    """Send what changes inside as one message, at once."""
    with server.atomic():
        yield
    server.flush()


def put(node: viser.SceneNodeHandle, position: np.ndarray, quaternion: np.ndarray | None = None) -> None:
    """Move a node [m], and turn it, if it is elsewhere."""
    if np.abs(np.asarray(node.position) - position).max() > _STILL:
        node.position = np.asarray(position, float)
    if quaternion is not None and np.abs(np.asarray(node.wxyz) - quaternion).max() > _STILL:
        node.wxyz = np.asarray(quaternion, float)
