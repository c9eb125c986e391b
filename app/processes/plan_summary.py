"""What a picture shows of a planning round: some of the ways that were thought of, and the best future."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.geometry.rollouts import Rollouts
from osfcore.planning.mppi import PlanRound

WAYS = 24  # of the pusher that are kept


@dataclass(frozen=True, eq=False, slots=True)
class PlanSketch:
    """A round of planning, as much of it as a picture shows.

    Attributes:
        step: actions executed so far.
        ways: where the pusher would go, cheapest first [m].
        costs: theirs, ascending.
        best: the cheapest future, K = 1.
    """

    step: int
    ways: Float[np.ndarray, "W T1 2"]
    costs: Float[np.ndarray, "W"]
    best: Rollouts


def sketch_of(step: int, round_: PlanRound) -> PlanSketch:
    """The best future, and ways spread evenly from the cheapest to the dearest."""
    order = np.argsort(round_.costs, kind="stable")
    chosen = order[np.round(np.linspace(0, len(order) - 1, min(WAYS, len(order)))).astype(int)]
    ways = round_.rollouts.pusher[chosen, :, :2].astype(np.float32)
    return PlanSketch(step, ways, round_.costs[chosen], round_.best)
