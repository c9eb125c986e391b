"""The choice of device and number of threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from osfcore.errors import InvalidInput


def pick_device(name: str) -> torch.device:
    """Return a PyTorch device by name; "auto" chooses a GPU if there is one.

    Raises:
        InvalidInput: if the name is unknown or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InvalidInput("device", name, "auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device", name, "auto or cpu on this machine: PyTorch finds no GPU")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def use_one_thread() -> None:
    """Make torch use one thread from now on, for the rollouts of a planner.

    Rollouts are thousands of small products. A second thread hardly helps on an idle machine. If the other core is
    busy, such as with the 3D view of a page, each product would wait for it. Renderer and estimator have their own
    threads.
    """
    torch.set_num_threads(1)


@contextmanager
def computing_threads(count: int) -> Iterator[None]:
    """Make torch and numba use this many threads; numba at most as many as the processor has."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(min(count, before[0]))
    torch.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
