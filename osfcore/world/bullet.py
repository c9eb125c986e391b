"""PyBullet, imported without the line about its build that it writes to stderr each time."""

from __future__ import annotations

import os
from types import ModuleType


def _imported() -> ModuleType:
    """Import PyBullet while the descriptor of stderr leads nowhere, for the line is written by C code."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return pybullet


pybullet = _imported()
