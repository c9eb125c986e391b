"""Which device computes, and in how many threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from osfcore.errors import InvalidInput


def pick_device(name: str) -> torch.device:
    """Return the device to compute on; "auto" takes a GPU where there is one.

    Raises:
        InvalidInput: if the name is unknown or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InvalidInput("device", name, "auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device", name, "auto or cpu on this machine: PyTorch finds no GPU")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def use_one_thread() -> None:
    """Let torch work in one thread from now on, for the rollouts of a planner.

    They are thousands of small products: a second thread hardly helps on an idle machine, and where the other core is
    busy, with a page that draws the 3D view, say, each product waits for it. Renderer and estimator have threads of
    their own.
    """
    torch.set_num_threads(1)


@contextmanager
def computing_threads(count: int) -> Iterator[None]:
    """Let torch and numba compute in that many threads of the processor, numba in no more than it has."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(min(count, before[0]))
    torch.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
