"""How far an estimated pose is from the true one, in the measures of the field (BOP; ADD-S after Hinterstoisser)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from osfcore.objects.asset import Symmetry
from osfcore.poses import Pose, quaternion_multiply, rotate, rotation_angle


def rotation_error(symmetry: Symmetry, estimated: Float[np.ndarray, "4"], true: Float[np.ndarray, "4"]) -> float:
    """The least angle [rad] by which an orientation is off, over all orientations that look like the true one.

    Args:
        symmetry: of the object; for a body of revolution only the tilt of its axis counts.
        estimated: rotation from the object's frame to the world, unit.
        true: the same.
    """
    if symmetry.kind == "continuous":
        a, b = (rotate(q, np.asarray(symmetry.axis)) for q in (estimated, true))
        return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
    alike = [true, *(quaternion_multiply(true, np.asarray(turn)) for turn in symmetry.rotations)]
    return float(min(rotation_angle(np.asarray(estimated), other) for other in alike))


def adds(points: Float[np.ndarray, "P 3"], estimated: Pose, true: Pose) -> float:
    """ADD-S [m]: mean distance from the object's points, where they are, to the nearest ones where they are thought.

    Args:
        points: on the object's surface, in its frame [m].
        estimated: `T_world_object`.
        true: the same.
    """
    distances, _ = KDTree(estimated.apply(points)).query(true.apply(points))
    return float(np.mean(distances))
