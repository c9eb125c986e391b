from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, FLOOR_G, KiloOSF, network_size
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import RaySource, first_shell, grid_over, least_opacity, march, refine, shell_field
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import ImageSet, read_image_set
from tests.support.rendered_scenes import ball, block, camera_rays, corners_of, fog, fog_depth, view
from tests.support.rendered_sets import directions, painted_ball, write_object_set

# Ray marching


EVERYTHING = {"min_weight": -1.0, "min_transmittance": -1.0, "most": 4096}  # also where float32 leaves no light


def optical_density(g):
    """Sigma * voxel."""
    return np.where(g <= FLOOR_G, 0, np.maximum(np.logaddexp(g, 0) - DENSITY_FLOOR, 0))


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


@pytest.mark.parametrize(("g", "axis"), [(-2.0, 0), (0.0, 1), (5.0, 2)])  # float32 resolves no denser slabs
def test_optical_depth_of_a_slab_is_density_times_thickness(g, axis):
    field = fog(g=g)
    origins, directions = np.zeros((2, 1, 3), np.float32)
    origins[0, axis], directions[0, axis] = -0.3, 1
    depth = depth_found(field, origins, directions, field.voxel / 8)
    np.testing.assert_allclose(depth, fog_depth(field, g, 0.08), rtol=2e-3)
    half = depth_found(field, np.zeros((1, 3), np.float32), directions, field.voxel / 8)  # begins inside
    np.testing.assert_allclose(half, depth / 2, rtol=2e-3)


@pytest.mark.parametrize("seed", range(3))
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
    found = {}
    for shift, offsets in ((0, None), (10, None), (0, np.linspace(0, 0.99, 30, dtype=np.float32))):
        begins = origins + shift * step * directions
        ts, used = march(field, begins, directions, step=step, offsets=offsets, **EVERYTHING)
        numbers = ts / step - (0.5 if offsets is None else offsets[:, None])
        np.testing.assert_allclose(numbers[used], np.round(numbers[used]), atol=1e-3)
        np.testing.assert_array_equal(np.sort(used, axis=1)[:, ::-1], used)  # used slots come first
        assert np.all((np.diff(ts, axis=1) > 0) | ~used[:, 1:])
        found.setdefault(shift, (ts[used], used))
    # What is met does not depend on where the ray begins, if it begins on the lattice.
    np.testing.assert_allclose(found[0][0], found[10][0] + 10 * step, atol=1e-5)
    np.testing.assert_array_equal(found[0][1], found[10][1])


def test_rays_that_miss_lie_in_grid_planes_or_begin_far_away_are_not_led_astray():
    field = block((0.04, 0.03, 0.05))
    origins = np.float32([[0, 0, 1], [0, 0, 1], [0.2, 0, 1], [0, 0.0, -1], [1, 1, 0.0]])
    directions = np.float32([[0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0, -1], [0, -1, 0]])
    _, used = march(field, origins, directions, step=0.001, **EVERYTHING)
    assert not used.any()
    plane = float(field.origin[0] + 8 * field.voxel)
    origins = np.float32([[plane, 0.0, 1.0], [plane, 1e-7, 1.0]])
    directions = np.float32([[0, 0, -1], [1e-7, 1e-7, -1]])
    ts, used = march(field, origins, directions, step=0.0025, **EVERYTHING)
    assert used[0].sum() == used[1].sum() > 30
    np.testing.assert_allclose(ts[0], ts[1], atol=1e-6)
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
    a = 1 - np.exp(-(np.log(2) - DENSITY_FLOOR) * 0.5)
    for least in (0.1, 0.01):
        ts, used = march(field, origins, directions, step=step, min_weight=least, min_transmittance=0.0, most=99)
        expected = np.floor(np.log(least / a) / np.log(1 - a)) + 1
        assert abs(used.sum() - expected) <= 1  # the first sample may lie in the rim
        assert np.isin(ts[used], everything[0]).all()
    _, used = march(field, origins, directions, step=step, min_weight=0.0, min_transmittance=0.5, most=99)
    assert abs(used.sum() - np.ceil(np.log(0.5) / np.log(1 - a))) <= 1


# Ray sampling


@pytest.fixture
def images():
    """Three views of different cameras and lights, with random pixels and transparent borders."""
    rng = np.random.default_rng(0)
    cameras = tuple(view(p, size=24).resized(32, 24) for p in ((0.5, 0, 0.4), (0, 0.5, 0.2), (0.1, -0.3, 0.6)))
    rgba = rng.integers(0, 256, (3, 24, 32, 4)).astype(np.uint8)
    rgba[:, :8, :, 3] = 0
    return ImageSet(cameras, directions(rng, 3), rgba)


def test_pixels_are_numbered_through_images_rows_and_columns(images):
    """A ray meets, in its camera, the centre of the pixel whose colour it carries."""
    source = RaySource(images)
    assert source.image_shape == (24, 32)
    rng = np.random.default_rng(1)
    image, row, column = rng.integers((3, 24, 32), size=(50, 3)).T
    rays = source.batch(image * 24 * 32 + row * 32 + column)
    for i in range(50):
        camera = images.cameras[image[i]]
        np.testing.assert_allclose(rays.origins[i], camera.T_world_camera.position, atol=1e-6)
        pixel = camera.project(rays.origins[i].astype(float) + 0.3 * rays.directions[i])
        np.testing.assert_allclose(pixel, (column[i] + 0.5, row[i] + 0.5), atol=1e-3)
        rgba = images.rgba[image[i], row[i], column[i]] / 255
        np.testing.assert_allclose(rays.alpha[i], rgba[3], atol=1e-6)
        np.testing.assert_allclose(rays.rgb[i], rgba[:3] * rgba[3], atol=1e-6)  # over black
        np.testing.assert_allclose(rays.lights[i], images.light_directions[image[i]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    whole, (origins, ways) = source.batch(source.image_pixels(2)), camera_rays(images.cameras[2])
    np.testing.assert_allclose(whole.directions, ways, atol=1e-6)
    np.testing.assert_allclose(whole.origins, origins, atol=1e-6)
    np.testing.assert_allclose(whole.at(np.ones((len(ways), 1)))[:, 0], origins + ways, atol=1e-6)
    assert {a.dtype for a in (rays.origins, rays.directions, rays.lights, rays.rgb, rays.alpha)} == {np.dtype("f4")}


def test_silhouettes_are_taken_with_a_margin(images):
    images.rgba[...] = 0
    images.rgba[1, 10:12, 20, 3] = 1  # hardly visible counts too
    pixels = RaySource(images).silhouette_pixels()
    image, rest = np.divmod(pixels, 24 * 32)
    row, column = np.divmod(rest, 32)
    assert set(image) == {1}
    assert (row.min(), row.max(), column.min(), column.max()) == (7, 14, 17, 23)
    assert len(pixels) == 8 * 7


def test_the_smallest_opacity_over_views_is_found():
    cameras = [view(p, (0, 0, 0), 32, 40) for p in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    alphas = [np.full((32, 32), value, np.float32) for value in (0.9, 0.2, 0.5)]
    alphas[1][:, 16:] = 0.8  # right half, which for a camera at +y is x < 0
    points = np.tile(np.float32([[0.1, 0, 0], [-0.1, 0, 0], [5, 5, 5]]), (2000, 1))  # more than a row of OpenCV holds
    least = least_opacity(points, cameras, alphas, 0).reshape(2000, 3)
    np.testing.assert_allclose(least, np.tile([0.2, 0.5, 1.0], (2000, 1)), atol=1e-12)  # in no view: carved by none
    np.testing.assert_allclose(least_opacity(points[:3], cameras, alphas, 1), [0.5, 0.8, 1.0], atol=1e-12)


# Voxel shell


@pytest.fixture(scope="module")
def shell_images(tmp_path_factory):
    return read_image_set(write_object_set(tmp_path_factory.mktemp("sets") / "ball", painted_ball(), train=40), "train")


@pytest.fixture(scope="module")
def first(shell_images):
    box = silhouette_box(shell_images)
    rng = np.random.default_rng(0)
    return first_shell(shell_images, box, across=20, cells=3, hidden=4, inside_g=6.0, rng=rng)


@given(
    low=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    size=st.lists(st.floats(0.01, 3), min_size=3, max_size=3),
    across=st.integers(4, 64),
)
def test_a_grid_covers_its_box_and_one_voxel_more(low, size, across):
    box = np.array([low, np.add(low, size)])
    origin, voxel, shape = grid_over(box, across)
    far = origin + voxel * (np.array(shape) - 1)
    assert voxel == pytest.approx(max(size) / across)
    np.testing.assert_allclose((origin + far) / 2, box.mean(axis=0), atol=1e-6)
    assert np.all(origin <= box[0] - 0.99 * voxel)
    assert np.all(far >= box[1] + 0.99 * voxel)
    assert np.all(far - origin < np.array(size) + 3.01 * voxel)


def test_the_first_shell_fills_the_visual_hull(first):
    """The hull of a ball seen from all sides is about the ball."""
    radius = np.linalg.norm(corners_of(first), axis=1)
    g = first.rows[1:, 0]
    assert np.all(g[radius < 0.04] == 6.0)
    assert np.all(g[radius > 0.062] <= FLOOR_G)
    assert first.networks.shape == (27, network_size(4))
    assert first.cells.shape == (3, 3, 3)
    assert np.ptp(first.networks, axis=0).max() == 0  # cells begin in agreement
    assert np.ptp(first.networks) > 0
    # Dipoles point outward.
    rim = (radius > 0.042) & (radius < 0.055)
    outward = corners_of(first)[rim] / radius[rim, None]
    ours = first.rows[1:, 4:7][rim]
    assert np.mean(np.sum(outward * ours, axis=1)) > 0.9 * 0.75


def test_refining_changes_the_grid_but_not_the_field(first, shell_images):
    fine = refine(first, shell_images, across=40, rng=np.random.default_rng(0))
    assert fine.voxel == pytest.approx(np.ptp(first.extent, axis=0).max() / 40, rel=1e-5)
    # Only what is seen is kept: the inside of a solid is not.
    radius = np.linalg.norm(corners_of(fine), axis=1)
    assert radius.min() > 0.02
    surface = np.random.default_rng(0).normal(size=(200, 3))
    surface *= np.random.default_rng(1).uniform(0.046, 0.052, (200, 1)) / np.linalg.norm(surface, axis=1, keepdims=True)
    x = torch.tensor(surface, dtype=torch.float32)
    light, look = torch.nn.functional.normalize(x, dim=1), -torch.nn.functional.normalize(x, dim=1)
    before, after = (KiloQuery(f)(x, light, look) for f in (first, fine))
    np.testing.assert_allclose(after.ambient.detach(), before.ambient.detach(), atol=0.02)
    np.testing.assert_allclose(after.direct.detach(), before.direct.detach(), atol=0.1)
    g_before, g_after = (KiloQuery(f).features(x)[:, 0].detach().numpy() for f in (first, fine))
    assert np.mean(np.abs(g_before - g_after) < 1.0) > 0.9


def test_a_shell_is_stored_row_by_row_and_never_touches_the_faces():
    rng = np.random.default_rng(0)
    shape = (5, 6, 7)
    features = rng.normal(size=(*shape, FEATURES)).astype(np.float32)
    keep = rng.random(shape) < 0.6
    before = keep.copy()
    networks = np.zeros((1, network_size(5)), np.float32)
    field = shell_field(np.zeros(3), 0.1, features, keep, np.zeros((1, 1, 1), np.int32), networks, np.zeros(3))
    np.testing.assert_array_equal(keep, before)  # the caller's array stays
    assert field.hidden == 5
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = keep[1:-1, 1:-1, 1:-1]
    np.testing.assert_array_equal(field.index > 0, inner)
    np.testing.assert_array_equal(field.rows[field.index[inner]], features[inner])
    assert np.all(field.density[~inner] == EMPTY_G)
