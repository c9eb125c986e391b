"""Success of rearrangements: errors of the final state, and what counts as success."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from osfcore.geometry.states import SceneState
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry

OTHERS_M = 0.02  # by which an object that should stay may be off at the end
SUCCESS_M, SUCCESS_DEG = 0.02, 15.0


@dataclass(frozen=True, eq=False, slots=True)
class RearrangementTask:
    """A scene, and how it shall become.

    Attributes:
        number: of the task.
        start: the truth at the beginning, at rest, with the pusher in a free place.
        goal: the truth as it shall be, without pusher, under the same light.
        moved: the objects that shall lie elsewhere: shifted by 7.5 to 20 cm, not turned.
    """

    number: int
    start: SceneState
    goal: SceneState
    moved: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RearrangementScore:
    """How a table ended, against how it should have.

    Attributes:
        moved: how many objects had to move.
        moved_mm: mean distance of these from their goals [mm].
        moved_deg: mean angle likewise, symmetries considered [deg].
        others_mm: largest distance of the others; 0 if there are none [mm].
        pose6d: mean over all objects of the Euclidean distance of position [m] and quaternion, its sign aligned, as one
            vector (the paper's measure).
    """

    moved: int
    moved_mm: float
    moved_deg: float
    others_mm: float
    pose6d: float

    def is_success(self, threshold_m: float = SUCCESS_M, threshold_deg: float = np.inf) -> bool:
        """Whether what had to move has arrived, and nothing else was pushed away."""
        arrived = self.moved_mm <= 1000 * threshold_m and self.moved_deg <= threshold_deg
        return arrived and self.others_mm <= 1000 * OTHERS_M


def score_of(task: RearrangementTask, end: SceneState, symmetries: Mapping[str, Symmetry]) -> RearrangementScore:
    """The score of a rearrangement.

    Args:
        task: start, goal, and which objects had to move, at least one.
        end: the true state at the end.
        symmetries: of every object of the task, by name.
    """
    mm, deg, pose6d = {}, {}, []
    for name in task.start.names:
        here, there = end.pose(name), task.goal.pose(name)
        shift = here.position - there.position
        mm[name] = 1000 * float(np.linalg.norm(shift))
        deg[name] = float(np.rad2deg(rotation_error(symmetries[name], here.quaternion, there.quaternion)))
        sign = 1.0 if here.quaternion @ there.quaternion >= 0 else -1.0
        pose6d.append(float(np.linalg.norm([*shift, *(sign * here.quaternion - there.quaternion)])))
    others = [mm[name] for name in task.start.names if name not in task.moved]
    return RearrangementScore(
        len(task.moved),
        float(np.mean([mm[name] for name in task.moved])),
        float(np.mean([deg[name] for name in task.moved])),
        max(others, default=0.0),
        float(np.mean(pose6d)),
    )
