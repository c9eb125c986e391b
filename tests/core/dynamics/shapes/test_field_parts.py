import numpy as np
import pytest
import trimesh
from safetensors import safe_open
from safetensors.numpy import save_file
from scipy.spatial import ConvexHull

from osfcore.dynamics.shapes import field_mesh, field_parts, read_parts, write_parts
from osfcore.errors import CannotWrite, InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import EMPTY_G
from tests.core.dynamics.solids import VOXEL, bracket
from tests.core.render.scenes import ball, block, random_field


def clearance_m(point, parts) -> float:
    """Distance of a point to the nearest part's planes; negative within a part."""
    hulls = [ConvexHull(part) for part in parts]
    return min(float((hull.equations[:, :3] @ point + hull.equations[:, 3]).max()) for hull in hulls)


@pytest.mark.parametrize("field", [ball(0.05, voxel=VOXEL), block((0.05, 0.03, 0.02), voxel=VOXEL)])
def test_a_convex_field_has_no_parts_and_a_closed_surface(field):
    assert field_parts(field) == ()
    mesh = trimesh.Trimesh(*field_mesh(field))
    assert mesh.is_watertight
    assert mesh.volume > 0  # triangles face outward


def test_the_surface_lies_where_the_solid_ends():
    vertices, _ = field_mesh(ball(0.05, voxel=VOXEL))
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(0.05, abs=VOXEL)
    vertices, _ = field_mesh(block((0.05, 0.03, 0.02), voxel=VOXEL))
    assert np.abs(vertices).max(axis=0) == pytest.approx(np.array([0.05, 0.03, 0.02]), abs=VOXEL)


def test_a_bracket_has_parts_that_leave_its_corner_free():
    parts = field_parts(bracket())
    assert 2 <= len(parts) <= 6
    assert clearance_m([0.02, 0.02, 0.0], parts) > 0.02
    for arm in ((0.045, -0.035, 0.0), (-0.035, 0.045, 0.0), (-0.035, -0.035, 0.0)):
        assert clearance_m(arm, parts) < 0
    again = field_parts(bracket())
    assert all(np.array_equal(a, b) for a, b in zip(parts, again, strict=True))


def test_specks_do_not_count():
    field = bracket()
    density = field.density.copy()
    alone = field_mesh(field)[0]
    density[-2:, -2:, -2:] = 3.0  # a speck in the free corner
    object.__setattr__(field, "density", density)
    np.testing.assert_array_equal(field_mesh(field)[0], alone)


def test_what_a_lost_neck_bore_counts():
    field = block((0.02, 0.02, 0.08), voxel=VOXEL)
    density = field.density.copy()
    density[:, :, density.shape[2] // 2 :][:, :, :2] = EMPTY_G
    object.__setattr__(field, "density", density)
    vertices, _ = field_mesh(field)
    assert np.abs(vertices).max(axis=0) == pytest.approx(np.array([0.02, 0.02, 0.08]), abs=VOXEL)


def test_a_field_without_a_solid_part_is_told():
    field = ball(0.03, voxel=VOXEL)
    object.__setattr__(field, "density", np.full_like(field.density, -9.0))
    with pytest.raises(InvalidInput, match="solid"):
        field_mesh(field)
    assert field_parts(field) == ()


def test_a_field_of_noise_has_some_parts_or_none():
    for part in field_parts(random_field(np.random.default_rng(0))):
        assert np.isfinite(part).all()


def test_files_give_back_what_was_written_for_the_same_field(tmp_path):
    path = tmp_path / "new" / "parts.safetensors"
    parts = tuple(np.random.default_rng(0).random((n, 3)).astype(np.float32) for n in range(4, 16))
    write_parts(path, parts, "abc")
    found = read_parts(path, "abc")
    assert found is not None
    assert all(np.array_equal(a, b) for a, b in zip(parts, found, strict=True))
    assert read_parts(path, "abd") is None
    write_parts(path, (), "abc")
    assert read_parts(path, "abc") == ()


@pytest.mark.parametrize("length", [0, 7, 60, 300])
def test_broken_files_count_as_missing(tmp_path, length):
    path = tmp_path / "parts.safetensors"
    assert read_parts(path, "abc") is None
    write_parts(path, (np.zeros((30, 3), np.float32),), "abc")
    path.write_bytes(path.read_bytes()[:length])
    assert read_parts(path, "abc") is None


@pytest.mark.parametrize("part", [np.zeros((4, 2)), np.zeros((0, 3)), np.full((4, 3), np.nan), np.zeros(3)])
def test_files_of_anything_else_count_as_missing(tmp_path, part):
    path = tmp_path / "parts.safetensors"
    write_parts(path, (np.zeros((4, 3), np.float32),), "abc")
    with safe_open(path, "numpy") as file:
        header = file.metadata()
    save_file({"0": part.astype(np.float32)}, path, header)
    assert read_parts(path, "abc") is None


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CannotWrite):
        write_parts(tmp_path / "file" / "parts.safetensors", (), "abc")


@pytest.mark.slow
def test_parts_of_a_real_drill_fill_it_but_for_its_hollows():
    field = FieldLibrary(None).load("035_power_drill")
    parts = field_parts(field)
    assert 3 <= len(parts) <= 9
    vertices, faces = field_mesh(field)
    inside = np.min(
        [(h.equations[:, :3] @ vertices.T + h.equations[:, 3:]).max(axis=0) for h in map(ConvexHull, parts)], 0
    )
    assert np.percentile(inside, 95) < 4e-3
    assert sum(ConvexHull(part).volume for part in parts) < 0.8 * ConvexHull(vertices).volume
    assert sum(ConvexHull(part).volume for part in parts) > 0.8 * trimesh.Trimesh(vertices, faces).volume
