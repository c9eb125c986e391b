"""Scores of estimates: errors of one frame and of a tracked episode, and figures of many of them.

An object's pose is right if it is off by less than 1 cm and 5 deg, symmetries considered. Whatever an estimator refused
counts as wrong in every share and is left out of medians, which would have no number for it. A wrong first pose stays
wrong in what follows: nothing is put right by the truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.experiments.estimation_tasks import Absence
from osfcore.experiments.statistics import mean
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.metrics.pose_errors import adds, direction_components, rotation_components
from osfcore.objects.asset import ObjectAsset

RIGHT_MM, RIGHT_DEG = 10.0, 5.0
LOST_MM, LOST_DEG = 30.0, 20.0
LOST_STEPS = 2  # running
COVERED = 2.0  # standard deviations; of Gaussian errors .954 lie within them
_POINTS = 2000  # of a mesh that ADD-S looks at
_MOST_RATIO = 1e6  # of an error over a deviation of 0


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """Errors of one object's estimate.

    Attributes:
        name: of the object.
        position_mm: distance from the true position [mm].
        rotation_deg: angle to the nearest orientation that looks like the true one [deg].
        adds_mm: ADD-S [mm].
        position_std_mm: claimed, per axis [mm]; None if it is boundless.
        position_ratios: |error| over the claimed deviation, for each axis.
        rotation_ratios: the same of the rotation vector; two numbers for a body of revolution.
        flagged: the estimator doubts this object; or it doubts the whole without naming an object.
        doubt: why, in its words.
        absent: why no image shows the object; "" where one does.
    """

    name: str
    position_mm: float
    rotation_deg: float
    adds_mm: float
    position_std_mm: float | None
    position_ratios: tuple[float, ...]
    rotation_ratios: tuple[float, ...]
    flagged: bool
    doubt: str
    absent: Absence = ""

    @property
    def is_right(self) -> bool:
        """Whether the pose is off by less than 1 cm and 5 deg."""
        return is_right(self.position_mm, self.rotation_deg)


@dataclass(frozen=True, slots=True)
class FrameScore:
    """Errors of the estimate of one frame or goal.

    Attributes:
        names: the objects in it.
        objects: their scores; none if the frame was refused.
        light_deg: angle between estimated and true light [deg]; None if refused.
        light_ratios: |error| over the claimed deviation, across the true direction; none if the light was given.
        seconds: that the estimate took.
        trusted: by the estimator, as a whole.
        refused: why there is no estimate; "" if there is one.
    """

    names: tuple[str, ...]
    objects: tuple[ObjectScore, ...]
    light_deg: float | None
    light_ratios: tuple[float, ...]
    seconds: float
    trusted: bool
    refused: str = ""

    @property
    def is_right(self) -> bool:
        """Whether all objects are right."""
        return not self.refused and all(score.is_right for score in self.objects)


@dataclass(frozen=True, slots=True)
class TrackScore:
    """Errors of an episode; each list has one row for each step and in it one entry for each object.

    Attributes:
        names: the objects.
        right_at_start: whether their first poses were right.
        position_mm: distances from the true positions [mm].
        rotation_deg: angles, symmetries considered [deg].
        absent: why no image shows an object; "" where one does.
        doubted: whether the estimator doubts an object.
        seconds: that each step's estimate took.
        moved_m: how far each object came from its first place [m].
        refused: why there is no track; "" if there is one.
    """

    names: tuple[str, ...]
    right_at_start: tuple[bool, ...]
    position_mm: tuple[tuple[float, ...], ...]
    rotation_deg: tuple[tuple[float, ...], ...]
    absent: tuple[tuple[Absence, ...], ...]
    doubted: tuple[tuple[bool, ...], ...]
    seconds: tuple[float, ...]
    moved_m: tuple[float, ...]
    refused: str = ""

    @property
    def lost_at(self) -> tuple[int | None, ...]:
        """The step at which the track of each object counts as lost, from 0; None where it is kept."""
        if self.refused:
            return (0,) * len(self.names)
        by_object = (zip(*table, strict=True) for table in (self.position_mm, self.rotation_deg, self.absent))
        return tuple(map(lost_at, *by_object))


def is_right(position_mm: float, rotation_deg: float) -> bool:
    """Return whether a pose is off by less than 1 cm and 5 deg."""
    return position_mm < RIGHT_MM and rotation_deg < RIGHT_DEG


def lost_at(position_mm: Sequence[float], rotation_deg: Sequence[float], absent: Sequence[Absence]) -> int | None:
    """Return the first step at which an object was over 3 cm or 20 deg off for two steps running; None if never.

    Args:
        position_mm: errors, step by step [mm].
        rotation_deg: likewise, symmetries considered [deg].
        absent: why no image shows the object; "" where one does. A step without an image interrupts the run.

    Returns:
        The second of the two steps, from 0.
    """
    run = 0
    for step, (position, rotation, why) in enumerate(zip(position_mm, rotation_deg, absent, strict=True)):
        run = run + 1 if not why and (position > LOST_MM or rotation > LOST_DEG) else 0
        if run == LOST_STEPS:
            return step
    return None


def pose_errors(
    estimate: SceneState, truth: SceneState, assets: Mapping[str, ObjectAsset]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Return the errors of position [mm] and rotation [deg], objects in the order of the estimate.

    Args:
        estimate: poses of objects.
        truth: of the same objects, in any order.
        assets: by name; their symmetries say which rotations look alike.
    """
    shift, turn = [], []
    for name in estimate.names:
        mine, true = estimate.pose(name), truth.pose(name)
        shift.append(1000 * np.linalg.norm(mine.position - true.position))
        symmetry = assets[name].info.symmetry
        turn.append(np.rad2deg(np.linalg.norm(rotation_components(symmetry, mine.quaternion, true.quaternion))))
    return np.array(shift), np.array(turn)


def score_frame(
    estimate: EstimatedState,
    truth: SceneState,
    assets: Mapping[str, ObjectAsset],
    seconds: float,
    absent: Sequence[Absence] | None = None,
) -> FrameScore:
    """Score one estimate.

    Args:
        estimate: of the objects of the truth, in any order.
        truth: poses and light.
        assets: by name.
        seconds: that it took.
        absent: for each object of the truth.
    """
    state = estimate.state
    apart = direction_components(state.light.direction, truth.light.direction)
    nowhere: Sequence[Absence] = ("",) * len(truth.names)
    unseen = dict(zip(truth.names, absent or nowhere, strict=True))
    objects = tuple(_object(estimate, n, truth, assets[name], unseen[name]) for n, name in enumerate(state.names))
    ratios = _ratios(apart, estimate.light_std) if estimate.light_std > 0 else ()
    light_deg = float(np.rad2deg(np.linalg.norm(apart)))
    return FrameScore(state.names, objects, light_deg, ratios, seconds, estimate.trusted)


def refused_frame(names: tuple[str, ...], reason: str, seconds: float) -> FrameScore:
    """Score a frame that the estimator refused.

    Args:
        names: the objects in it.
        reason: why it was refused; not empty.
        seconds: until it was refused [s].
    """
    return FrameScore(names, (), None, (), seconds, False, reason)


def flags(estimate: EstimatedState) -> tuple[bool, ...]:
    """Return which objects the estimator warns of; a warning that names none is one of them all."""
    doubted = tuple(bool(doubt) for doubt in estimate.doubts)
    return doubted if any(doubted) else (not estimate.trusted,) * len(doubted)


def _object(estimate: EstimatedState, n: int, truth: SceneState, asset: ObjectAsset, absent: Absence) -> ObjectScore:
    name = estimate.state.names[n]
    mine, true = estimate.state.pose(name), truth.pose(name)
    shift = mine.position - true.position
    turn = rotation_components(asset.info.symmetry, mine.quaternion, true.quaternion)
    vertices = asset.mesh.vertices
    points = vertices[:: max(1, len(vertices) // _POINTS)].astype(float)
    deviation = float(estimate.position_std[n])
    return ObjectScore(
        name=name,
        position_mm=1000 * float(np.linalg.norm(shift)),
        rotation_deg=float(np.rad2deg(np.linalg.norm(turn))),
        adds_mm=1000 * adds(points, mine, true),
        position_std_mm=1000 * deviation if np.isfinite(deviation) else None,
        position_ratios=_ratios(shift, deviation),
        rotation_ratios=_ratios(turn, float(estimate.rotation_std[n])),
        flagged=flags(estimate)[n],
        doubt=estimate.doubts[n],
        absent=absent,
    )


def _ratios(errors: np.ndarray, deviation: float) -> tuple[float, ...]:
    """Return |error| / deviation; 0 for a boundless deviation."""
    return tuple(np.minimum(np.abs(errors) / max(deviation, 1e-300), _MOST_RATIO).tolist())


# Figures of many scores


def objects_of(frames: Iterable[FrameScore]) -> list[ObjectScore]:
    """Return the scores of all objects that were estimated."""
    return [score for frame in frames for score in frame.objects]


def share_right(frames: Sequence[FrameScore]) -> float | None:
    """Return the share of all objects, also those of refused frames, that are right; None without objects."""
    total = sum(len(frame.names) for frame in frames)
    return sum(score.is_right for score in objects_of(frames)) / total if total else None


@dataclass(frozen=True, slots=True)
class Ratios:
    """|error| over claimed deviation of right estimates, axis by axis.

    Attributes:
        position: of right objects.
        rotation: of right objects.
        light: of frames in which every object is right.
    """

    position: tuple[float, ...]
    rotation: tuple[float, ...]
    light: tuple[float, ...]

    @property
    def pooled(self) -> tuple[float, ...]:
        """All of them in one row."""
        return self.position + self.rotation + self.light


def ratios_of(frames: Sequence[FrameScore]) -> Ratios:
    """Collect the ratios of right estimates: a deviation describes errors around the truth, not gross mistakes."""
    right = [score for score in objects_of(frames) if score.is_right]
    return Ratios(
        tuple(ratio for score in right for ratio in score.position_ratios),
        tuple(ratio for score in right for ratio in score.rotation_ratios),
        tuple(ratio for frame in frames if frame.is_right for ratio in frame.light_ratios),
    )


def coverage(ratios: Iterable[float]) -> float | None:
    """Return the share within two standard deviations; None without ratios."""
    return mean(ratio <= COVERED for ratio in ratios)


def flagged_shares(frames: Sequence[FrameScore]) -> tuple[float | None, float | None]:
    """Return the share of right object estimates that are flagged, and of wrong ones; None without such estimates."""
    scores = objects_of(frames)
    return (
        mean(score.flagged for score in scores if score.is_right),
        mean(score.flagged for score in scores if not score.is_right),
    )
