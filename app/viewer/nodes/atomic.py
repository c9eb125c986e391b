"""Changes of several nodes that a browser draws at once."""

import contextlib
from collections.abc import Iterator

import viser


@contextlib.contextmanager
def atomic(server: viser.ViserServer) -> Iterator[None]:
    """Send what changes inside as one message, at once."""
    with server.atomic():
        yield
    server.flush()
