"""CMA-ES (Hansen, 2016, arXiv 1604.00772) by the `cma` library, in its ask-and-tell form.

Candidates x_k ~ m + sigma N(0, C); the mean m moves to the weighted mean of the better half, and C and sigma adapt to
the steps that succeeded.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from jaxtyping import Float


class CMAES:
    """One search that starts at zero.

    Args:
        scales: what one standard deviation is in each number of the vector; 0 holds a number still.
        population: candidates per generation.
        rng: all randomness.
    """

    def __init__(self, scales: Float[np.ndarray, "P"], population: int, rng: np.random.Generator) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it misses matplotlib, which is for its own plots
            import cma

        self._free = np.flatnonzero(scales)
        self._scales = np.asarray(scales, float)
        # Its own seed would seed numpy's global generator; nan leaves that alone.
        options = {"popsize": population, "randn": lambda *shape: rng.standard_normal(shape), "seed": math.nan,
                   "verbose": -9, "verb_log": 0}  # fmt: skip
        self._strategy = cma.CMAEvolutionStrategy(np.zeros(len(self._free)), 1.0, options)
        self._asked: list[np.ndarray] = []

    def ask(self) -> Float[np.ndarray, "B P"]:
        """The next generation."""
        self._asked = self._strategy.ask()
        return self._full(np.array(self._asked))

    def tell(self, losses: Float[np.ndarray, "B"]) -> None:
        """Losses of the generation that was asked for last; infinite ones count as very bad."""
        self._strategy.tell(self._asked, np.nan_to_num(losses, nan=1e9, posinf=1e9).tolist())

    @property
    def mean(self) -> Float[np.ndarray, "P"]:
        """The centre of the distribution."""
        return self._full(np.asarray(self._strategy.mean)[None])[0]

    @property
    def sigma(self) -> float:
        """The overall step, 1 at the beginning."""
        return float(self._strategy.sigma)

    def _full(self, short: np.ndarray) -> np.ndarray:
        full = np.zeros((len(short), len(self._scales)))
        full[:, self._free] = short * self._scales[self._free]
        return full
