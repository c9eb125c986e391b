"""Splats as a reader of splats reads them, against the field they came from."""

import gsply
import numpy as np
import pytest

from osfcore.contrib.export.splats import field_splats, splats_ply
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.render.reference import render_reference
from tests.support.ellipsoid import ALBEDO, HALF, ellipsoid_normals

LIGHT = Light(np.array([0.6, -0.4, 1.0]))


@pytest.fixture(scope="module")
def file(solid, one_thread, tmp_path_factory):
    path = tmp_path_factory.mktemp("splats") / "ellipsoid.ply"
    path.write_bytes(splats_ply(field_splats(solid, LIGHT)))
    return path


@pytest.fixture(scope="module")
def read(file):
    return gsply.plyread(file)


def colours_of(read):
    return 0.5 + 0.28209479177387814 * read.sh0


def test_discs_lie_in_the_surface_and_cover_it(read):
    np.testing.assert_allclose(np.linalg.norm(read.means / HALF, axis=1), 1, atol=0.05)
    np.testing.assert_allclose(np.abs(read.means).max(axis=0), HALF, atol=0.001)
    assert read.shN.size == 0
    axes = quaternion_to_matrix(read.quats)
    assert np.median(np.einsum("ij,ij->i", axes[:, :, 2], ellipsoid_normals(read.means))) > 0.99
    deviations = np.exp(read.scales)
    np.testing.assert_array_less(deviations[:, 2], deviations[:, 0])
    a, b, c = HALF
    p = 1.6075  # Thomsen's formula
    area = 4 * np.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p)
    assert (np.pi * (2 * deviations[:, 0]) * (2 * deviations[:, 1])).sum() > 2 * area  # within two deviations
    assert (1 / (1 + np.exp(-read.opacities)) > 0.9).all()


def test_colours_are_those_of_the_rendered_image(read, solid):
    camera = Camera.look_at("0", (0.15, -0.1, 0.2), (0, 0, 0), size=48)
    state = SceneState(("solid",), Pose.identity(1), LIGHT, None)
    rendered = render_reference({"solid": solid}, None, state, camera, outputs={"rgb", "depth", "opacity"})
    pixels = np.floor(camera.project(read.means)).astype(int)
    u, v = pixels.T
    depth = camera.T_world_camera.inverse().apply(read.means)[:, 2]
    seen = (np.abs(depth - rendered.depth[0, 0][v, u]) < 0.003) & (rendered.opacity[0, 0, 0][v, u] > 0.95)
    assert seen.sum() > 500
    assert np.abs(colours_of(read) - rendered.rgb[0, 0][v, u])[seen].mean() < 0.02


def test_colours_are_lambert_s_under_the_light_that_the_file_names(read, file):
    shade = 0.25 + 0.75 * np.maximum(ellipsoid_normals(read.means) @ LIGHT.direction, 0)
    np.testing.assert_allclose(colours_of(read), shade[:, None] * ALBEDO, atol=0.06)
    assert "({:.4f}, {:.4f}, {:.4f})".format(*LIGHT.direction).encode() in file.read_bytes().split(b"end_header")[0]
