"""Errors of the final state of a rearrangement, and whether it is a success."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from osfcore.geometry.poses import rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry

SUCCESS_M = 0.02
TIGHT_DEG = float(np.rad2deg(0.1))  # with 2 cm: the thresholds of Push Anything (arXiv 2510.19974)


@dataclass(frozen=True, eq=False, slots=True)
class RearrangementTask:
    """A scene and its goal.

    Attributes:
        number: number of the task.
        start: the truth at the beginning, at rest, with the pusher in a free place.
        goal: the true goal, without pusher, under the light of the goal image.
        moved: the objects whose goals lie elsewhere.
    """

    number: int
    start: SceneState
    goal: SceneState
    moved: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """The final errors of one object.

    Attributes:
        name: name of the object.
        had_to_move: whether its goal lay elsewhere.
        mm: distance from its goal [mm].
        deg: angle likewise, symmetries considered [deg].
        pose6d: distance of (position [m], quaternion with its sign aligned) as one vector: the paper's measure.
        pose6d_symmetric: the same from the nearest orientation that looks like the goal's.
    """

    name: str
    had_to_move: bool
    mm: float
    deg: float
    pose6d: float
    pose6d_symmetric: float

    def is_within(self, threshold_m: float, threshold_deg: float) -> bool:
        """Whether its errors are at most the thresholds [m, deg]."""
        return self.mm <= 1000 * threshold_m and self.deg <= threshold_deg

    def is_tight(self) -> bool:
        """Whether it is within 2 cm and 0.1 rad."""
        return self.is_within(SUCCESS_M, TIGHT_DEG)


@dataclass(frozen=True, slots=True)
class RearrangementScore:
    """The final errors of all objects of a table."""

    objects: tuple[ObjectScore, ...]

    @property
    def moved(self) -> tuple[ObjectScore, ...]:
        """The objects that had to move."""
        return tuple(one for one in self.objects if one.had_to_move)

    @property
    def moved_mm(self) -> float:
        """Mean distance of the objects that had to move from their goals [mm]."""
        return float(np.mean([one.mm for one in self.moved]))

    @property
    def moved_deg(self) -> float:
        """Mean angle of the objects that had to move from their goals [deg]."""
        return float(np.mean([one.deg for one in self.moved]))

    @property
    def others_mm(self) -> float:
        """Largest distance of the objects that should have stayed from their places; 0 if there are none [mm]."""
        return max((one.mm for one in self.objects if not one.had_to_move), default=0.0)

    @property
    def pose6d(self) -> float:
        """Mean of the paper's measure over all objects."""
        return float(np.mean([one.pose6d for one in self.objects]))

    @property
    def pose6d_symmetric(self) -> float:
        """Mean of the paper's measure over all objects, symmetries considered."""
        return float(np.mean([one.pose6d_symmetric for one in self.objects]))

    def is_success(self, threshold_m: float = SUCCESS_M, threshold_deg: float = np.inf) -> bool:
        """Whether every object that had to move has arrived.

        Nothing else may have been displaced by more than 2 cm, nor be turned by more than the threshold.
        """
        limits_m = (threshold_m if one.had_to_move else SUCCESS_M for one in self.objects)
        return all(one.is_within(limit, threshold_deg) for one, limit in zip(self.objects, limits_m, strict=True))

    def is_tight(self) -> bool:
        """Whether everything is within 2 cm and 0.1 rad."""
        return self.is_success(SUCCESS_M, TIGHT_DEG)

    def to_json(self) -> dict[str, Any]:
        """Return the objects and the figures over all of them as plain JSON."""
        keys = ("moved_mm", "moved_deg", "others_mm", "pose6d", "pose6d_symmetric")
        return {**asdict(self), "moved": len(self.moved), **{key: getattr(self, key) for key in keys}}


def score_of(task: RearrangementTask, end: SceneState, symmetries: Mapping[str, Symmetry]) -> RearrangementScore:
    """Return the score of a rearrangement.

    Args:
        task: start, goal, and which objects had to move, at least one.
        end: the true state at the end.
        symmetries: symmetries of every object of the task, by name.
    """
    objects = []
    for name in task.start.names:
        here, there = end.pose(name), task.goal.pose(name)
        shift = float(np.linalg.norm(here.position - there.position))
        plain = float(rotation_angle(here.quaternion, there.quaternion))
        alike = rotation_error(symmetries[name], here.quaternion, there.quaternion)
        # Two unit quaternions, the nearer of both signs, whose rotations differ by an angle are 2 sin(angle / 4) apart.
        distances = (float(np.hypot(shift, float(2 * np.sin(angle / 4)))) for angle in (plain, alike))
        objects.append(ObjectScore(name, name in task.moved, 1000 * shift, float(np.rad2deg(alike)), *distances))
    return RearrangementScore(tuple(objects))
