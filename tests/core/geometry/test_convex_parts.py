from itertools import product

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from osfcore.errors import InvalidInput
from osfcore.geometry.convex_parts import MAX_PARTS, MAX_VERTICES, convex_parts, dent_depth_m, reduced_hull
from tests.support.same import assert_same


def clearance_m(point, parts) -> float:
    """Distance from a point to the nearest part's planes; negative inside a part."""
    depths = [(hull.equations[:, :3] @ point + hull.equations[:, 3]).max() for hull in map(ConvexHull, parts)]
    return float(min(depths))


def cut_m(points, kept) -> float:
    """How far the points stick out of the hull of those kept."""
    hull = ConvexHull(kept)
    return float((points @ hull.equations[:, :3].T + hull.equations[:, 3]).max())


def test_points_in_a_plane_have_no_hull_and_no_parts():
    sheet = np.random.default_rng(0).random((30, 3)) * [0.1, 0.1, 0]
    assert reduced_hull(sheet) is None
    with pytest.raises(InvalidInput):
        convex_parts(sheet, np.arange(30).reshape(-1, 3))


@pytest.mark.parametrize("radius", [0.02, 0.05])
def test_reduced_hull_of_a_ball_cuts_off_little(radius):
    points = np.array(trimesh.creation.icosphere(4, radius).vertices)
    kept = reduced_hull(points)
    assert len(kept) <= MAX_VERTICES
    assert cut_m(points, kept) < 1.2e-3
    assert np.linalg.norm(kept, axis=1).max() < radius + 2e-3


def test_reduced_hull_keeps_a_box_exactly():
    box = trimesh.creation.box((0.1, 0.06, 0.04)).subdivide().subdivide()
    kept = reduced_hull(np.array(box.vertices))
    corners = set(product((-0.05, 0.05), (-0.03, 0.03), (-0.02, 0.02)))
    assert {tuple(v) for v in kept.round(6).tolist()} >= corners
    assert ConvexHull(kept).volume == pytest.approx(0.1 * 0.06 * 0.04)


def test_dents_are_measured():
    ball = trimesh.creation.icosphere(4, 0.05)
    assert dent_depth_m(ball.vertices, ball.faces) < 2e-3
    ring = trimesh.creation.annulus(0.04, 0.05, 0.08)
    assert 0.025 < dent_depth_m(ring.vertices, ring.faces) < 0.045  # the middle of the lid is 40 mm from the ring


@pytest.mark.slow
def test_a_ring_stays_open_and_is_the_same_each_time():
    ring = trimesh.creation.annulus(0.04, 0.05, 0.05, sections=48)
    parts = convex_parts(ring.vertices, ring.faces)
    assert 3 <= len(parts) <= MAX_PARTS
    assert clearance_m(np.zeros(3), parts) > 0.03
    assert_same(convex_parts(ring.vertices, ring.faces), parts)


@pytest.mark.parametrize(
    ("name", "counts"), [("003_cracker_box", (1, 1)), ("005_tomato_soup_can", (1, 3)), ("035_power_drill", (4, 9))]
)
def test_parts_of_real_objects(name, counts, library):
    asset = library.load(name)
    low, high = counts
    assert low <= len(asset.parts) <= high
    assert all(4 <= len(part) <= MAX_VERTICES for part in asset.parts)
    body = trimesh.Trimesh(asset.mesh.vertices, asset.mesh.faces, process=False)
    inside = [clearance_m(vertex, asset.parts) for vertex in asset.mesh.vertices[::20]]
    assert np.percentile(inside, 99) < 2e-3  # nearly all of the surface is within the parts
    assert body.convex_hull.volume * 1.05 > sum(ConvexHull(part).volume for part in asset.parts)
