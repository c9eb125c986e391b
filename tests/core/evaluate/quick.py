"""Settings with which estimators are measured in seconds; what they find is not good."""

from pathlib import Path
from typing import Any

from osfcore.estimate.first import Effort
from osfcore.estimate.goal import GoalEffort
from osfcore.estimate.track import TrackEffort
from osfcore.evaluate.estimate_parts import EvaluateEstimate
from tests.core.evaluate.solids import SOLIDS

EFFORT = Effort(
    starts=1, population=4, generations=1, joint_population=4, joint_generations=1, coarse_iterations=1,
    fine_iterations=1,
)  # fmt: skip
TRACK = TrackEffort(sweeps=1, population=4, generations=1)
GOAL = GoalEffort(side=64, planar_iterations=1, free_iterations=1)


def quick(out: Path, **settings: Any) -> EvaluateEstimate:
    """Two solids in small images."""
    return EvaluateEstimate(
        out, **{"objects": 2, "names": SOLIDS, "steps": 2, "size": 48, "effort": EFFORT, "track": TRACK, "goal": GOAL,
                **settings},
    )  # fmt: skip
