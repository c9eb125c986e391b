"""Where compiled kernels are kept: in the data directory or in a temporary one, and never beside the package."""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config

from osfcore.objects.data_dir import default_data_dir

Function = TypeVar("Function", bound=Callable[..., Any])
_VARIABLE = "NUMBA_CACHE_DIR"  # Numba's own, which child processes inherit


def kept_kernel(**options: Any) -> Callable[[Function], Function]:  # noqa: ANN401  they are Numba's
    """Return a decorator that compiles a function with Numba and keeps the result for later processes.

    Numba alone keeps it beside the source if it can, and fails where neither that nor the home can be written. It looks
    for the place when a function is decorated; the setting is given back, since other packages use Numba, too.

    Args:
        options: of `numba.njit`.
    """

    def decorate(function: Function) -> Function:
        settings: Any = config  # whose names are made while Numba is imported
        before, settings.CACHE_DIR = settings.CACHE_DIR, str(kernel_folder())
        try:
            compiled: Any = numba.njit(cache=True, **options)(function)
            return compiled
        finally:
            settings.CACHE_DIR = before

    return decorate


def kernel_folder() -> Path:
    """A folder that can be written: the one that is set (by --data-dir, too), the default one, or a temporary one."""
    chosen = os.environ.get(_VARIABLE)
    place = Path(chosen) if chosen else default_data_dir() / "compiled"
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return place
    except OSError as error:
        temporary = tempfile.mkdtemp(prefix="osf-compiled-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        os.environ[_VARIABLE] = temporary  # for later kernels, and for child processes
        logging.getLogger(__name__).warning(
            "Kernels are compiled anew each time, since %s cannot be written (%s); set %s to a folder that can.",
            place, error.strerror or error, _VARIABLE,
        )  # fmt: skip
        return Path(temporary)
