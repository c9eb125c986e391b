"""How well the pushes are predicted that the planner itself makes, from estimated poses.

Open-loop evaluations start from true poses and take pushes of a random pusher; a planner sees neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from osfcore.control.scene_models import SceneModels
from osfcore.experiments.dynamics.scores import MOVED_DEG, MOVED_MM
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry

AHEAD = 4  # actions


@dataclass(slots=True)
class Course:
    """An episode as it went: grows while it runs.

    Attributes:
        actions: by their number, from 1 [m/s].
        estimated: states by the number of actions before them.
        true: likewise.
    """

    actions: dict[int, Float[np.ndarray, "3"]] = field(default_factory=dict)
    estimated: dict[int, SceneState] = field(default_factory=dict)
    true: dict[int, SceneState] = field(default_factory=dict)


def prediction_errors(course: Course, models: SceneModels) -> dict[str, list[float]]:
    """Errors four actions ahead of all objects that truly moved by over 1 cm or 5 deg meanwhile.

    Args:
        course: of the episode.
        models: of its objects.

    Returns:
        "mm" and "deg", symmetries considered, one entry for each object and start.
    """
    told: dict[str, list[float]] = {"mm": [], "deg": []}
    for start, state in sorted(course.estimated.items()):
        numbers = range(start + 1, start + AHEAD + 1)
        if start + AHEAD not in course.true or any(number not in course.actions for number in numbers):
            continue
        actions = np.array([course.actions[number] for number in numbers])
        rollouts = models.dynamics.rollout(state, actions[None], course.estimated.get(start - 1))
        before, after = course.true[start], course.true[start + AHEAD]
        for n, name in enumerate(rollouts.names):
            way = _apart(models.symmetries, name, before.pose(name), after.pose(name))
            if way[0] > MOVED_MM or way[1] > MOVED_DEG:
                predicted = Pose(rollouts.positions[0, AHEAD, n], rollouts.quaternions[0, AHEAD, n])
                mm, deg = _apart(models.symmetries, name, predicted, after.pose(name))
                told["mm"].append(round(mm, 3))
                told["deg"].append(round(deg, 3))
    return told


def _apart(symmetries: Mapping[str, Symmetry], name: str, one: Pose, other: Pose) -> tuple[float, float]:
    """Distance [mm] and angle [deg] between two poses of an object."""
    mm = 1000 * float(np.linalg.norm(one.position - other.position))
    return mm, float(np.rad2deg(rotation_error(symmetries[name], one.quaternion, other.quaternion)))
