"""Which device computes."""

from __future__ import annotations

import torch

from osfcore.errors import InvalidInput


def pick_device(name: str) -> torch.device:
    """The device to compute on; "auto" takes a GPU where there is one.

    Raises:
        InvalidInput: if the name is unknown or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InvalidInput("device", name, "auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device", name, "auto or cpu on this machine: PyTorch finds no GPU")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
