from dataclasses import replace

import numpy as np
import pytest

from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FLOOR_G, KiloOSF
from osfcore.fields.rays import march
from tests.core.render.scenes import ball, block, fog, fog_depth

EVERYTHING = {"min_weight": -1.0, "min_transmittance": -1.0, "most": 4096}  # also where float32 leaves no light


def softplus(g):
    return np.maximum(g, 0) + np.log1p(np.exp(-np.abs(g)))


def optical_density(g):
    """Sigma * voxel."""
    return np.where(g <= FLOOR_G, 0, np.maximum(softplus(g) - DENSITY_FLOOR, 0))


def g_at(field: KiloOSF, points):
    """Trilinear interpolation, corner by corner, in float64; empty outside."""
    p = (points - field.origin) / field.voxel
    inside = np.all((p >= 0) & (p < np.array(field.index.shape) - 1), axis=-1)
    p = np.where(inside[..., None], p, 0)
    whole = np.floor(p).astype(int)
    f, total = p - whole, 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f), axis=-1)
        total = total + weight * field.density[tuple(np.moveaxis(whole + corner, -1, 0))]
    return np.where(inside, total, EMPTY_G)


def walk(field: KiloOSF, origin, direction, step, offset, far):
    """Every sample of one ray up to `far` and its optical depth; nothing is skipped."""
    t = (np.arange(int(far / step)) + offset) * step
    return t, optical_density(g_at(field, origin + t[:, None] * direction)) * step / field.voxel


def rays_at(field: KiloOSF, count: int, seed: int, distance: float = 0.4):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= distance / np.linalg.norm(origins, axis=1, keepdims=True)
    targets = rng.uniform(*field.box, (count, 3))
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def depth_found(field: KiloOSF, origins, directions, step, **settings):
    """Optical depth along rays, from the samples that marching found."""
    ts, used = march(field, origins, directions, step=step, **EVERYTHING | settings)
    points = origins[:, None] + ts[..., None].astype(float) * directions[:, None]
    return (optical_density(g_at(field, points)) * used).sum(axis=1) * step / field.voxel


@pytest.mark.parametrize("g", [-2.0, 0.0, 3.0, 5.0])  # denser slabs let less through than float32 can tell
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_optical_depth_of_a_slab_is_density_times_thickness(g, axis):
    field = fog(g=g)
    origins, directions = np.zeros((2, 1, 3), np.float32)
    origins[0, axis], directions[0, axis] = -0.3, 1
    depth = depth_found(field, origins, directions, field.voxel / 8)
    np.testing.assert_allclose(depth, fog_depth(field, g, 0.08), rtol=2e-3)
    inner = np.array([[0.0, 0.0, 0.0]], np.float32)
    half = depth_found(field, inner, directions, field.voxel / 8)
    np.testing.assert_allclose(half, depth / 2, rtol=2e-3)


def test_a_slab_lets_exp_of_minus_its_depth_through():
    field = fog(g=-2.0)
    origins, directions = np.float32([[0, 0, 1]]), np.float32([[0, 0, -1]])
    step = field.voxel / 4
    ts, used = march(field, origins, directions, step=step, **EVERYTHING)
    depth = optical_density(g_at(field, origins + ts[0][used[0], None] * directions)) * step / field.voxel
    before = np.concatenate([[0], np.cumsum(depth)[:-1]])
    weights = np.exp(-before) * (1 - np.exp(-depth))
    np.testing.assert_allclose(weights.sum(), 1 - np.exp(-depth.sum()), rtol=1e-9)
    np.testing.assert_allclose(weights.sum(), 1 - np.exp(-fog_depth(field, -2.0, 0.08)), atol=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_empty_blocks_are_skipped_without_loss(seed):
    """Against a plain loop over all samples of every ray, with offsets of all kinds."""
    rng = np.random.default_rng(seed)
    field = ball(0.06, voxel=0.004)
    rows = field.rows.copy()
    crumbs = rng.random(len(rows) - 1) < 0.02
    rows[1:, 0] = np.where(crumbs, rng.uniform(-2, 6, len(crumbs)), EMPTY_G)
    field = replace(field, rows=rows)
    origins, directions = rays_at(field, 40, seed)
    offsets = rng.random(40, dtype=np.float32)
    step = 0.5 * field.voxel
    ts, used = march(field, origins, directions, step=step, offsets=offsets, **EVERYTHING)
    assert used.any()
    for r in range(40):
        t, depth = walk(field, origins[r].astype(float), directions[r].astype(float), step, float(offsets[r]), 1.0)
        found = ts[r][used[r]]
        clear = depth > 1e-4  # at the rim of a crumb, float32 may round to the other side
        assert np.isin(np.round(t[clear] / step - offsets[r]), np.round(found / step - offsets[r])).all()
        np.testing.assert_allclose(
            optical_density(g_at(field, origins[r] + found[:, None].astype(float) * directions[r])).sum() * 0.5,
            depth.sum(), rtol=1e-3, atol=1e-3,
        )  # fmt: skip


def test_samples_come_front_to_back_on_the_lattice_of_the_ray():
    field = ball()
    origins, directions = rays_at(field, 30, 1)
    step = 0.5 * field.voxel
    for offsets in (None, np.linspace(0, 0.99, 30, dtype=np.float32)):
        ts, used = march(field, origins, directions, step=step, offsets=offsets, **EVERYTHING)
        assert used.any()
        first = 0.5 if offsets is None else offsets[:, None]
        numbers = ts / step - first
        np.testing.assert_allclose(numbers[used], np.round(numbers[used]), atol=1e-3)
        np.testing.assert_array_equal(np.sort(used, axis=1)[:, ::-1], used)  # used slots come first
        assert np.all((np.diff(ts, axis=1) > 0) | ~used[:, 1:])


def test_a_ray_may_be_cut_into_pieces():
    """What is met does not depend on where the ray begins, if it begins on the lattice."""
    field = ball()
    origins, directions = rays_at(field, 20, 2)
    step = 0.5 * field.voxel
    whole, used = march(field, origins, directions, step=step, **EVERYTHING)
    later = origins + 10 * step * directions
    rest, used_rest = march(field, later, directions, step=step, **EVERYTHING)
    for r in range(20):
        np.testing.assert_allclose(whole[r][used[r]], rest[r][used_rest[r]] + 10 * step, atol=1e-5)


def test_rays_that_miss_find_nothing():
    field = block()
    origins = np.float32([[0, 0, 1], [0, 0, 1], [0.2, 0, 1], [0, 0.0, -1], [1, 1, 0.0]])
    directions = np.float32([[0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0, -1], [0, -1, 0]])
    _, used = march(field, origins, directions, step=0.001, **EVERYTHING)
    assert not used.any()


def test_rays_that_begin_inside_look_forward_only():
    field = block((0.04, 0.04, 0.04))
    origins = np.zeros((6, 3), np.float32)
    directions = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    ts, used = march(field, origins, directions, step=0.0025, **EVERYTHING)
    assert np.all(ts[used] > 0)
    assert np.all(ts[used] < 0.04 + field.voxel)
    assert np.all(used.sum(axis=1) >= 16)


def test_rays_along_an_axis_in_the_grid_planes_meet_what_tilted_ones_meet():
    field = block((0.04, 0.03, 0.05))
    plane = float(field.origin[0] + 8 * field.voxel)
    origins = np.float32([[plane, 0.0, 1.0], [plane, 1e-7, 1.0]])
    directions = np.float32([[0, 0, -1], [1e-7, 1e-7, -1]])
    ts, used = march(field, origins, directions, step=0.0025, **EVERYTHING)
    assert used[0].sum() == used[1].sum() > 30
    np.testing.assert_allclose(ts[0], ts[1], atol=1e-6)


def test_a_far_away_origin_leads_neither_out_of_the_grid_nor_astray():
    field = block((0.04, 0.03, 0.05))
    origins = np.float32([[0, 0, 1e4], [1e6, 1e6, 1e6]])
    directions = np.float32([[0, 0, -1], [-(3**-0.5)] * 3])
    ts, used = march(field, origins, directions, step=0.0025, **EVERYTHING)
    assert np.all(np.abs(ts[0][used[0]] - 1e4) < 0.1)


def test_limits_leave_out_what_does_not_matter():
    field = fog(g=0.0)
    origins, directions = np.float32([[0, 0, 1]]), np.float32([[0, 0, -1]])
    step = 0.5 * field.voxel
    everything, _ = march(field, origins, directions, step=step, **EVERYTHING)
    _, few = march(field, origins, directions, step=step, min_weight=0.0, min_transmittance=0.0, most=7)
    assert few.shape == (1, 7)
    assert few.all()
    # In a uniform slab the k-th sample weighs a (1 - a)^k.
    a = 1 - np.exp(-(softplus(0.0) - DENSITY_FLOOR) * 0.5)
    for least in (0.1, 0.01):
        ts, used = march(field, origins, directions, step=step, min_weight=least, min_transmittance=0.0, most=99)
        expected = np.floor(np.log(least / a) / np.log(1 - a)) + 1
        assert abs(used.sum() - expected) <= 1  # the first sample may lie in the rim
        assert np.isin(ts[used], everything[0]).all()
    _, used = march(field, origins, directions, step=step, min_weight=0.0, min_transmittance=0.5, most=99)
    assert abs(used.sum() - np.ceil(np.log(0.5) / np.log(1 - a))) <= 1


def test_layout_and_type_of_the_rays_do_not_matter():
    field = ball()
    origins, directions = rays_at(field, 16, 3)
    expected = march(field, origins, directions, step=0.0025)
    for change in (np.asfortranarray, lambda a: a.astype(float), lambda a: np.broadcast_to(a, a.shape)):
        ts, used = march(field, change(origins), change(directions), step=0.0025)
        np.testing.assert_array_equal(used, expected[1])
        np.testing.assert_allclose(ts, expected[0], atol=1e-6)


def test_no_rays_give_no_samples():
    ts, used = march(ball(), *np.zeros((2, 0, 3), np.float32), step=0.01)
    assert ts.shape == used.shape == (0, 24)
