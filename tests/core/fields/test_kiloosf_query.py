import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, KiloOSF, network_size
from osfcore.fields.kiloosf_query import KiloQuery

F64 = {"dtype": torch.float64}


def full_field(seed: int = 0, hidden: int = 4, shape=(6, 5, 7), cells=(2, 1, 3), features=None) -> KiloOSF:
    """Features on every corner, faces included; each cell has its own network."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(*shape, FEATURES)) if features is None else features
    empty = np.zeros((1, FEATURES))
    empty[0, 0] = EMPTY_G
    rows = np.concatenate([empty, features.reshape(-1, FEATURES)]).astype(np.float32)
    index = 1 + np.arange(np.prod(shape), dtype=np.int32).reshape(shape)
    count = int(np.prod(cells))
    networks = (0.5 * rng.normal(size=(count, network_size(hidden)))).astype(np.float32)
    numbers = rng.permutation(count).reshape(cells).astype(np.int32)
    origin, ambient = np.float32([-0.3, 0.1, 0.2]), np.float32([0.2, 0.25, 0.3])
    return KiloOSF(origin, 0.1, index, rows, numbers, networks, hidden, ambient)


def inside(field: KiloOSF, count: int, seed: int = 0, margin: float = 1e-3):
    """Points in the grid's box, lights and views."""
    rng = np.random.default_rng(seed)
    low, high = field.box.astype(float)
    x = rng.uniform(low + margin, high - margin, (count, 3))
    light, view = rng.normal(size=(2, count, 3))
    unit = [a / np.linalg.norm(a, axis=1, keepdims=True) for a in (light, view)]
    return tuple(torch.tensor(a, **F64) for a in (x, *unit))


def by_hand(field: KiloOSF, x, light, view):
    """The formulas of kiloosf.py for one point, in numpy."""
    p = (x - field.origin) / field.voxel
    whole = np.floor(p).astype(int)
    f, features = p - whole, np.zeros(FEATURES)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f))
        features += weight * field.rows[field.index[tuple(whole + corner)]]
    dipole = features[4:7] @ light
    low, high = field.box.astype(float)
    place = (x - low) / (high - low) * field.cells.shape
    cell = np.floor(place).astype(int)
    a = np.concatenate([[dipole, features[7]], light, view, 2 * (place - cell) - 1])
    numbers = field.networks[field.cells[tuple(cell)]].astype(float)
    for inputs, outputs in ((11, field.hidden), (field.hidden, field.hidden), (field.hidden, 3)):
        weights, numbers = numbers[: inputs * outputs].reshape(inputs, outputs), numbers[inputs * outputs :]
        biases, numbers = numbers[:outputs], numbers[outputs:]
        a = a @ weights + biases
        if len(numbers):
            a = np.maximum(a, 0)
    albedo = features[1:4]
    sigma = max(np.logaddexp(features[0], 0) - DENSITY_FLOOR, 0) / field.voxel
    return albedo * field.ambient, albedo * np.maximum(dipole + a, 0), sigma


def test_the_formulas_hold():
    field = full_field()
    x, light, view = inside(field, 40)
    ambient, direct, sigma = KiloQuery(field, **F64)(x, light, view)
    for i in range(40):
        expected = by_hand(field, *(a[i].numpy() for a in (x, light, view)))
        np.testing.assert_allclose(ambient[i].detach(), expected[0], atol=1e-6)
        np.testing.assert_allclose(direct[i].detach(), expected[1], atol=1e-5)
        np.testing.assert_allclose(sigma[i].detach(), expected[2], rtol=1e-5, atol=1e-6)


@given(seed=st.integers(0, 10**6))
def test_linear_features_are_interpolated_exactly(seed):
    rng = np.random.default_rng(seed)
    slope, offset = rng.normal(size=(3, FEATURES)), rng.normal(size=FEATURES)
    shape = (6, 5, 7)
    corners = np.float32([-0.3, 0.1, 0.2]) + 0.1 * np.stack(np.indices(shape), axis=-1)
    field = full_field(features=corners @ slope + offset)
    x, _, _ = inside(field, 20, seed)
    np.testing.assert_allclose(KiloQuery(field, **F64).features(x).detach(), x.numpy() @ slope + offset, atol=2e-6)


def test_gradients_are_right():
    """Of every kind of parameter and of the points, against finite differences."""
    field = full_field(shape=(3, 3, 3), hidden=1, cells=(2, 1, 1))
    query = KiloQuery(field, **F64)
    x, light, view = inside(field, 3, margin=0.02)

    def value(x, rows, networks, ambient):
        numbers = {"rows": rows, "networks": networks, "ambient": ambient}
        scatter = torch.func.functional_call(query, numbers, (x, light, view))
        return torch.cat([scatter.ambient, scatter.direct, scatter.sigma[:, None]], dim=1)

    leaves = [p.detach().clone().requires_grad_() for p in (query.rows, query.networks, query.ambient)]
    assert torch.autograd.gradcheck(value, (x.requires_grad_(), *leaves), eps=1e-7, atol=1e-5)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), count=st.integers(0, 40))
def test_points_do_not_depend_on_each_other(seed, count):
    """Neither their order nor how many are asked at once changes anything, however they fall into cells."""
    field = full_field()
    query = KiloQuery(field, **F64)
    points = inside(field, count, seed)
    order = torch.tensor(np.random.default_rng(seed).permutation(count))
    cut = count // 2
    together = query(*points)
    shuffled = query(*(a[order] for a in points))
    parts = [query(*(a[s] for a in points)) for s in (slice(0, cut), slice(cut, None))]
    for whole, other, first, second in zip(together, shuffled, *parts, strict=True):
        np.testing.assert_allclose(whole[order].detach(), other.detach(), atol=1e-12)
        np.testing.assert_allclose(whole.detach(), torch.cat([first, second]).detach(), atol=1e-12)


def test_there_is_nothing_outside_the_box_nor_in_empty_space():
    field = full_field(features=np.full((6, 5, 7, FEATURES), 3.0))
    query = KiloQuery(field, **F64)
    low, high = field.box.astype(float)
    middle = (low + high) / 2
    outside = [np.where(np.arange(3) == axis, end, middle) for axis in range(3) for end in (low - 1e-3, high + 1e-3)]
    density = query.density(torch.tensor(np.stack([*outside, middle, low + 1e-3, high - 1e-3]), **F64))
    assert (density[:6] == 0).all()
    np.testing.assert_allclose(density[6:].detach(), (np.logaddexp(3, 0) - DENSITY_FLOOR) / 0.1, atol=1e-12)
    # Features are defined everywhere and stay finite, so that gradients do.
    assert torch.isfinite(query(torch.tensor(np.stack(outside), **F64), *[torch.ones(6, 3, **F64)] * 2).direct).all()
    assert query.sigma(torch.tensor([EMPTY_G, -6.0], **F64)).tolist() == [0, 0]
    assert query.sigma(torch.tensor([-5.99], **F64)) > 0


def test_row_units_scale_steps_but_not_values():
    field = full_field()
    for name in ("origin", "index", "rows", "cells", "networks", "ambient"):
        np.testing.assert_array_equal(getattr(KiloQuery(field).to_field(field), name), getattr(field, name))
    units = (10.0, 1, 1, 1, 2, 2, 2, 5)
    points = inside(field, 30)
    plain, scaled = KiloQuery(field, **F64), KiloQuery(field, row_units=units, **F64)
    for a, b in zip(plain(*points), scaled(*points), strict=True):
        np.testing.assert_allclose(a.detach(), b.detach(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(scaled.to_field(field).rows, field.rows, rtol=1e-6)


def test_jitter_asks_neighbouring_networks_only_near_the_border():
    field = full_field(cells=(2, 1, 1))
    query = KiloQuery(field, **F64)
    x, light, view = inside(field, 200)
    low, high = field.box.astype(float)
    place = (x[:, 0].numpy() - low[0]) / (high[0] - low[0]) * 2
    plain = query(x, light, view).direct.detach().numpy()
    generator = torch.Generator().manual_seed(0)
    jittered = query(x, light, view, cell_jitter=0.25, generator=generator).direct.detach().numpy()
    changed = np.any(plain != jittered, axis=1)
    assert changed.any()
    assert np.all(np.abs(place[changed] - 1) < 0.25)
