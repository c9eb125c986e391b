"""Changes of several nodes that a browser draws at once."""

import contextlib
from collections.abc import Iterator

import viser

Target = viser.ViserServer | viser.ClientHandle  # what draws for all browsers, or for one


@contextlib.contextmanager
def atomic(server: Target) -> Iterator[None]:
    """Send what changes inside as one message, at once."""
    with server.atomic():
        yield
    server.flush()
