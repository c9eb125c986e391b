"""How kernels and their helpers are compiled, and the numbers that all of them know."""

from __future__ import annotations

from typing import Any

import numpy as np

HELPER: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "_nrt": False}
KERNEL: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "cache": True, "nogil": True}
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
NEVER = np.float32(1e9)  # more than any distance
