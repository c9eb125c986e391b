"""What an episode is made of, by name."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from osfcore.control.estimators import ESTIMATOR, ESTIMATORS, EpisodeParts
from osfcore.planning.parts import COST, COSTS, PLANNER, PLANNERS
from osfcore.plugins import part_factory


@dataclass(frozen=True, slots=True)
class PartNames:
    """Parts of an episode by name, ours or those of other packages.

    Attributes:
        world: what is pushed.
        estimator: what looks.
        planner: what plans.
        cost: what compares futures; None for what the settings say.
    """

    world: str = "simulated"
    estimator: str = "ours"
    planner: str = "mppi"
    cost: str | None = None

    def to_json(self) -> dict[str, str]:
        """Those that are named."""
        return {kind: name for kind, name in asdict(self).items() if name is not None}


def parts_of(names: PartNames, data_dir: Path) -> EpisodeParts:
    """What estimates, plans and compares.

    Args:
        names: of the parts.
        data_dir: from which estimators are made.

    Raises:
        UnknownName: if there is no part of a name.
        BrokenPlugin: if another package's cannot be used.
    """
    cost = None if names.cost is None else part_factory(COST, names.cost, COSTS)
    estimators = part_factory(ESTIMATOR, names.estimator, ESTIMATORS)(data_dir)
    return EpisodeParts(estimators, part_factory(PLANNER, names.planner, PLANNERS), cost)
