"""What can be chosen about an episode, also while it runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from osfcore.errors import InvalidInput, check_ranges
from osfcore.planning.mppi import PlanSettings

CostKind = Literal["pose", "image"]
MAX_STEPS = 1000


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """How an episode goes.

    Attributes:
        steps: actions at most, counted anew after each disturbance that is noticed. The paper has 30.
        replan_every: actions executed of each plan (the paper's r).
        cost: "pose" compares futures with the goal's poses, "image" their renderings with the goal image (the paper's).
        plan: how pushes are planned.
        planning: draw plans; where not, the last plan is followed to its end.
        acting: execute plans; where not, the world is only watched.
        despite_doubts: go on with a goal image that is not explained well.
        reached_m: objects this close to their goals have arrived [m].
        reached_rad: likewise for orientations [rad].
        renewed: count steps anew after disturbances; off where the number of actions is what is measured.
    """

    steps: int = 100
    replan_every: int = 1
    cost: CostKind = "pose"
    plan: PlanSettings = field(default_factory=PlanSettings)
    planning: bool = True
    acting: bool = True
    despite_doubts: bool = False
    reached_m: float = 0.008
    reached_rad: float = 0.06
    renewed: bool = True

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_ranges(
            ("number of steps", self.steps, 1, MAX_STEPS),
            ("actions of each plan", self.replan_every, 1, MAX_STEPS),
            ("distance that counts as arrived [m]", self.reached_m, 0.0, 0.1),
            ("angle that counts as arrived [rad]", self.reached_rad, 0.0, 3.2),
        )
        if self.cost not in ("pose", "image"):
            raise InvalidInput("cost", repr(self.cost), '"pose" or "image"')
