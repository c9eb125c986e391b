"""One object, searched by CMA from several starts at once inside its masks (paper eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.estimate.evolution import Evolution
from osfcore.estimate.masked import look_at, masked_loss
from osfcore.estimate.models import Models
from osfcore.estimate.starts import Starts
from osfcore.estimate.tangent import LIGHT, Guess
from osfcore.estimate.views import Part
from osfcore.poses import Pose

SHIFT_M, TURN_RAD = 4e-3, 0.12  # the first spread


@dataclass(frozen=True, eq=False, slots=True)
class Generation:
    """What was tried.

    Attributes:
        candidates: poses, of all starts together.
        loss: of the best.
        sigma: step of the first start's search, 1 at the beginning.
    """

    candidates: Pose
    loss: float
    sigma: float


class Swarm:
    """Searches around each of an object's starts.

    Args:
        models: fields.
        name: of the object.
        part: where it was observed.
        starts: where to begin.
        light: unit vector toward the light.
        population: candidates per generation and start.
        rng: of the searches.
        any_brightness: the light is not known yet, see `masked_loss`.
    """

    def __init__(
        self, models: Models, name: str, part: Part, starts: Starts, light: Float[np.ndarray, "3"], *, population: int,
        rng: np.random.Generator, any_brightness: bool,
    ) -> None:  # fmt: skip
        self._models, self._name, self._part, self._starts, self._light = models, name, part, starts, light
        self._any_brightness = any_brightness
        scales = np.array([SHIFT_M] * 3 + [TURN_RAD] * 3 + [0.0] * LIGHT)
        begun = zip(starts.positions, starts.quaternions, strict=True)
        self._guesses = [Guess((name,), p[None], q[None], light, None) for p, q in begun]
        self._searches = [Evolution(scales, population, rng) for _ in self._guesses]

    def advance(self) -> Generation:
        """Try one more generation of every search."""
        batches = [g.moved(s.ask()) for g, s in zip(self._guesses, self._searches, strict=True)]
        positions = np.concatenate([b.positions[:, 0] for b in batches])
        quaternions = np.concatenate([b.quaternions[:, 0] for b in batches])
        look = look_at(self._models, self._name, self._part, positions, quaternions, self._light)
        losses = masked_loss(look, self._part, any_brightness=self._any_brightness)
        for search, own in zip(self._searches, losses.reshape(len(batches), -1), strict=True):
            search.tell(own)
        return Generation(Pose(positions, quaternions), float(losses.min()), self._searches[0].sigma)

    def ends(self) -> Pose:
        """The starts, and where each search is now."""
        now = [g.changed(s.mean) for g, s in zip(self._guesses, self._searches, strict=True)]
        return Pose(
            np.concatenate([self._starts.positions, *(g.positions for g in now)]),
            np.concatenate([self._starts.quaternions, *(g.quaternions for g in now)]),
        )
