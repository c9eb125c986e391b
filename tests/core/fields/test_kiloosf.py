import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G, MACRO, KiloOSF, block_distances, network_size
from osfcore.fields.kiloosf_query import KiloQuery
from tests.core.render.scenes import ball, block


def distances_by_hand(density):
    """Every block of 4 x 4 x 4 voxels together with all its 5 x 5 x 5 corners, against every other."""
    shape = [-(-(n - 1) // MACRO) for n in density.shape]
    occupied = []
    for place in np.ndindex(*shape):
        part = density[tuple(slice(MACRO * b, MACRO * (b + 1) + 1) for b in place)]
        if np.any(part > FLOOR_G):
            occupied.append(place)
    blocks = np.full(shape, 255, np.uint8)
    for place in np.ndindex(*shape) if occupied else ():
        blocks[place] = np.abs(np.array(occupied) - place).max(axis=1).min()
    return blocks


@given(shape=st.tuples(*[st.integers(2, 22)] * 3), seed=st.integers(0, 10**6), share=st.sampled_from([0.0, 5e-4, 0.1]))
def test_blocks_know_how_far_away_density_is(shape, seed, share):
    rng = np.random.default_rng(seed)
    density = np.where(rng.random(shape) < share, 1.0, EMPTY_G).astype(np.float32)
    np.testing.assert_array_equal(block_distances(density), distances_by_hand(density))


def test_a_corner_at_the_floor_is_empty():
    density = np.full((6, 6, 6), FLOOR_G, np.float32)
    assert np.all(block_distances(density) == 255)
    density[2, 2, 2] = np.nextafter(np.float32(FLOOR_G), np.float32(0))
    assert (block_distances(density) == 0).sum() == 1


def test_box_and_extent_of_a_block():
    field = block((0.04, 0.03, 0.05), voxel=0.005)
    np.testing.assert_allclose(field.box[0], field.origin, atol=1e-12)
    np.testing.assert_allclose(field.box.sum(axis=0), 0, atol=1e-6)
    # The last solid corner lies on the surface, where g is 0, or within the voxel beyond it.
    assert np.all(field.extent[1] >= np.array([0.04, 0.03, 0.05]) - 1e-6)
    assert np.all(field.extent[1] < np.array([0.04, 0.03, 0.05]) + 0.005)
    np.testing.assert_allclose(field.extent[0], -field.extent[1], atol=1e-6)


def test_the_extent_of_nothing_is_the_whole_box():
    field = block()
    empty = KiloOSF(field.origin, field.voxel, 0 * field.index, field.rows, field.cells, field.networks, field.hidden,
                    field.ambient)  # fmt: skip
    np.testing.assert_array_equal(empty.extent, empty.box)
    assert np.all(empty.macro == 255)


def test_density_and_blocks_are_derived_from_rows():
    field = ball()
    np.testing.assert_array_equal(field.density, field.rows[field.index, 0])
    np.testing.assert_array_equal(field.macro, distances_by_hand(field.density))


@pytest.mark.parametrize("hidden", [1, 8, 16])
def test_a_network_has_as_many_numbers_as_its_layers_use(hidden):
    assert network_size(hidden) == 11 * hidden + hidden + hidden * hidden + hidden + hidden * 3 + 3
    field = ball()
    field = KiloOSF(field.origin, field.voxel, field.index, field.rows, field.cells,
                    np.zeros((1, network_size(hidden)), np.float32), hidden, field.ambient)  # fmt: skip
    x = torch.zeros(1, 3)
    assert KiloQuery(field)(x, x, x).direct.shape == (1, 3)
