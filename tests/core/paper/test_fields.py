import numpy as np
import pytest
import torch

from osfcore.errors import CorruptFile
from osfcore.paper.fields import TinyQuery, field_bytes, field_from_bytes, first_field, network_size, read_field
from tests.core.paper.scenes import VOXEL, empty_block, uniform_block
from tests.support.errors import about


def ball(across: int, most: int):
    places = np.moveaxis(np.indices((25, 25, 25)), 0, -1) - 12
    shell = np.abs(np.linalg.norm(places, axis=-1) - 9) < 1
    rng = np.random.default_rng(0)
    return first_field(np.zeros(3, np.float32), 0.01, shell, across=across, width=4, most_networks=most, rng=rng)


def test_every_occupied_corner_lies_in_a_cell_with_a_network():
    field = ball(8, 1000)
    counts, spans = np.array(field.cells.shape), np.array(field.occupied.shape) - 1
    cells = np.floor(np.argwhere(field.occupied) / spans * counts).astype(int)
    assert (field.cells[tuple(cells.T)] >= 0).all()
    assert sorted(field.cells[field.cells >= 0]) == list(range(len(field.networks)))
    assert field.cells[4, 4, 4] == -1  # the middle is hollow
    # Cells grow until the networks fit.
    assert len(ball(8, 100).networks) <= 100 < len(ball(8, 1000).networks)
    assert len(ball(8, 1).networks) == 1


def test_a_uniform_block_answers_the_same_everywhere_and_nothing_outside():
    query = TinyQuery(uniform_block((0.7, 0.3, 0.1), 500.0))
    inside = torch.zeros(5, 3) + torch.tensor([0.01, -0.01, 0.005])
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    scatter = query(inside, directions, -directions)
    np.testing.assert_allclose(scatter.sigma.detach(), 500, rtol=1e-4)
    np.testing.assert_allclose(scatter.direct.detach(), [[0.7, 0.3, 0.1]] * 5, rtol=1e-4)
    assert not scatter.ambient.any()
    assert query.density(torch.tensor([[0.2, 0.0, 0.0]])).item() == 0


def test_density_is_the_same_with_and_without_directions_and_has_gradients():
    query = TinyQuery(empty_block())
    x = (torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) - 0.5) * 0.03
    up = torch.tensor([0.0, 0.0, 1.0]).expand(200, 3)
    scatter = query(x, up, -up)
    torch.testing.assert_close(scatter.sigma, query.density(x))
    (scatter.direct.sum() + scatter.sigma.sum()).backward()
    asked = query.networks.grad.abs().sum(dim=1) > 0
    assert asked.sum() > 1


def test_a_field_survives_its_file_and_damaged_ones_are_refused(tmp_path):
    field = empty_block()
    path = tmp_path / "a.safetensors"
    path.write_bytes(field_bytes(field))
    read = read_field(path)
    np.testing.assert_array_equal(read.occupied, field.occupied)
    np.testing.assert_array_equal(read.cells, field.cells)
    np.testing.assert_allclose(read.networks, field.networks, atol=1e-3)
    assert (read.voxel, read.width) == (pytest.approx(VOXEL), field.width)
    assert read.networks.shape[1] == network_size(field.width)
    data = path.read_bytes()
    with pytest.raises(CorruptFile, check=about("whole safetensors")):
        field_from_bytes(data[:-10], "field")
    with pytest.raises(CorruptFile, check=about("its format is")):
        field_from_bytes(data.replace(b"paper-kiloosf-1", b"paper-kiloosf-9"), "field")
    with pytest.raises(CorruptFile, check=about("of width 9")):
        field_from_bytes(data.replace(b'"width":"8"', b'"width":"9"'), "field")
    with pytest.raises(CorruptFile, check=about("missing.safetensors")):
        read_field(tmp_path / "missing.safetensors")
