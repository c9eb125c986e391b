import numpy as np
import pytest

from osfcore.world import bounding_boxes
from osfcore.world.imaging import TracedMesh

embree = pytest.importorskip("osfcore.world.embree", exc_type=ImportError)


@pytest.fixture(scope="module", params=["035_power_drill", "006_mustard_bottle"])
def both(request, library):
    """An object for each of the two ways to trace it."""
    mesh = library.load(request.param).mesh
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    return bounding_boxes.Triangles(vertices, faces), embree.Triangles(vertices, faces)


@pytest.fixture
def rays():
    """From half a metre away and from inside, to all sides."""
    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(4000, 3))
    eyes *= 0.5 / np.linalg.norm(eyes, axis=1, keepdims=True)
    eyes[::10] *= 0.01
    return eyes.astype(np.float32), (rng.uniform(-0.15, 0.15, (4000, 3)) - eyes).astype(np.float32)


def test_rays_meet_what_they_meet_with_embree(both, rays):
    (distance, faces, weights), (same_distance, same_faces, same_weights) = (one.intersect(*rays) for one in both)
    assert (faces >= 0).sum() > 500
    assert ((faces >= 0) == (same_faces >= 0)).mean() > 0.999
    hit = faces == same_faces
    assert hit.mean() > 0.998
    np.testing.assert_allclose(distance[hit], same_distance[hit], rtol=0, atol=1e-4)
    assert np.median(np.abs(weights - same_weights)[hit & (faces >= 0)]) < 1e-4
    assert np.all(np.isinf(distance[faces < 0]))


@pytest.mark.parametrize("end", [None, 0.9])
def test_shadows_fall_where_they_fall_with_embree(both, rays, end):
    blocked, same_blocked = (one.occludes(*rays, end) for one in both)
    assert 0.1 < blocked.mean() < 0.9
    assert (blocked == same_blocked).mean() > 0.999


def test_rays_along_the_sides_of_a_box_hit_it():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]], np.int32)
    eyes = np.array([[-1, 0.5, 0.5], [-1, 0, 0.5], [-1, 1, 1], [-1, 1.1, 0.5]], np.float32)
    along = np.tile(np.array([1, 0, 0], np.float32), (4, 1))
    distance, _, _ = bounding_boxes.Triangles(corners, faces).intersect(eyes, along)
    np.testing.assert_array_equal(distance, [1, 1, 1, np.inf])


def test_pictures_are_traced_by_embree_where_it_is_installed():
    assert issubclass(TracedMesh, embree.Triangles)
