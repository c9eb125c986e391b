"""How kernels and their helpers are compiled, and the numbers that all of them know."""

from __future__ import annotations

from typing import Any

import numpy as np

FAR = np.float32(1e9)
TINY = np.float32(1e-9)
GONE, STILL, MOVES = 0, 1, 2  # an object that is not there, or that is in the base, or in the scene alone
HELPER: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
KERNEL: dict[str, Any] = {"parallel": True, "fastmath": True, "error_model": "numpy", "cache": True, "nogil": True}
