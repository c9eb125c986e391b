"""What a closed loop is made of besides its models, and estimators by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from osfcore.control.estimators import Estimators
from osfcore.planning.parts import CostInputs, Planner, PlannerInputs, mppi
from osfcore.planning.pose_cost import Cost
from osfcore.plugins import PartKind

ESTIMATOR = PartKind("estimator", ("first_frame", "later_frame"))


def _ours(_data_dir: Path) -> Estimators:
    return Estimators()


ESTIMATORS: Mapping[str, Callable[[Path], Estimators]] = {"ours": _ours}  # from the data directory


@dataclass(frozen=True, slots=True)
class EpisodeParts:
    """Parts of a closed loop that can be replaced.

    Attributes:
        estimators: how everything is estimated.
        planner: makes what decides about actions.
        cost: makes what compares futures, anew for each plan; None for what the settings say.
    """

    estimators: Estimators = field(default_factory=Estimators)
    planner: Callable[[PlannerInputs], Planner] = mppi
    cost: Callable[[CostInputs], Cost] | None = None
