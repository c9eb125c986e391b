import copy

import numpy as np
import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.osf import DENSITY_GAIN, OSFSize
from osfcore.fields.rays import RayBatch, RaySource
from osfcore.fields.train_osf import (
    MOST_G,
    Rates,
    TeacherRecipe,
    TrainTeacher,
    baked_g,
    composite,
    corners,
    first_teacher,
    inverse_density,
    restored_teacher,
    train_teacher,
)
from osfcore.fields.visual_hull import silhouette_box

CPU = torch.device("cpu")
SMALL = TeacherRecipe(OSFSize(2, 32), across=24, rays=256, rebake=20, rates=Rates(1e-2, 2e-3))


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def teacher(images):
    return first_teacher(images, silhouette_box(images), SMALL, np.random.default_rng(0), CPU)


def uniform(osf, sigma):
    """Make a network answer with the same density [1/m] everywhere."""
    with torch.no_grad():
        for parameter in (osf.material.weight, osf.material.bias):
            parameter.zero_()
        osf.material.bias[0] = float(np.log(np.expm1(sigma * osf.half_length / DENSITY_GAIN)))


def test_inverse_density_gives_back_g(teacher):
    g = np.linspace(-4, MOST_G, 50).astype(np.float32)
    query = KiloQuery(teacher.snapshot(), dtype=torch.float64)
    depth = query.sigma(torch.from_numpy(g.astype(np.float64))).numpy() * query.voxel
    np.testing.assert_allclose(inverse_density(depth.astype(np.float32)), g, atol=2e-3)


def test_inverse_density_ends_where_fields_do():
    found = inverse_density(np.array([0, 1e-4, 50, 1e6], np.float32))
    np.testing.assert_array_equal(found, [EMPTY_G, EMPTY_G, MOST_G, MOST_G])


def test_the_first_proposals_fill_the_silhouettes(teacher, images):
    """Each ray of a pixel well inside a silhouette finds samples."""
    source = RaySource(images)
    rays = source.batch(source.silhouette_pixels())
    uniform(teacher.network, 2000.0)
    with torch.no_grad():
        _, alpha = composite(teacher.network, teacher.snapshot(), rays, most=40)
    assert (alpha.numpy()[rays.alpha == 1] > 0.9).mean() > 0.97


def test_opacity_of_a_slab(teacher):
    grid, sigma = teacher.snapshot(), 1.5
    uniform(teacher.network, sigma)
    inner = np.argwhere(grid.density > FLOOR_G).mean(axis=0).round().astype(int)
    column = grid.density[:, inner[1], inner[2]] > FLOOR_G
    length = column.sum() * grid.voxel
    middle = grid.origin + grid.voxel * inner
    origin = np.array([[grid.origin[0] - 1, middle[1], middle[2]]], np.float32)
    rays = RayBatch(
        origin, np.float32([[1, 0, 0]]), np.float32([[0, 0, 1]]), np.zeros((1, 3), np.float32), np.ones(1, np.float32)
    )
    with torch.no_grad():
        colour, alpha = composite(teacher.network, grid, rays, min_weight=0, most=256)
        scatter = teacher.network(
            torch.from_numpy(middle[None].astype(np.float32)),
            *(torch.from_numpy(a) for a in (rays.lights, rays.directions)),
        )
    low, high = (1 - np.exp(-sigma * (length + side * grid.voxel)) for side in (-1, 1))
    assert low <= float(alpha) <= high
    torch.testing.assert_close(colour.sum() > 0, torch.tensor(True))
    assert float(scatter.sigma) == pytest.approx(sigma, rel=1e-4)


def test_bakes_have_the_networks_density(teacher):
    grid = teacher.snapshot()
    uniform(teacher.network, 3 / grid.voxel)
    g = baked_g(teacher.network, corners(grid)[2:4, 3, 3], grid.voxel)
    np.testing.assert_allclose(KiloQuery(grid).sigma(torch.from_numpy(g)) * grid.voxel, 3, rtol=1e-3)


def test_corners_lie_where_the_box_ends(teacher):
    grid = teacher.snapshot()
    places = corners(grid)
    np.testing.assert_allclose([places[0, 0, 0], places[-1, -1, -1]], grid.box, atol=1e-5)


def test_proposals_follow_the_network(teacher):
    hull = teacher.snapshot()
    uniform(teacher.network, 1e-6)
    teacher.update_proposal()
    assert teacher.snapshot() is hull, "where nothing is found, everything is still looked at"
    uniform(teacher.network, 2 / hull.voxel)
    teacher.update_proposal()
    dense = KiloQuery(teacher.snapshot()).sigma(torch.from_numpy(teacher.snapshot().density)) * hull.voxel
    inside = hull.density > FLOOR_G
    np.testing.assert_allclose(dense.numpy()[inside], 2, rtol=1e-2)
    rim = (teacher.snapshot().density > FLOOR_G) & ~(hull.index > 0)
    assert rim.any(), "surfaces must be able to grow"
    assert dense.numpy()[rim].max() < 0.2


def test_a_teacher_goes_on_from_its_state_as_if_nothing_had_happened(teacher, images):
    source = RaySource(images)
    batches = [source.batch(np.random.default_rng(k).choice(source.silhouette_pixels(), 256)) for k in range(4)]
    generator = torch.Generator()
    for k in (0, 1):
        teacher.step(batches[k], 0.1 * k, np.random.default_rng(k), generator)
    other = restored_teacher(teacher.snapshot(), copy.deepcopy(teacher.state()), SMALL, CPU)
    ends = []
    for learner in (other, teacher):
        ends.append([learner.step(batches[k], 0.1 * k, np.random.default_rng(k), generator) for k in (2, 3)])
    assert ends[0] == pytest.approx(ends[1], rel=1e-6)


def test_a_teacher_learns_an_ellipsoid(pristine_set):
    first, last = (list(train_teacher(TrainTeacher(pristine_set, iterations=n), SMALL)) for n in (10, 150))
    assert first[-1].psnr_full is not None
    assert last[-1].psnr_full is not None
    assert last[-1].psnr_full > first[-1].psnr_full + 1
    assert last[-1].psnr_full > last[-1].psnr_mask > 17
    assert last[-1].progress.done == last[-1].progress.total == 150
    assert all(step.psnr_full is None for step in last[:-1])
    assert last[-1].proposal is not last[0].proposal


@pytest.mark.parametrize("minutes", [0, -1, 1e6, float("nan")])
def test_budgets_out_of_range_are_refused(pristine_set, minutes):
    with pytest.raises(InvalidInput, match="minutes"):
        next(train_teacher(TrainTeacher(pristine_set, minutes=minutes)))
