from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.dynamics.shapes import MAP_SIDE, ShapeTable, object_shape, octahedral_directions, octahedral_index
from osfcore.errors import OsfError
from osfcore.geometry.poses import quaternion_exp, quaternion_to_matrix, rotate
from tests.core.dynamics.scenes import BOX, NAMES, hull
from tests.core.render.scenes import ball, block


def directions(count: int = 3000, seed: int = 0) -> torch.Tensor:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.as_tensor(d / np.linalg.norm(d, axis=1, keepdims=True), dtype=torch.float32)


def only(shape) -> tuple[ShapeTable, torch.Tensor]:
    return ShapeTable((shape,)), torch.zeros(1, dtype=torch.long)


def turned(seed: int) -> tuple[np.ndarray, torch.Tensor]:
    q = quaternion_exp(np.random.default_rng(seed).normal(size=3))
    return q, torch.as_tensor(quaternion_to_matrix(q), dtype=torch.float32)[None]


@pytest.mark.parametrize("side", [1, 2, 3, 16, MAP_SIDE])
@pytest.mark.parametrize("scale", [1.0, 0.01, 30.0])
def test_every_direction_of_the_map_lies_in_its_own_cell(side, scale):
    d = octahedral_directions(side)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-12)
    index = octahedral_index(torch.as_tensor(scale * d, dtype=torch.float32), side)
    np.testing.assert_array_equal(index, np.arange(side * side))


def test_the_map_covers_the_sphere_evenly_enough():
    own = torch.as_tensor(octahedral_directions(MAP_SIDE), dtype=torch.float32)
    d = directions(20_000)
    nearest = own[octahedral_index(d, MAP_SIDE)]
    assert torch.linalg.cross(nearest, d).norm(dim=1).max() < np.deg2rad(4)
    assert (nearest * d).sum(dim=1).min() > 0


def test_directions_along_axes_have_a_cell_beside_them():
    axes = torch.cat([torch.eye(3), -torch.eye(3), -0.0 - torch.eye(3)])
    own = torch.as_tensor(octahedral_directions(MAP_SIDE), dtype=torch.float32)
    assert (own[octahedral_index(axes, MAP_SIDE)] * axes).sum(dim=1).min() > np.cos(np.deg2rad(4))


@pytest.mark.parametrize("name", NAMES)
def test_support_is_that_of_the_hull_but_for_the_width_of_a_cell(shapes, name):
    shape, d = shapes[name], directions()
    table, number = only(shape)
    exact = (d.double().numpy() @ hull(shape).T).max(axis=1)
    lacking = exact - table.extents(number, torch.eye(3)[None], d)[0].numpy()
    own = octahedral_directions(MAP_SIDE)[octahedral_index(d, MAP_SIDE)]
    off = np.linalg.norm(own - d.numpy(), axis=1)
    assert lacking.min() > -1e-7  # a point of the hull is never beyond it
    assert np.all(lacking < 2 * shape.radius * off + 1e-7)
    assert np.median(lacking) < 1.5e-4
    assert np.sqrt(np.mean(lacking**2)) < 2.5e-4


@pytest.mark.parametrize("name", NAMES)
def test_on_the_directions_of_the_map_support_is_exact(shapes, name):
    d = octahedral_directions(MAP_SIDE)
    exact = (d @ hull(shapes[name]).T).max(axis=1)
    np.testing.assert_allclose((d * shapes[name].support).sum(axis=1), exact, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_lookups_turn_with_the_object(shapes, seed):
    q, rotation = turned(seed)
    shape, d = shapes[BOX], directions()
    table, number = only(shape)
    farthest = table.farthest(number, rotation, d)[0]
    exact = (d.numpy() @ rotate(q, hull(shape)).T).max(axis=1)
    reach = (farthest * d).sum(dim=1)
    assert np.sqrt(np.mean((exact - reach.numpy()) ** 2)) < 2.5e-4
    torch.testing.assert_close(table.extents(number, rotation, d)[0], reach, atol=1e-6, rtol=0)
    back = farthest @ rotation[0]  # R^T p is one of the hull's points
    distance = np.linalg.norm(back.numpy()[:200, None] - hull(shape)[None], axis=2).min(axis=1)
    assert distance.max() < 1e-6


def test_every_object_is_looked_up_by_its_own_number(shapes, table):
    d = directions(50)
    together = table.extents(torch.arange(4), torch.eye(3).expand(4, 3, 3), d)
    for row, name in zip(together, sorted(shapes), strict=True):
        alone, number = only(shapes[name])
        assert torch.equal(row, alone.extents(number, torch.eye(3)[None], d)[0])


def test_a_ball_reaches_equally_far_everywhere():
    shape = object_shape(ball(0.05, voxel=0.004))
    reach = np.linalg.norm(shape.support, axis=1)
    assert np.ptp(reach) < 1.5e-3
    np.testing.assert_allclose(shape.half_extents, shape.half_extents[0], atol=1e-6)
    np.testing.assert_allclose(shape.half_extents[0], shape.radius, atol=1e-3)
    np.testing.assert_allclose(shape.centre, 0, atol=1e-6)


def test_a_block_reaches_as_far_as_its_sides():
    half = np.array([0.04, 0.03, 0.05])
    shape = object_shape(block(half, voxel=0.004))
    d = octahedral_directions(MAP_SIDE)
    lost = np.abs(d) @ half - (d * shape.support).sum(axis=1)
    assert np.ptp(shape.half_extents - half) < 1e-3
    assert np.abs(lost).max() < 4e-3  # a voxel: corners are rounded off
    np.testing.assert_allclose(shape.centre, 0, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_half_extents_and_radius_hold_the_hull(shapes, name):
    shape = shapes[name]
    np.testing.assert_allclose(np.ptp(hull(shape), axis=0) / 2, shape.half_extents, atol=2e-4)
    assert np.linalg.norm(hull(shape), axis=1).max() == pytest.approx(shape.radius, abs=1e-6)


def test_real_objects_have_the_size_of_their_packages(shapes):
    box = 2000 * shapes[BOX].half_extents
    assert np.all(np.abs(box - [71.5, 164, 213.5]) < 8)  # the catalogue's 60 x 158 x 210, a little askew in its frame


def test_shapes_do_not_depend_on_where_the_origin_is():
    field = block()
    there = object_shape(replace(field, origin=field.origin + np.float32([0.1, -0.2, 0.3])))
    here = object_shape(field)
    np.testing.assert_allclose(there.centre - here.centre, [0.1, -0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(np.sort(hull(there), axis=0), np.sort(hull(here), axis=0), atol=1e-6)


@pytest.mark.parametrize("g", [-10.0, -3.0])
def test_a_field_without_anything_solid_is_refused(g):
    field = block()
    rows = np.full_like(field.rows, g)
    with pytest.raises(OsfError, match="solid"):
        object_shape(replace(field, rows=rows))
