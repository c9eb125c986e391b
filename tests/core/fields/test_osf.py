import numpy as np
import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.fields.osf import DENSITY_GAIN, OSF, OSFSize, encoding

BOX = np.array([[-0.1, -0.2, 0.0], [0.1, 0.2, 0.6]])


def made(box=BOX, seed=0):
    return OSF(box, OSFSize(4, 32), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def queries(count=64, seed=1):
    rng = np.random.default_rng(seed)
    light, view = rng.normal(size=(2, count, 3))
    x = rng.uniform(*BOX, (count, 3))
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (light, view)]
    return [torch.from_numpy(a) for a in (x, *unit)]


def test_an_encoding_is_the_values_and_sines_of_their_doubles():
    values = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    found = encoding(values, 3)[0]
    sines = [np.sin(k * v) for k in (1, 2, 4) for v in (0.3, -0.2)]
    cosines = [np.cos(k * v) for k in (1, 2, 4) for v in (0.3, -0.2)]
    np.testing.assert_allclose(found, [0.3, -0.2, *sines, *cosines], atol=1e-12)


def test_light_and_view_change_the_direct_part_alone():
    osf, (x, light, view) = made(), queries()
    before = osf(x, light, view)
    for after in (osf(x, -light, view), osf(x, light, -view)):
        assert torch.equal(before.sigma, after.sigma)
        assert torch.equal(before.ambient, after.ambient)
        assert (before.direct - after.direct).abs().max() > 1e-3
    assert (before.sigma > 0).all()
    assert (before.direct > 0).all()


def test_only_the_place_within_the_box_matters():
    x, light, view = queries()
    small, large = made(), made(box=3 * BOX + 5)
    a, b = small(x, light, view), large(3 * x + 5, light, view)
    torch.testing.assert_close(a.direct, b.direct)
    torch.testing.assert_close(a.ambient, b.ambient)
    torch.testing.assert_close(a.sigma, 3 * b.sigma)  # the same opacity from face to face


def test_without_weights_a_network_is_uniform_fog():
    osf, asked = made(), queries()
    with torch.no_grad():
        for parameter in osf.parameters():
            parameter.zero_()
        osf.material.bias[0] = 2.0
        osf.ambient.fill_(0.25)
    scatter = osf(*asked)
    np.testing.assert_allclose(scatter.sigma.detach(), np.log1p(np.exp(2.0)) * DENSITY_GAIN / 0.3, atol=1e-12)
    np.testing.assert_allclose(scatter.ambient.detach(), 0.5 * 0.25, atol=1e-12)
    np.testing.assert_allclose(scatter.direct.detach(), 0.5 * np.log(2), atol=1e-12)


def test_density_and_material_agree_with_the_whole():
    osf, (x, light, view) = made(), queries()
    scatter, (sigma, albedo) = osf(x, light, view), osf.material_at(x)
    torch.testing.assert_close(osf.density(x), scatter.sigma)
    torch.testing.assert_close(sigma, scatter.sigma)
    torch.testing.assert_close(albedo * osf.ambient, scatter.ambient)


def test_every_parameter_learns_and_the_generator_alone_draws_it():
    osf, asked = made(seed=3), queries()
    scatter = osf(*asked)
    (scatter.direct.sum() + scatter.ambient.sum() + scatter.sigma.sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in osf.parameters())
    torch.manual_seed(2)
    assert torch.equal(scatter.direct, made(seed=3)(*asked).direct)
    assert not torch.equal(scatter.direct, made(seed=4)(*asked).direct)


@pytest.mark.parametrize(("depth", "width"), [(1, 64), (17, 64), (4, 7), (4, 1025)])
def test_sizes_out_of_range_are_refused(depth, width):
    with pytest.raises(InvalidInput):
        OSFSize(depth, width)
