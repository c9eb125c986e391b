import numpy as np
import pytest
import trimesh

from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.world.imaging import pusher_mesh


def test_pusher_is_a_closed_cylinder_of_the_stated_size():
    mesh = pusher_mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    solid.merge_vertices(merge_norm=True, merge_tex=True)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(np.pi * PUSHER_RADIUS_M**2 * PUSHER_HEIGHT_M, rel=2e-3)
    np.testing.assert_allclose(solid.extents, [2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M], rtol=1e-5)
    np.testing.assert_allclose(solid.bounds.mean(axis=0), 0, atol=1e-7)


def test_normals_are_unit_and_outward_and_the_wall_is_round():
    mesh = pusher_mesh()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    corners = mesh.vertices[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("ij,ij->i", flat, mesh.normals[mesh.faces[:, 0]]) > 0)


def test_colour_is_the_stated_albedo():
    np.testing.assert_allclose(pusher_mesh().texture[0, 0] / 255, PUSHER_ALBEDO, atol=1 / 255)
