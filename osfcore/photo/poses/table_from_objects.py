"""The table's plane from how objects lie: most stand in a stable orientation, on one plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from osfcore.geometry.poses import Pose, orthogonal_basis
from osfcore.photo.poses.table_prior import TablePrior

_AGREE_DEG = 12.0
_AGREE_M = 0.02
_FEWEST = 2  # objects; one alone does not tell which of its sides is down
_DOWNWARD = np.array([0.0, 1.0, 0.5])  # in a camera's frame: it looks ahead and down


@dataclass(frozen=True, eq=False, slots=True)
class TableGuess:
    """A table that objects lie on.

    Attributes:
        T_world_camera: such that it is z = 0, its origin below the objects' mean.
        spread_deg: of the objects' verticals around their mean, root mean square.
        supported: numbers of the objects that lie on it.
    """

    T_world_camera: Pose
    spread_deg: float
    supported: tuple[int, ...]


def table_from_objects(priors: Sequence[TablePrior], poses: Sequence[Pose]) -> TableGuess | None:
    """The plane that most objects stand on; None if fewer than two agree.

    The vertical is the direction that a stable orientation of most objects agrees with within 12 degrees; the plane is
    at the median of their lowest points, of which those within 2 cm count.

    Args:
        priors: of each object.
        poses: of each object in the camera's frame.
    """
    options = [prior.downs(pose) for prior, pose in zip(priors, poses, strict=True)]
    options = [o[o @ _DOWNWARD > 0] for o in options]
    best: tuple[float, list[tuple[int, np.ndarray]]] = 0.0, []
    for candidate in np.concatenate([np.zeros((0, 3)), *options]):
        agreeing = []
        for number, directions in enumerate(options):
            if len(directions) and (directions @ candidate).max() > np.cos(np.deg2rad(_AGREE_DEG)):
                agreeing.append((number, directions[np.argmax(directions @ candidate)]))
        score = len(agreeing) + float(np.mean([d @ candidate for _, d in agreeing]))
        if score > best[0]:
            best = score, agreeing
    down = np.sum([d for _, d in best[1]], axis=0)
    if len(best[1]) < _FEWEST or np.linalg.norm(down) == 0:
        return None
    down /= np.linalg.norm(down)
    reach = {number: priors[number].extent(poses[number], down) for number, _ in best[1]}
    level = float(np.median(list(reach.values())))
    supported = tuple(number for number, height in reach.items() if abs(height - level) < _AGREE_M)
    if len(supported) < _FEWEST:
        return None
    level = float(np.mean([reach[number] for number in supported]))
    angles = [np.arccos(np.clip(d @ down, -1, 1)) for number, d in best[1] if number in supported]
    spread = float(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))
    return TableGuess(_frame(poses, supported, down, level), spread, supported)


def _frame(poses: Sequence[Pose], supported: tuple[int, ...], down: np.ndarray, level: float) -> Pose:
    """`T_world_camera` with z up, opposite to `down`, and z = 0 at `level` along it."""
    middle = np.mean([poses[number].position for number in supported], axis=0)
    origin = middle + (level - middle @ down) * down
    right, _ = orthogonal_basis(-down)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(-down, right), -down], axis=1)
    matrix[:3, 3] = origin
    return Pose.from_matrix(matrix).inverse()
