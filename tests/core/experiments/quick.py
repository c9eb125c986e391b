"""Settings with which estimators are measured in seconds; what they find is not good."""

from pathlib import Path
from typing import Any

from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.goal_image import GoalImageConfig
from osfcore.estimation.tracking import TrackingConfig
from osfcore.experiments.estimation import EvaluateEstimate
from tests.core.experiments.solids import SOLIDS

EFFORT = FirstFrameConfig(
    starts=1, population=4, generations=1, joint_population=4, joint_generations=1, coarse_iterations=1,
    fine_iterations=1,
)  # fmt: skip
TRACK = TrackingConfig(sweeps=1, population=4, generations=1)
GOAL = GoalImageConfig(side=64, planar_iterations=1, free_iterations=1)


def quick(out: Path, **settings: Any) -> EvaluateEstimate:
    """Two solids in small images."""
    return EvaluateEstimate(
        out, **{"objects": 2, "names": SOLIDS, "steps": 2, "size": 48, "effort": EFFORT, "track": TRACK, "goal": GOAL,
                **settings},
    )  # fmt: skip
