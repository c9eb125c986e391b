"""CMA-ES over one object's pose from several starts at once, by the masked loss (paper eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.masked_loss import masked_loss, render_poses
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObjectView
from osfcore.estimation.objective.parametrization import LIGHT, SceneParameters
from osfcore.estimation.search.cma_es import CMAES
from osfcore.estimation.search.pose_initialization import RankedPoses
from osfcore.geometry.poses import Pose

SHIFT_M, TURN_RAD = 4e-3, 0.12  # the first spread


@dataclass(frozen=True, eq=False, slots=True)
class CMAGeneration:
    """One generation of all searches.

    Attributes:
        candidates: poses, of all starts together.
        loss: of the best.
        sigma: step of the first start's search, 1 at the beginning.
    """

    candidates: Pose
    loss: float
    sigma: float


class MultistartCMA:
    """One CMA-ES for each start of an object; a generation of all is rendered as one batch.

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
        self,
        models: ObjectModels,
        name: str,
        part: ObjectView,
        starts: RankedPoses,
        light: Float[np.ndarray, "3"],
        *,
        population: int,
        rng: np.random.Generator,
        any_brightness: bool,
    ) -> None:
        self._models, self._name, self._part, self._starts, self._light = models, name, part, starts, light
        self._any_brightness = any_brightness
        scales = np.array([SHIFT_M] * 3 + [TURN_RAD] * 3 + [0.0] * LIGHT)
        begun = zip(starts.positions, starts.quaternions, strict=True)
        self._guesses = [SceneParameters((name,), p[None], q[None], light, None) for p, q in begun]
        self._searches = [CMAES(scales, population, rng) for _ in self._guesses]

    def advance(self) -> CMAGeneration:
        """One more generation of every search."""
        batches = [g.perturbed(s.ask()) for g, s in zip(self._guesses, self._searches, strict=True)]
        positions = np.concatenate([b.positions[:, 0] for b in batches])
        quaternions = np.concatenate([b.quaternions[:, 0] for b in batches])
        look = render_poses(self._models, self._name, self._part, positions, quaternions, self._light)
        losses = masked_loss(look, self._part, any_brightness=self._any_brightness)
        for search, own in zip(self._searches, losses.reshape(len(batches), -1), strict=True):
            search.tell(own)
        return CMAGeneration(Pose(positions, quaternions), float(losses.min()), self._searches[0].sigma)

    def best_poses(self) -> Pose:
        """The starts, and the mean of each search."""
        now = [g.updated(s.mean) for g, s in zip(self._guesses, self._searches, strict=True)]
        return Pose(
            np.concatenate([self._starts.positions, *(g.positions for g in now)]),
            np.concatenate([self._starts.quaternions, *(g.quaternions for g in now)]),
        )
