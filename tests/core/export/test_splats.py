"""Splats as a reader of splats reads them, against the field they came from."""

import gsply
import numpy as np
import pytest

from osfcore.export.splats import field_splats, splats_ply
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.render.reference import render_reference, solid_field

LIGHT = Light(np.array([0.6, -0.4, 1.0]))
HALF = np.array([0.03, 0.02, 0.04])
ALBEDO = (0.8, 0.5, 0.2)


def ellipsoid_field():
    """A matte ellipsoid, whose surface and colours are known."""
    return solid_field(
        lambda x: (1 - np.linalg.norm(x / HALF, axis=-1)) * HALF.min(),
        lambda x: x / HALF**2 / np.maximum(np.linalg.norm(x / HALF**2, axis=-1, keepdims=True), 1e-9),
        HALF, ALBEDO, voxel=0.002, hidden=4,
    )  # fmt: skip


@pytest.fixture(scope="module")
def splats(one_thread):
    return field_splats(ellipsoid_field(), LIGHT)


@pytest.fixture(scope="module")
def read(splats, tmp_path_factory):
    path = tmp_path_factory.mktemp("splats") / "ellipsoid.ply"
    path.write_bytes(splats_ply(splats))
    return gsply.plyread(path)


def test_a_reader_of_splats_finds_the_surface(read):
    np.testing.assert_allclose(np.linalg.norm(read.means / HALF, axis=1), 1, atol=0.05)
    np.testing.assert_allclose(np.abs(read.means).max(axis=0), HALF, atol=0.001)
    assert read.shN.size == 0


def test_discs_lie_in_the_surface_and_cover_it(read):
    axes = quaternion_to_matrix(read.quats)
    normals = read.means / HALF**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.median(np.einsum("ij,ij->i", axes[:, :, 2], normals)) > 0.99
    deviations = np.exp(read.scales)
    np.testing.assert_array_less(deviations[:, 2], deviations[:, 0])
    a, b, c = HALF
    p = 1.6075  # Thomsen's formula
    area = 4 * np.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p)
    assert (np.pi * (2 * deviations[:, 0]) * (2 * deviations[:, 1])).sum() > 2 * area  # within two deviations
    assert (1 / (1 + np.exp(-read.opacities)) > 0.9).all()


def test_colours_are_those_of_the_rendered_image(read):
    camera = Camera.look_at("0", (0.15, -0.1, 0.2), (0, 0, 0), size=48)
    state = SceneState(("solid",), Pose.identity(1), LIGHT, None)
    rendered = render_reference({"solid": ellipsoid_field()}, None, state, camera, outputs={"rgb", "depth", "opacity"})
    pixels = np.floor(camera.project(read.means)).astype(int)
    u, v = pixels.T
    depth = camera.T_world_camera.inverse().apply(read.means)[:, 2]
    seen = (np.abs(depth - rendered.depth[0, 0][v, u]) < 0.003) & (rendered.opacity[0, 0, 0][v, u] > 0.95)
    assert seen.sum() > 500
    colours = 0.5 + 0.28209479177387814 * read.sh0[seen]
    difference = np.abs(colours - rendered.rgb[0, 0][v, u][seen])
    assert difference.mean() < 0.02


def test_colours_are_lambert_s_under_the_light_that_is_told(splats):
    shade = 0.25 + 0.75 * np.maximum(splats.normals @ LIGHT.direction, 0)
    np.testing.assert_allclose(splats.colours, shade[:, None] * ALBEDO, atol=0.06)
    header = splats_ply(splats).split(b"end_header")[0].decode()
    x, y, z = LIGHT.direction
    assert f"Lighting is baked in: light toward ({x:.4f}, {y:.4f}, {z:.4f})" in header
