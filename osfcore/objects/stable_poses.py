"""Orientations in which an object comes to rest on a plane."""

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import quaternion_from_matrix
from osfcore.objects.asset import RestingPoses

MIN_PROBABILITY = 0.03
MAX_POSES = 12
_SAME_DOWN_RAD = 0.35  # the facets of a rolling can lie closer together than this


def resting_poses(parts: tuple[Float[np.ndarray, "_ 3"], ...]) -> RestingPoses:
    """Orientations at rest on a plane, for a body of uniform density made of convex parts.

    Poses that differ by a turn about the vertical, or by less than 20 degrees in what points down, count as one; those
    that a random drop hardly ever ends in are left out.

    Raises:
        InvalidInput: if the parts span no volume.
    """
    import trimesh

    hulls = [trimesh.convex.convex_hull(part) for part in parts]
    volumes = np.array([hull.volume for hull in hulls])
    if not volumes.sum() > 0:
        raise InvalidInput("collision parts", "without volume", "solid bodies")
    centre = volumes @ np.array([hull.center_mass for hull in hulls]) / volumes.sum()
    whole = trimesh.convex.convex_hull(np.concatenate(parts))
    transforms, probabilities = trimesh.poses.compute_stable_poses(whole, center_mass=centre)
    downs = -transforms[:, 2, :3]
    order = np.lexsort((*np.round(downs.T, 6), -np.round(probabilities, 6)))
    kept: list[int] = []
    sums: list[float] = []
    for i in order:
        near = [k for k, j in enumerate(kept) if downs[i] @ downs[j] > np.cos(_SAME_DOWN_RAD)]
        if near:
            sums[near[0]] += float(probabilities[i])
        else:
            kept.append(int(i))
            sums.append(float(probabilities[i]))
    return _likeliest(transforms[kept, :3, :3], np.array(sums))


def _likeliest(rotations: Float[np.ndarray, "K 3 3"], probabilities: Float[np.ndarray, "K"]) -> RestingPoses:
    order = np.argsort(-probabilities, kind="stable")[:MAX_POSES]
    order = order[probabilities[order] >= min(MIN_PROBABILITY, probabilities.max())]
    chosen = probabilities[order]
    return RestingPoses(quaternion_from_matrix(rotations[order]), chosen / chosen.sum())
