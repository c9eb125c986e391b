"""Shapes: object shapes, field parts, contact geometry."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from safetensors import safe_open
from safetensors.numpy import save_file
from scipy.spatial import ConvexHull

from osfcore.dynamics.shapes import (
    MAP_SIDE,
    PAIR_REACH_M,
    ShapeTable,
    field_mesh,
    field_parts,
    object_shape,
    octahedral_directions,
    octahedral_index,
    outlines,
    pair_contact,
    pusher_contact,
    read_parts,
    solids,
    write_parts,
)
from osfcore.errors import InvalidInput, OsfError
from osfcore.fields.kiloosf import EMPTY_G
from osfcore.geometry.polygons import gap_to_point
from osfcore.geometry.torch_rotations import facing
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import NAMES, VOXEL, angle_bracket, boxes, bracket, hull
from tests.support.rendered_scenes import ball, block

# Object shapes


def directions(count: int = 3000, seed: int = 0) -> torch.Tensor:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.as_tensor(d / np.linalg.norm(d, axis=1, keepdims=True), dtype=torch.float32)


def only(shape) -> tuple[ShapeTable, torch.Tensor]:
    return ShapeTable((shape,)), torch.zeros(1, dtype=torch.long)


@pytest.mark.parametrize(("side", "scale"), [(1, 1.0), (3, 30.0), (MAP_SIDE, 0.01)])
def test_every_direction_of_the_map_lies_in_its_own_cell(side, scale):
    d = octahedral_directions(side)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-12)
    index = octahedral_index(torch.as_tensor(scale * d, dtype=torch.float32), side)
    np.testing.assert_array_equal(index, np.arange(side * side))


def test_the_map_covers_the_sphere_evenly_enough():
    own = torch.as_tensor(octahedral_directions(MAP_SIDE), dtype=torch.float32)
    d = torch.cat([directions(20_000), torch.eye(3), -torch.eye(3), -0.0 - torch.eye(3)])
    nearest = own[octahedral_index(d, MAP_SIDE)]
    assert torch.linalg.cross(nearest, d).norm(dim=1).max() < np.deg2rad(4)
    assert (nearest * d).sum(dim=1).min() > 0


@pytest.mark.parametrize("name", NAMES[:2])
def test_support_is_that_of_the_hull_but_for_the_width_of_a_cell(shapes, name):
    shape, d = shapes[name], directions()
    table, number = only(shape)
    exact = (d.double().numpy() @ hull(shape).T).max(axis=1)
    lacking = exact - table.extents(number, torch.eye(3)[None], d)[0].numpy()
    cells = octahedral_directions(MAP_SIDE)
    off = np.linalg.norm(cells[octahedral_index(d, MAP_SIDE)] - d.numpy(), axis=1)
    assert lacking.min() > -1e-7  # a point of the hull is never beyond it
    assert np.all(lacking < 2 * shape.radius * off + 1e-7)
    assert np.sqrt(np.mean(lacking**2)) < 2.5e-4
    np.testing.assert_allclose((cells * shape.support).sum(axis=1), (cells @ hull(shape).T).max(axis=1), atol=1e-8)
    np.testing.assert_allclose(np.ptp(hull(shape), axis=0) / 2, shape.half_extents, atol=2e-4)
    assert np.linalg.norm(hull(shape), axis=1).max() == pytest.approx(shape.radius, abs=1e-6)


def test_a_block_reaches_as_far_as_its_sides():
    half = np.array([0.04, 0.03, 0.05])
    shape = object_shape(block(half, voxel=0.004))
    d = octahedral_directions(MAP_SIDE)
    lost = np.abs(d) @ half - (d * shape.support).sum(axis=1)
    assert np.ptp(shape.half_extents - half) < 1e-3
    assert np.abs(lost).max() < 4e-3  # a voxel: corners are rounded off
    np.testing.assert_allclose(shape.centre, 0, atol=1e-6)


def test_shapes_do_not_depend_on_where_the_origin_is():
    field = block()
    there = object_shape(replace(field, origin=field.origin + np.float32([0.1, -0.2, 0.3])))
    here = object_shape(field)
    np.testing.assert_allclose(there.centre - here.centre, [0.1, -0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(np.sort(hull(there), axis=0), np.sort(hull(here), axis=0), atol=1e-6)
    with pytest.raises(OsfError):  # nothing is solid
        object_shape(replace(field, rows=np.full_like(field.rows, -3.0)))


# Field parts


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


def test_a_bracket_has_parts_that_leave_its_corner_free():
    parts = field_parts(bracket())
    assert 2 <= len(parts) <= 6
    assert clearance_m([0.02, 0.02, 0.0], parts) > 0.02
    for arm in ((0.045, -0.035, 0.0), (-0.035, 0.045, 0.0), (-0.035, -0.035, 0.0)):
        assert clearance_m(arm, parts) < 0
    again = field_parts(bracket())
    assert all(np.array_equal(a, b) for a, b in zip(parts, again, strict=True))


def test_specks_do_not_count_and_what_a_lost_neck_bore_does():
    field = bracket()
    alone = field_mesh(field)[0]
    field.density[-2:, -2:, -2:] = 3.0  # a speck in the free corner
    np.testing.assert_array_equal(field_mesh(field)[0], alone)
    field = block((0.02, 0.02, 0.08), voxel=VOXEL)
    middle = field.density.shape[2] // 2
    field.density[:, :, middle : middle + 2] = EMPTY_G
    vertices, _ = field_mesh(field)
    assert np.abs(vertices).max(axis=0) == pytest.approx(np.array([0.02, 0.02, 0.08]), abs=VOXEL)
    field.density[...] = -9.0
    with pytest.raises(InvalidInput):  # nothing is solid
        field_mesh(field)
    assert field_parts(field) == ()


def test_files_give_back_what_was_written_for_the_same_field_and_anything_else_counts_as_missing(tmp_path):
    path = tmp_path / "new" / "parts.safetensors"
    parts = tuple(np.random.default_rng(0).random((n, 3)).astype(np.float32) for n in range(4, 16))
    write_parts(path, parts, "abc")
    found = read_parts(path, "abc")
    assert found is not None
    assert all(np.array_equal(a, b) for a, b in zip(parts, found, strict=True))
    assert read_parts(path, "abd") is None
    write_parts(path, (), "abc")
    assert read_parts(path, "abc") == ()
    assert read_parts(tmp_path / "none.safetensors", "abc") is None
    write_parts(path, (np.zeros((30, 3), np.float32),), "abc")
    whole = path.read_bytes()
    with safe_open(path, "numpy") as file:
        header = file.metadata()
    for length in (0, 7, 60, 300):
        path.write_bytes(whole[:length])
        assert read_parts(path, "abc") is None
    for part in (np.zeros((4, 2)), np.zeros((0, 3)), np.full((4, 3), np.nan), np.zeros(3)):
        save_file({"0": part.astype(np.float32)}, path, header)
        assert read_parts(path, "abc") is None


# Contact geometry


STILL = torch.zeros(1, 2)


def seen(table, placed):
    """Solids and whole outlines of objects given as number: (x, y, z of the centre, turn about z)."""
    numbers = torch.tensor([number for number, *_ in placed])
    centre = torch.tensor([where[:3] for _, *where in placed], dtype=torch.float32)
    heading = torch.tensor([[np.cos(where[3]), -np.sin(where[3])] for _, *where in placed], dtype=torch.float32)
    rotation = facing(heading)
    outline = outlines(table, numbers, rotation, centre)
    return solids(table, numbers, rotation, centre, outline), outline


def test_the_pusher_fits_into_a_corner_that_the_hull_would_fill():
    """A bracket of two arms, 12 cm long and 4 cm wide, with the pusher in its corner."""
    bracket = angle_bracket()
    parts, outline = seen(ShapeTable((bracket,)), [(0, -0.055, -0.055, 0.02, 0.0)])  # arms at x, y < -0.035
    contact = pusher_contact(parts, STILL)
    for gap in contact[:3]:
        assert float(gap.distance) == pytest.approx(0.035 - PUSHER_RADIUS_M, abs=1e-4)
    whole = gap_to_point(outline, STILL)
    assert float(whole.distance) < 0.035 - 0.02  # the hull's hypotenuse is nearer


def test_what_is_cut_into_parts_is_touched_where_the_whole_is():
    """A box, and the same box of eight parts: parts change nothing where there is no hollow."""
    whole = boxes(((0.0, 0.0, 0.0), (0.04, 0.04, 0.04)))
    eighths = [(place, (0.02, 0.02, 0.02)) for place in itertools.product((-0.02, 0.02), repeat=3)]
    cut = replace(whole, parts=boxes(*eighths).parts)
    table = ShapeTable((whole, cut))
    for turn in (0.0, 0.3, 0.9):
        parts, outline = seen(table, [(0, 0.08, 0.01, 0.04, turn), (1, 0.08, 0.01, 0.04, turn)])
        contact = pusher_contact(parts, torch.tensor([[0.01, 0.002]]).expand(2, 2))
        for gap in contact[:3]:
            torch.testing.assert_close(gap.distance[0], gap.distance[1], atol=1e-4, rtol=0)
            torch.testing.assert_close(gap.normal[0], gap.normal[1], atol=1e-3, rtol=0)
        sides, outline = seen(table, [(0, 0.0, 0.0, 0.04, turn), (0, 0.1, 0.0, 0.04, 0.0), (1, 0.1, 0.0, 0.04, 0.0)])
        pairs = pair_contact(sides, outline, torch.tensor([0, 0]), torch.tensor([1, 2]))
        torch.testing.assert_close(pairs.gap.distance[0], pairs.gap.distance[1], atol=2e-3, rtol=0)


def test_what_is_above_the_pusher_is_not_touched():
    """A mushroom 20 cm high: a stem of 2 cm, and a cap of 8 cm from 14 cm upward."""
    mushroom = boxes(((0.0, 0.0, -0.03), (0.01, 0.01, 0.07)), ((0.0, 0.0, 0.07), (0.04, 0.04, 0.03)))
    parts, _ = seen(ShapeTable((mushroom,)), [(0, 0.04, 0.0, 0.1, 0.0)])
    assert float(pusher_contact(parts, STILL).before.distance) == pytest.approx(0.03 - PUSHER_RADIUS_M, abs=1e-4)
    lower, _ = seen(ShapeTable((mushroom,)), [(0, 0.04, 0.0, 0.07, 0.0)])
    assert float(pusher_contact(lower, STILL).before.distance) < 0


def test_brackets_that_hold_each_other_do_not_overlap():
    """Two brackets, one turned by 180 degrees, the ends of its arms 2 cm off within the other's corner."""
    table = ShapeTable((angle_bracket(),))
    parts, outline = seen(table, [(0, 0.0, 0.0, 0.02, 0.0), (0, 0.14, 0.08, 0.02, np.pi)])
    both = torch.tensor([0]), torch.tensor([1])
    contact = pair_contact(parts, outline, *both)
    assert float(contact.gap.distance) == pytest.approx(0.02, abs=5e-4)
    assert float(contact.gap.distance) < PAIR_REACH_M
    back = pair_contact(parts, outline, *both[::-1])
    torch.testing.assert_close(back.gap.distance, contact.gap.distance)
    torch.testing.assert_close(back.gap.normal, -contact.gap.normal, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.first_face, contact.second_face, atol=1e-5, rtol=0)


def test_parts_one_above_the_other_do_not_touch():
    """A low box under the cap of the mushroom, beside its stem."""
    mushroom = boxes(((0.0, 0.0, -0.03), (0.01, 0.01, 0.07)), ((0.0, 0.0, 0.07), (0.04, 0.04, 0.03)))
    low = boxes(((0.0, 0.0, 0.0), (0.01, 0.01, 0.02)))
    table = ShapeTable((mushroom, low))
    parts, outline = seen(table, [(0, 0.0, 0.0, 0.1, 0.0), (1, 0.035, 0.0, 0.02, 0.0)])
    contact = pair_contact(parts, outline, torch.tensor([0]), torch.tensor([1]))
    assert float(contact.gap.distance) == pytest.approx(0.015, abs=1e-4)
    torch.testing.assert_close(contact.gap.normal, torch.tensor([[1.0, 0.0]]), atol=1e-4, rtol=0)
