"""An episode's settings as people choose them: the same for the interface, the store and the answers of the service."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import BeforeValidator

from osfcore.control.events import CostKind, EpisodeSettings
from osfcore.errors import InvalidInput
from osfcore.paper.method import Method
from osfcore.paper.mppi import STEPS, GaussianPlanSettings
from osfcore.planning.mppi import PlanSettings

_FIXED = {  # of the method as published: what it is called, and what it cannot but be
    "cost": ("cost", "image"),
    "replan_every": ("actions of each plan", 1),
    "planning": ("planning", True),
    "acting": ("acting", True),
}


@dataclass(frozen=True, slots=True)
class ChosenSettings:
    """How an episode goes: what people choose of `EpisodeSettings` and `PlanSettings`, and the method.

    Attributes:
        method: "ours", or "paper" for the method as published.
        steps: actions at most, counted anew after each disturbance that is noticed.
        replan_every: actions executed of each plan.
        cost: what futures are compared with.
        samples: sequences of actions in each round of a plan.
        horizon: actions in each.
        temperature: of the softmax, as a share of the spread of costs.
        planning: draw plans; where not, the last plan is followed to its end.
        acting: execute plans; where not, the table is only watched.
        despite_doubts: go on with a goal image that is not explained well.
    """

    method: Method
    steps: int
    replan_every: int
    cost: CostKind
    samples: int
    horizon: int
    temperature: float
    planning: bool
    acting: bool
    despite_doubts: bool

    @classmethod
    def defaults(cls, method: Method = "ours") -> ChosenSettings:
        """Return what a method's settings are where nothing is said."""
        loop = EpisodeSettings() if method == "ours" else EpisodeSettings(STEPS, cost="image")
        plan = loop.plan if method == "ours" else GaussianPlanSettings()
        return cls(
            method, loop.steps, loop.replan_every, loop.cost, plan.samples, plan.horizon, plan.temperature,
            loop.planning, loop.acting, loop.despite_doubts,
        )  # fmt: skip

    @classmethod
    def of_stored(cls, stored: Mapping[str, Any]) -> ChosenSettings:
        """Return settings that are stored with a job; earlier versions stored those of the plan by themselves.

        Raises:
            InvalidInput: if a number is out of range.
            TypeError: if there are settings that this version does not have.
        """
        given = {key: value for key, value in stored.items() if key != "plan"}
        return cls.defaults(given.get("method", "ours")).changed({**given, **stored.get("plan", {})})

    def changed(self, changes: Mapping[str, Any]) -> ChosenSettings:
        """Return settings of which some are other ones.

        Raises:
            InvalidInput: if a number is out of range, or the method does not have what is asked for.
            TypeError: if there are settings that this version does not have.
        """
        then = replace(self, **changes)
        if then.method == "paper":
            for name, (what, only) in _FIXED.items():
                if getattr(then, name) != only:
                    raise InvalidInput(what, getattr(then, name), f"{only} with the method as published")
        then.of_loop()
        return then

    def of_loop(self) -> EpisodeSettings:
        """Return the settings of the closed loop.

        Raises:
            InvalidInput: if a number is out of range.
        """
        plan = PlanSettings(samples=self.samples, horizon=self.horizon, temperature=self.temperature)
        return EpisodeSettings(
            self.steps, self.replan_every, self.cost, plan, self.planning, self.acting, self.despite_doubts
        )


StoredSettings = Annotated[
    ChosenSettings,
    BeforeValidator(lambda stored: ChosenSettings.of_stored(stored) if isinstance(stored, Mapping) else stored),
]
