"""Optimizers of training: Muon for the weight matrices, AdamW for biases, norms and the last layer.

Muon makes every update of a matrix about as large in all its directions. On pushes, 3,000 steps with it come within 2 %
of what takes AdamW 16,000, for a fifth more time a step (docs/dynamics.md).
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from osfcore.dynamics.propagation_network import PropagationNetwork

_OTHER_RATE = 0.5  # of the matrices' rate
_DECAY, _OTHER_DECAY = 0.1, 1e-4
_CLIP = 5.0
_AVERAGING = 0.998  # of the weights that are kept, from step to step


class Optimizers:
    """A network in training, and the exponential moving average of its weights.

    Attributes:
        network: with its current weights.
        average: with weights averaged over a few hundred steps, which validates better.
    """

    def __init__(self, network: PropagationNetwork, rate: float) -> None:
        """Begin with a network as it is.

        Args:
            network: to train.
            rate: of learning, at its highest.
        """
        self.network, self.average = network, copy.deepcopy(network)
        last = network.decoder[-1]
        assert isinstance(last, nn.Linear)
        inner = [p for p in network.parameters() if p.ndim == 2 and p is not last.weight]
        held = {id(p) for p in inner}
        others = [p for p in network.parameters() if id(p) not in held]
        other_rate = _OTHER_RATE * rate
        self._optimisers = (
            torch.optim.Muon(inner, lr=rate, weight_decay=_DECAY, ns_steps=4, adjust_lr_fn="match_rms_adamw"),
            torch.optim.AdamW(others, lr=other_rate, weight_decay=_OTHER_DECAY),
        )
        self._rates = (rate, other_rate)

    def step(self, loss: Tensor, share: float, done: int) -> None:
        """One optimization step.

        Args:
            loss: to minimise.
            share: of the highest rate.
            done: steps before this one; at the beginning the average forgets faster.
        """
        for optimiser, rate in zip(self._optimisers, self._rates, strict=True):
            optimiser.zero_grad(set_to_none=True)
            for group in optimiser.param_groups:
                group["lr"] = share * rate
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        for optimiser in self._optimisers:
            optimiser.step()
        kept_share = min(_AVERAGING, done / (done + 10))
        with torch.no_grad():
            for kept, new in zip(self.average.parameters(), self.network.parameters(), strict=True):
                kept.lerp_(new, 1 - kept_share)

    def state(self) -> dict[str, Any]:
        """Everything that is needed to go on."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self._optimisers],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        for optimiser, kept in zip(self._optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(kept)
