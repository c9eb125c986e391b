from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import MOST_HIDDEN, network_size
from osfcore.render.renderer import pack
from tests.core.render.scenes import HIDDEN, ball, block, random_field


def test_every_field_is_found_where_the_starts_say():
    rng = np.random.default_rng(0)
    fields = [random_field(rng), ball(), random_field(rng), block()]
    packed = pack(fields)
    assert packed.hidden == HIDDEN
    rows = packed.rows.reshape(-1, 8)
    networks = packed.networks.reshape(-1, network_size(HIDDEN))
    for field, starts, shape, scale, extent, ambient in zip(
        fields, packed.starts, packed.shapes, packed.scales, packed.extents, packed.ambient, strict=True
    ):
        corners, first_row, blocks, cells, first_network = starts
        grid, macro, cell = shape.reshape(3, 3)
        np.testing.assert_array_equal(grid, field.index.shape)
        index = packed.index[corners : corners + np.prod(grid)].reshape(grid)
        np.testing.assert_array_equal(rows[first_row + index], field.rows[field.index])
        np.testing.assert_array_equal(packed.density[corners : corners + np.prod(grid)].reshape(grid), field.density)
        np.testing.assert_array_equal(packed.macro[blocks : blocks + np.prod(macro)].reshape(macro), field.macro)
        numbers = packed.cells[cells : cells + np.prod(cell)].reshape(cell)
        np.testing.assert_array_equal(networks[first_network + numbers], field.networks[field.cells])
        np.testing.assert_allclose(scale, [*field.origin, field.voxel], atol=1e-12)
        np.testing.assert_array_equal(ambient, field.ambient)
        # Density is interpolated, so it reaches one voxel beyond the last occupied corner.
        np.testing.assert_allclose(extent[:3], field.extent[0] - field.voxel, atol=1e-6)
        np.testing.assert_allclose(extent[3:], field.extent[1] + field.voxel, atol=1e-6)


def test_fields_of_different_widths_do_not_go_together():
    other = replace(ball(), hidden=4, networks=np.zeros((1, network_size(4)), np.float32))
    with pytest.raises(InvalidInput, match=r"widths of the fields' networks is \[4, 8\]"):
        pack([ball(), other])


def test_networks_wider_than_the_renderer_has_room_for_are_refused():
    width = MOST_HIDDEN + 1
    wide = replace(ball(), hidden=width, networks=np.zeros((1, network_size(width)), np.float32))
    with pytest.raises(InvalidInput, match="width of the fields' networks is 65, but it must be at most 64"):
        pack([wide])
