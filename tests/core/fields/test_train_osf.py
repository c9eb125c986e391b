"""Train osf: osf training, optimization, validation, checkpoint."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.osf import DENSITY_GAIN, OSFSize
from osfcore.fields.rays import RayBatch, RaySource, camera_rays
from osfcore.fields.train_osf import (
    MOST_G,
    Checkpoint,
    Holdout,
    Rates,
    Stage,
    TeacherRecipe,
    TrainTeacher,
    baked_g,
    composite,
    corners,
    dilated_mask,
    first_teacher,
    inverse_density,
    read_checkpoint,
    restored_teacher,
    train_teacher,
    write_checkpoint,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import ImageSet, read_image_set
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.fields.rendered_sets import painted_block, write_object_set
from tests.core.render.scenes import ball, fog, fog_depth, random_field, state, view

# Osf training


CPU = torch.device("cpu")
SMALL = TeacherRecipe(OSFSize(2, 32), across=24, rays=256, rebake=20, rates=Rates(1e-2, 2e-3))


@pytest.fixture
def teacher(images):
    return first_teacher(images, silhouette_box(images), SMALL, np.random.default_rng(0), CPU)


def uniform(osf, sigma):
    """Make a network answer with the same density [1/m] everywhere."""
    with torch.no_grad():
        for parameter in (osf.material.weight, osf.material.bias):
            parameter.zero_()
        osf.material.bias[0] = float(np.log(np.expm1(sigma * osf.half_length / DENSITY_GAIN)))


@pytest.mark.usefixtures("one_thread")
def test_inverse_density_gives_back_g(teacher):
    g = np.linspace(-4, MOST_G, 50).astype(np.float32)
    query = KiloQuery(teacher.snapshot(), dtype=torch.float64)
    depth = query.sigma(torch.from_numpy(g.astype(np.float64))).numpy() * query.voxel
    np.testing.assert_allclose(inverse_density(depth.astype(np.float32)), g, atol=2e-3)


@pytest.mark.usefixtures("one_thread")
def test_inverse_density_ends_where_fields_do():
    found = inverse_density(np.array([0, 1e-4, 50, 1e6], np.float32))
    np.testing.assert_array_equal(found, [EMPTY_G, EMPTY_G, MOST_G, MOST_G])


@pytest.mark.usefixtures("one_thread")
def test_the_first_proposals_fill_the_silhouettes(teacher, images):
    """Each ray of a pixel well inside a silhouette finds samples."""
    source = RaySource(images)
    rays = source.batch(source.silhouette_pixels())
    uniform(teacher.network, 2000.0)
    with torch.no_grad():
        _, alpha = composite(teacher.network, teacher.snapshot(), rays, most=40)
    assert (alpha.numpy()[rays.alpha == 1] > 0.9).mean() > 0.97


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
def test_bakes_have_the_networks_density(teacher):
    grid = teacher.snapshot()
    uniform(teacher.network, 3 / grid.voxel)
    g = baked_g(teacher.network, corners(grid)[2:4, 3, 3], grid.voxel)
    np.testing.assert_allclose(KiloQuery(grid).sigma(torch.from_numpy(g)) * grid.voxel, 3, rtol=1e-3)


@pytest.mark.usefixtures("one_thread")
def test_corners_lie_where_the_box_ends(teacher):
    grid = teacher.snapshot()
    places = corners(grid)
    np.testing.assert_allclose([places[0, 0, 0], places[-1, -1, -1]], grid.box, atol=1e-5)


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
def test_a_teacher_learns_an_ellipsoid(pristine_set):
    first, last = (list(train_teacher(TrainTeacher(pristine_set, iterations=n), SMALL)) for n in (10, 150))
    assert first[-1].psnr_full is not None
    assert last[-1].psnr_full is not None
    assert last[-1].psnr_full > first[-1].psnr_full + 1
    assert last[-1].psnr_full > last[-1].psnr_mask > 17
    assert last[-1].progress.done == last[-1].progress.total == 150
    assert all(step.psnr_full is None for step in last[:-1])
    assert last[-1].proposal is not last[0].proposal


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("minutes", [0, -1, 1e6, float("nan")])
def test_budgets_out_of_range_are_refused(pristine_set, minutes):
    with pytest.raises(InvalidInput, match="minutes"):
        next(train_teacher(TrainTeacher(pristine_set, minutes=minutes)))


# Optimization


def rays_of(camera, light=(0.0, 0.0, 1.0)) -> RayBatch:
    origins, directions = camera_rays(camera)
    nothing = np.zeros((len(origins), 3), np.float32)
    lights = np.tile(np.float32(light), (len(origins), 1))
    return RayBatch(origins, directions, lights, nothing, nothing[:, 0])


@pytest.fixture(scope="module")
def rays(tmp_path_factory):
    images = read_image_set(write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block()), "train")
    source = RaySource(images)
    return source.batch(np.random.default_rng(0).permutation(source.silhouette_pixels())[:2000])


def stage_of(field) -> Stage:
    return Stage(field, Rates(1e-2, 1e-3), torch.device("cpu"))


def test_training_sees_what_the_renderer_draws():
    """A lone object over black, sample by sample the same."""
    for seed in (0, 5):
        field = random_field(np.random.default_rng(seed))
        camera, light = view((0.3, 0.1, 0.2), (0, 0, 0), 32, 30), np.array([0.6, 0.0, 0.8])
        colour, alpha = composite(KiloQuery(field), field, rays_of(camera, light), min_weight=1e-5, most=400)
        scene = SceneBatch.of(state({"it": (0, 0, 0)}, light))
        drawn = SceneRenderer({"it": field}, None).render(scene, [camera], outputs={"rgb", "opacity"})
        np.testing.assert_allclose(colour.detach().reshape(32, 32, 3), drawn.rgb[0, 0], atol=2e-3)
        np.testing.assert_allclose(alpha.detach().reshape(32, 32), drawn.opacity[0, 0, 0], atol=2e-3)


def test_a_slab_has_the_opacity_of_its_depth():
    field = fog((0.04, 0.04, 0.02), g=-2.0)
    rays = rays_of(view((0, 0, 2.0), (0, 0, 0), 16, 0.5))
    _, alpha = composite(KiloQuery(field), field, rays, min_weight=0.0, most=100)
    np.testing.assert_allclose(alpha.detach(), 1 - np.exp(-fog_depth(field, -2.0, 0.04)), atol=0.01)


def test_rays_that_meet_nothing_are_black_and_harmless():
    field = ball()
    colour, alpha = composite(KiloQuery(field), field, rays_of(view((0.5, 0, 0), (1, 0, 0), 16)))
    assert not colour.any()
    assert not alpha.any()


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


def test_rates_fall_exponentially():
    rates = Rates(1e-2, 1e-4)
    np.testing.assert_allclose([rates.at(s) for s in (0, 0.5, 1)], [1e-2, 1e-3, 1e-4], atol=1e-12)


# Validation


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> ImageSet:
    folder = write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block(), train=8, test=12)
    return read_image_set(folder, "test")


def nothing():
    """A field without any density: black images."""
    field = painted_block()
    return replace(field, index=np.zeros_like(field.index), rows=field.rows[:1])


def test_the_field_itself_is_nearly_perfect(images):
    look = Holdout(images).everything(painted_block())
    assert look.images == 12
    assert look.psnr_full > 33  # the images were drawn with four rays a pixel
    assert look.psnr_mask > 25
    assert look.psnr_mask < look.psnr_full


def test_psnr_is_that_of_each_image_averaged(images):
    """Against black, the error is the truth itself."""
    truth = images.rgba[..., :3] / 255 * (images.rgba[..., 3:] / 255)
    error = np.mean(truth**2, axis=-1)
    full = np.mean([-10 * np.log10(e.mean()) for e in error])
    masks = [dilated_mask(a) for a in images.rgba[..., 3]]
    inside = np.mean([-10 * np.log10(e[m].mean()) for e, m in zip(error, masks, strict=True)])
    look = Holdout(images).everything(nothing())
    assert look.psnr_full == pytest.approx(full, abs=1e-3)
    assert look.psnr_mask == pytest.approx(inside, abs=1e-3)


def test_a_glance_looks_at_a_few(images):
    look = Holdout(images).glance(painted_block())
    assert look.images == 6
    few = ImageSet(images.cameras[:2], images.light_directions[:2], images.rgba[:2])
    assert Holdout(few).glance(painted_block()).images == 2


def test_a_preview_shows_truth_ours_and_their_difference(images):
    look = Holdout(images).everything(nothing())
    assert look.preview.shape == (32, 96, 3)
    truth, ours, difference = np.split(look.preview.astype(int), 3, axis=1)
    assert truth.any()
    assert not ours.any()
    np.testing.assert_allclose(difference, np.minimum(4 * truth, 255), atol=2)


def test_a_mask_is_grown_by_two_pixels():
    alpha = np.zeros((12, 12), np.uint8)
    alpha[5, 6] = 1
    rows, columns = np.nonzero(dilated_mask(alpha))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (3, 7, 4, 8)
    assert len(rows) == 25


def test_perfection_is_100_db(images):
    """A black object met exactly; infinity would spoil every mean and is no JSON."""
    black = images.rgba[:1] * np.uint8([0, 0, 0, 1])
    look = Holdout(ImageSet(images.cameras[:1], images.light_directions[:1], black)).everything(nothing())
    assert (look.psnr_full, look.psnr_mask) == (100, 100)


# Checkpoint


MARK = {"settings": {"seed": 3, "minutes": 0.5, "iterations": None}, "images": 7}


@pytest.fixture
def checkpoint() -> Checkpoint:
    field = random_field(np.random.default_rng(0))
    stage = Stage(field, Rates(1e-2, 1e-3), torch.device("cpu"))
    random = {
        "numpy": np.random.default_rng(5).bit_generator.state,
        "torch": torch.Generator().manual_seed(1).get_state(),
    }
    clock = {"seconds": 12.5, "steps": 340, "looked_at": 10.0, "psnr": (30.0, 25.0)}
    return Checkpoint("fine", stage.snapshot(), stage.state(), clock, random)


def test_what_was_written_is_read(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    back = read_checkpoint(path, MARK)
    assert back is not None
    assert (back.stage, back.clock) == ("fine", checkpoint.clock)
    for name in ("origin", "index", "rows", "cells", "networks", "ambient", "density", "macro"):
        np.testing.assert_array_equal(getattr(back.field, name), getattr(checkpoint.field, name))
        assert getattr(back.field, name).dtype == getattr(checkpoint.field, name).dtype
    rng = np.random.default_rng(0)
    rng.bit_generator.state = back.random["numpy"]
    assert rng.random() == np.random.default_rng(5).random()
    generator = torch.Generator()
    generator.set_state(back.random["torch"])
    assert torch.rand(1, generator=generator) == torch.rand(1, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("mark", [{}, MARK | {"images": 8}, MARK | {"settings": {"seed": 4}}])
def test_other_runs_do_not_go_on_from_it(checkpoint, tmp_path, mark):
    write_checkpoint(tmp_path / "a.partial", checkpoint, MARK)
    assert read_checkpoint(tmp_path / "a.partial", mark) is None


def test_broken_files_are_passed_over(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    assert read_checkpoint(path, MARK) is None
    write_checkpoint(path, checkpoint, MARK)
    data = path.read_bytes()
    for garbage in (b"", b"PK", data[:1000], data[: len(data) // 2], data[:-1], bytes(100)):
        path.write_bytes(garbage)
        assert read_checkpoint(path, MARK) is None


def test_a_checkpoint_of_the_same_run_that_lacks_something_is_told_and_kept(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    content = torch.load(path)
    for lost in ("stage", "field", "optimiser", "clock", "random"):
        torch.save({key: value for key, value in content.items() if key != lost}, path)
        with pytest.raises(CorruptFile, match="delete it"):
            read_checkpoint(path, MARK)
        assert path.exists()


class _Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('ran')",))


def test_a_checkpoint_runs_no_code(tmp_path):
    torch.save({"fingerprint": MARK, "stage": _Evil()}, tmp_path / "a.partial")
    assert read_checkpoint(tmp_path / "a.partial", MARK) is None


def test_a_disk_that_refuses_leaves_the_former_one(checkpoint, tmp_path, monkeypatch):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    before = path.read_bytes()

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite, match="No space left"):
        write_checkpoint(path, checkpoint, MARK)
    assert path.read_bytes() == before
