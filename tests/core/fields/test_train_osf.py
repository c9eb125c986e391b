from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.osf import DENSITY_GAIN, OSFSize
from osfcore.fields.rays import RaySource
from osfcore.fields.train_osf import (
    MOST_G,
    Checkpoint,
    Holdout,
    Rates,
    Stage,
    TeacherRecipe,
    baked_g,
    corners,
    first_teacher,
    inverse_density,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import ImageSet, read_image_set
from osfcore.metrics.image_errors import dilated
from tests.support.rendered_scenes import ball, random_field
from tests.support.rendered_sets import painted_block, write_object_set

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
SMALL = TeacherRecipe(OSFSize(2, 32), across=24, rays=256, rebake=20, rates=Rates(1e-2, 2e-3))

# Teachers, and the grids that propose their samples


@pytest.fixture
def teacher(images):
    return first_teacher(images, silhouette_box(images), SMALL, np.random.default_rng(0), CPU)


def uniform(osf, sigma):
    """Make a network answer with the same density [1/m] everywhere."""
    with torch.no_grad():
        for parameter in (osf.material.weight, osf.material.bias):
            parameter.zero_()
        osf.material.bias[0] = float(np.log(np.expm1(sigma * osf.half_length / DENSITY_GAIN)))


def test_inverse_density_gives_back_g_and_ends_where_fields_do(teacher):
    g = np.linspace(-4, MOST_G, 50).astype(np.float32)
    query = KiloQuery(teacher.snapshot(), dtype=torch.float64)
    depth = query.sigma(torch.from_numpy(g.astype(np.float64))).numpy() * query.voxel
    np.testing.assert_allclose(inverse_density(depth.astype(np.float32)), g, atol=2e-3)
    found = inverse_density(np.array([0, 1e-4, 50, 1e6], np.float32))
    np.testing.assert_array_equal(found, [EMPTY_G, EMPTY_G, MOST_G, MOST_G])


def test_proposals_follow_the_network(teacher):
    hull = teacher.snapshot()
    places = corners(hull)
    np.testing.assert_allclose([places[0, 0, 0], places[-1, -1, -1]], hull.box, atol=1e-5)
    uniform(teacher.network, 1e-6)
    teacher.update_proposal()
    assert teacher.snapshot() is hull, "where nothing is found, everything is still looked at"
    uniform(teacher.network, 2 / hull.voxel)
    g = baked_g(teacher.network, places[2:4, 3, 3], hull.voxel)
    np.testing.assert_allclose(KiloQuery(hull).sigma(torch.from_numpy(g)) * hull.voxel, 2, rtol=1e-3)
    teacher.update_proposal()
    dense = KiloQuery(teacher.snapshot()).sigma(torch.from_numpy(teacher.snapshot().density)) * hull.voxel
    inside = hull.density > FLOOR_G
    np.testing.assert_allclose(dense.numpy()[inside], 2, rtol=1e-2)
    rim = (teacher.snapshot().density > FLOOR_G) & ~(hull.index > 0)
    assert rim.any(), "surfaces must be able to grow"
    assert dense.numpy()[rim].max() < 0.2


def test_a_teacher_learns_an_ellipsoid(teacher, images, pristine_set):
    source, rng, generator = RaySource(images), np.random.default_rng(0), torch.Generator()
    pixels = source.silhouette_pixels()
    holdout = Holdout(read_image_set(pristine_set, "test"), teacher.network)
    looks = []
    for steps in (10, 140):
        for k in range(steps):
            teacher.step(source.batch(rng.choice(pixels, 256)), k / 150, rng, generator)
        looks.append(holdout.everything(teacher.snapshot()))
    assert looks[1].psnr_full > looks[0].psnr_full + 1
    assert looks[1].psnr_full > looks[1].psnr_mask > 17


# Stages


@pytest.fixture(scope="module")
def block_set(tmp_path_factory):
    return write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block(), train=12, test=8)


@pytest.fixture(scope="module")
def rays(block_set):
    source = RaySource(read_image_set(block_set, "train"))
    return source.batch(np.random.default_rng(0).permutation(source.silhouette_pixels())[:2000])


def stage_of(field) -> Stage:
    return Stage(field, Rates(1e-2, 1e-3), CPU)


def test_steps_lower_the_loss_and_keep_features_in_bounds(rays):
    """From a grey ball toward the block that the images show."""
    stage, rng, generator = stage_of(ball(0.05)), np.random.default_rng(0), torch.Generator().manual_seed(0)
    losses = [stage.step(rays, n / 40, rng, generator) for n in range(40)]
    assert np.mean(losses[-5:]) < 0.75 * losses[0]
    field = stage.snapshot()
    np.testing.assert_array_equal(field.rows[0], [EMPTY_G, *[0] * 7])
    assert np.all(np.abs(field.rows[1:, 0]) <= 10 + 1e-5)
    assert np.all((field.rows[1:, 1:4] >= 0) & (field.rows[1:, 1:4] <= 1))
    assert np.all(np.abs(field.rows[1:, 4:]) <= 1.5 + 1e-5)
    assert np.all(field.ambient >= 0)


def test_a_stage_goes_on_from_its_state_as_if_nothing_had_happened(rays):
    one = stage_of(ball(0.05))
    rngs = [np.random.default_rng(0) for _ in range(2)]
    generators = [torch.Generator().manual_seed(0) for _ in range(2)]
    for n in range(8):
        one.step(rays, n / 16, rngs[0], generators[0])
    other = stage_of(one.snapshot())
    other.restore(one.state())
    rngs[1].bit_generator.state = rngs[0].bit_generator.state
    generators[1].set_state(generators[0].get_state())
    for n in range(8, 16):
        losses = [s.step(rays, n / 16, r, g) for s, r, g in zip((one, other), rngs, generators, strict=True)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-3)
    # Adam turns the last bit of a tiny gradient into a step, so single features may part ways a little.
    assert np.mean(np.abs(one.snapshot().rows - other.snapshot().rows)) < 1e-3


# Measuring


@pytest.fixture(scope="module")
def held_out(block_set) -> ImageSet:
    return read_image_set(block_set, "test")


def nothing():
    """A field without any density: black images."""
    field = painted_block()
    return replace(field, index=np.zeros_like(field.index), rows=field.rows[:1])


def test_the_field_itself_is_nearly_perfect_and_a_black_object_met_exactly_has_100_db(held_out):
    """Infinity would spoil every mean and is no JSON."""
    look = Holdout(held_out).everything(painted_block())
    assert look.images == 8
    assert look.psnr_full > 33  # the images were drawn with four rays a pixel
    assert look.psnr_full > look.psnr_mask > 25
    assert Holdout(held_out).glance(painted_block()).images == 6
    black = held_out.rgba[:1] * np.uint8([0, 0, 0, 1])
    look = Holdout(ImageSet(held_out.cameras[:1], held_out.light_directions[:1], black)).everything(nothing())
    assert (look.psnr_full, look.psnr_mask) == (100, 100)


def test_psnr_is_that_of_each_image_averaged(held_out):
    """Against black, the error is the truth itself."""
    truth = held_out.rgba[..., :3] / 255 * (held_out.rgba[..., 3:] / 255)
    error = np.mean(truth**2, axis=-1)
    full = np.mean([-10 * np.log10(e.mean()) for e in error])
    masks = [dilated(a > 0) for a in held_out.rgba[..., 3]]
    inside = np.mean([-10 * np.log10(e[m].mean()) for e, m in zip(error, masks, strict=True)])
    look = Holdout(held_out).everything(nothing())
    assert look.psnr_full == pytest.approx(full, abs=1e-3)
    assert look.psnr_mask == pytest.approx(inside, abs=1e-3)
    shown, ours, difference = np.split(look.preview.astype(int), 3, axis=1)
    assert shown.any()
    assert not ours.any()
    np.testing.assert_allclose(difference, np.minimum(4 * shown, 255), atol=2)


# Checkpoints


MARK = {"settings": {"seed": 3, "minutes": 0.5, "iterations": None}, "images": 7}


@pytest.fixture
def checkpoint() -> Checkpoint:
    stage = stage_of(random_field(np.random.default_rng(0)))
    numpy, generator = np.random.default_rng(5).bit_generator.state, torch.Generator().manual_seed(1).get_state()
    clock = {"seconds": 12.5, "steps": 340, "looked_at": 10.0, "psnr": (30.0, 25.0)}
    return Checkpoint("fine", stage.snapshot(), stage.state(), clock, {"numpy": numpy, "torch": generator})


class Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('ran')",))


def test_what_was_written_is_read_and_runs_no_code(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    assert Checkpoint.read(path, MARK) is None
    checkpoint.write(path, MARK)
    back = Checkpoint.read(path, MARK)
    assert back is not None
    assert (back.stage, back.clock) == ("fine", checkpoint.clock)
    for name in ("origin", "index", "rows", "cells", "networks", "ambient", "density", "macro"):
        np.testing.assert_array_equal(getattr(back.field, name), getattr(checkpoint.field, name))
        assert getattr(back.field, name).dtype == getattr(checkpoint.field, name).dtype
    assert back.random["numpy"] == checkpoint.random["numpy"]
    assert torch.equal(back.random["torch"], checkpoint.random["torch"])
    for mark in ({}, MARK | {"images": 8}, MARK | {"settings": {"seed": 4}}):
        assert Checkpoint.read(path, mark) is None
    torch.save({"fingerprint": MARK, "stage": Evil()}, path)
    assert Checkpoint.read(path, MARK) is None
