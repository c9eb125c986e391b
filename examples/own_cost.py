"""The episode of episode.py, planned with a cost of your own. Needs meshes: run `osf assets fetch` first."""

import sys
from pathlib import Path

import episode
import numpy as np

from osfcore import CostInputs, EpisodeParts, Rollouts


class DistanceAtTheEnd:
    """How far the objects end from their goals [m]; rotations do not count."""

    def __init__(self, given: CostInputs) -> None:
        """Made anew for each plan; `given.goal` is where the objects should be."""
        self.goal = given.goal

    def __call__(self, rollouts: Rollouts) -> np.ndarray:
        """One number for each of the K futures; the planner prefers small ones."""
        goals = self.goal.poses_of(rollouts.names).position  # (N, 3)
        ends = rollouts.positions[:, -1]  # (K, N, 3), of positions (K, T + 1, N, 3)
        return np.linalg.norm(ends - goals, axis=-1).sum(axis=1)


if __name__ == "__main__":
    from app.storage.paths import default_data_dir

    objects = Path(sys.argv[1]) if len(sys.argv) > 1 else default_data_dir() / "objects"
    episode.main(objects, parts=EpisodeParts(cost=DistanceAtTheEnd))
