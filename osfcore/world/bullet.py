"""PyBullet, imported without the line about its build that it writes to stderr each time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


@contextmanager
def _nothing_said() -> Iterator[None]:
    """Let the descriptor of stderr lead nowhere, for C code writes to it."""
    try:
        kept = os.dup(2)
    except OSError:  # a service may have been started without one
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _imported() -> ModuleType:
    with _nothing_said():
        import pybullet
    return pybullet


pybullet = _imported()
