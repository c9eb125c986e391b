"""Convex parts that together fill an object, for physics and the prediction of pushes."""

from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, KDTree, QhullError

from osfcore.errors import InvalidInput

MAX_PARTS = 16
MAX_VERTICES = 64
CUT_TOLERANCE_M = 0.5e-3
_CONCAVITY = 0.1  # how far parts may bulge, relative to the object: five parts for a drill; mugs and bowls stay open
_SHALLOW = 0.07  # dents of this share of the longest side: the rims of cans, the waist of a bottle
_SAMPLES = 20_000


def convex_parts(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Return the vertices of convex parts, at most 16 of at most 64 vertices; the same for the same mesh.

    Bodies with shallow dents only, such as cans, are one part: coacd would spend many on the rim of a lid.

    Args:
        vertices: vertices of a mesh in the object frame [m].
        faces: its triangles; holes are closed first.

    Raises:
        InvalidInput: if no part with a volume comes out.
    """
    vertices = np.asarray(vertices, float)
    longest = float(np.ptp(vertices, axis=0).max())
    is_shallow = dent_depth_m(vertices, faces) <= _SHALLOW * longest
    clouds = [vertices] if is_shallow else _decomposed(vertices, faces)
    solid = tuple(hull.astype(np.float32) for hull in map(reduced_hull, clouds) if hull is not None)
    if not solid:
        raise InvalidInput("mesh", "without volume", "a solid body")
    return solid


def dent_depth_m(vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Return how far the convex hull's surface lies from the mesh [m], for all but its deepest hundredth."""
    import trimesh

    body = trimesh.Trimesh(vertices, faces, process=False)
    try:
        hull = trimesh.Trimesh(vertices, ConvexHull(vertices).simplices, process=False)
    except QhullError as error:
        raise InvalidInput("mesh", "without volume", "a solid body") from error
    surface = trimesh.sample.sample_surface(body, _SAMPLES, seed=0)[0]
    around = trimesh.sample.sample_surface(hull, _SAMPLES // 4, seed=0)[0]
    return float(np.percentile(KDTree(np.concatenate([surface, vertices])).query(around)[0], 99))


def _decomposed(vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"]) -> list[Float[np.ndarray, "_ 3"]]:
    import coacd

    coacd.set_log_level("off")
    effort: dict[str, Any] = {"preprocess_resolution": 30, "mcts_iterations": 60, "mcts_max_depth": 2}
    mesh = coacd.Mesh(vertices, faces)
    parts = coacd.run_coacd(mesh, threshold=_CONCAVITY, max_convex_hull=MAX_PARTS, seed=0, **effort)
    return [np.asarray(points) for points, _ in parts]


def reduced_hull(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "M 3"] | None:
    """Return a convex hull of at most 64 vertices around points, or None if they span no volume.

    Starts from the extremes along 13 axes and adds the point that sticks out most, until none does by more than 0.5 mm.
    Where 64 do not suffice, the hull is swollen by half of what still sticks out, or until only about 1 mm does.

    Args:
        points: what it shall enclose [m].

    Returns:
        Vertices of the hull: some of the points, moved outward if it was swollen.
    """
    try:
        points = points[ConvexHull(points).vertices]
        axes = np.array([axis for axis in product((-1, 0, 1), repeat=3) if any(axis)])
        chosen = np.unique((points @ axes.T).argmax(axis=0))
        hull = ConvexHull(points[chosen], incremental=True)
        while True:
            outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
            worst = int(outside.argmax())
            if outside[worst] <= CUT_TOLERANCE_M or len(chosen) >= MAX_VERTICES:
                break
            chosen = np.append(chosen, worst)
            hull.add_points(points[[worst]])
    except QhullError:
        return None
    kept = points[chosen]
    if outside[worst] > CUT_TOLERANCE_M:
        centre = kept.mean(axis=0)
        radius = np.linalg.norm(kept - centre, axis=1, keepdims=True)
        swelling = max(outside[worst] / 2, outside[worst] - 2 * CUT_TOLERANCE_M)
        kept = centre + (kept - centre) * (1 + swelling / radius)
    return kept
