"""Convex parts that together fill an object, for physics and the prediction of pushes."""

from itertools import product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from osfcore.errors import InvalidInput

MAX_PARTS = 16
MAX_VERTICES = 64
CUT_TOLERANCE_M = 0.5e-3
CONCAVITY = 0.1  # of coacd: five parts for a drill; mugs and bowls stay open
_SHALLOW = 0.07  # dents of this share of the longest side: the rims of cans, the waist of a bottle
_SAMPLES = 20_000


def convex_parts(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], concavity: float = CONCAVITY
) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Return the vertices of convex parts, at most 16 of at most 64 vertices; the same for the same mesh.

    Bodies with shallow dents only, such as cans, are one part: coacd would spend many on the rim of a lid.

    Args:
        vertices: of a mesh in the object frame [m].
        faces: its triangles; holes are closed first.
        concavity: how far a part may bulge over the true surface, relative to the object's size.

    Raises:
        InvalidInput: if no part with a volume comes out.
    """
    vertices = np.asarray(vertices, float)
    longest = float(np.ptp(vertices, axis=0).max())
    is_shallow = dent_depth_m(vertices, faces) <= _SHALLOW * longest
    clouds = [vertices] if is_shallow else _decomposed(vertices, faces, concavity)
    hulls = [reduced_hull(cloud) for cloud in clouds]
    solid = tuple(hull.astype(np.float32) for hull in hulls if hull is not None)
    if not solid:
        raise InvalidInput("mesh", "without volume", "a solid body")
    return solid


def dent_depth_m(vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Return how far the convex hull's surface lies from the mesh [m], for all but its deepest hundredth."""
    import trimesh
    from scipy.spatial import KDTree

    body = trimesh.Trimesh(vertices, faces, process=False)
    try:
        hull = trimesh.Trimesh(vertices, ConvexHull(vertices).simplices, process=False)
    except QhullError as error:
        raise InvalidInput("mesh", "without volume", "a solid body") from error
    surface = trimesh.sample.sample_surface(body, _SAMPLES, seed=0)[0]
    around = trimesh.sample.sample_surface(hull, _SAMPLES // 4, seed=0)[0]
    return float(np.percentile(KDTree(np.concatenate([surface, vertices])).query(around)[0], 99))


def _decomposed(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], concavity: float
) -> list[Float[np.ndarray, "Q 3"]]:
    import coacd

    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=concavity,
        max_convex_hull=MAX_PARTS,
        preprocess_resolution=30,
        mcts_iterations=60,
        mcts_max_depth=2,
        seed=0,
    )
    return [np.asarray(points) for points, _ in parts]


def reduced_hull(
    points: Float[np.ndarray, "P 3"], max_vertices: int = MAX_VERTICES, tolerance_m: float = CUT_TOLERANCE_M
) -> Float[np.ndarray, "M 3"] | None:
    """Return a convex hull of few vertices around points, or None if they span no volume.

    Starts from the extremes along 13 axes and adds the point that sticks out most, again and again. Where
    `max_vertices` do not suffice, the hull is swollen by half of what still sticks out, or until only about twice the
    tolerance does.

    Args:
        points: what it shall enclose [m].
        max_vertices: where adding stops; the first extremes, at most 26, stay in any case.
        tolerance_m: by which points may stick out [m].

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
            if outside[worst] <= tolerance_m or len(chosen) >= max_vertices:
                break
            chosen = np.append(chosen, worst)
            hull.add_points(points[[worst]])
    except QhullError:
        return None
    kept = points[chosen]
    if outside[worst] > tolerance_m:
        centre = kept.mean(axis=0)
        radius = np.linalg.norm(kept - centre, axis=1, keepdims=True)
        swelling = max(outside[worst] / 2, outside[worst] - 2 * tolerance_m)
        kept = centre + (kept - centre) * (1 + swelling / radius)
    return kept
