from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import MissingAssets
from osfcore.experiments.fields import (
    MIN_PIXELS,
    compare_scene,
    figures_of,
    mean_of,
    render_scene,
    simulate,
    simulate_relit,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.render.renderer import SceneRenderer
from osfcore.world.imaging import TABLE_ALBEDO
from osfcore.world.tasks import Draw, draw_scene
from tests.core.experiments.solids import SOLIDS


@pytest.fixture(scope="module")
def truth(library):
    draw = replace(draw_scene(SOLIDS, 3, 5, 0), light=Light.from_angles(1.0, 0.6))  # casts shadows in every view
    return simulate(draw, library, default_cameras(64))


def test_scenes_are_random_harsh_and_independent_of_each_other():
    names = tuple("abcdefgh")
    draws = [draw_scene(names, 3, 0, number) for number in range(200)]
    assert all(len(set(draw.names)) == 3 for draw in draws)
    assert {name for draw in draws for name in draw.names} == set(names)
    elevations = np.rad2deg(np.arcsin([draw.light.direction[2] for draw in draws]))
    assert 10 <= elevations.min() < 12
    assert elevations.max() > 70
    assert len({draw.seed for draw in draws}) == 200
    again = draw_scene(names, 3, 0, 7)
    assert (again.names, again.seed) == (draws[7].names, draws[7].seed)
    assert draw_scene(names, 3, 1, 7).seed != again.seed
    assert draw_scene(names, 2, 0, 7).seed == again.seed


def test_the_truth_shows_the_objects_their_shadows_and_no_pusher(truth):
    assert set(truth.state.names) == set(SOLIDS)
    assert truth.state.pusher is None
    assert truth.images.shape == (4, 64, 64, 3)
    assert truth.objects.any(axis=(1, 2)).all()
    assert not (truth.objects & truth.shadows).any()
    lit = np.array(TABLE_ALBEDO) * (0.25 + 0.75 * truth.state.light.direction[2])
    for camera, image, on_object, in_shadow in zip(
        truth.cameras, truth.images, truth.objects, truth.shadows, strict=True
    ):
        x, y = np.floor(camera.project(truth.state.poses.position)).astype(int).T
        assert on_object[y, x].all()
        assert in_shadow.sum() > MIN_PIXELS
        assert np.all(image[in_shadow] < lit - 1e-3)
        umbra = np.all(np.abs(image - 0.25 * np.array(TABLE_ALBEDO)) < 1e-4, axis=-1) & ~on_object
        assert umbra.any()
        assert in_shadow[umbra].all()


def test_relit_scenes_differ_by_their_light_alone(library):
    draw = draw_scene(SOLIDS, 2, 1, 0)
    lights = [Light.from_angles(0.7, np.deg2rad(elevation)) for elevation in (20, 70)]
    low, high = simulate_relit(draw, lights, library, default_cameras(48))
    for truth, light in zip((low, high), lights, strict=True):
        alone = simulate(replace(draw, light=light), library, default_cameras(48))
        np.testing.assert_array_equal(truth.images, alone.images)
        np.testing.assert_array_equal(truth.shadows, alone.shadows)
        np.testing.assert_array_equal(truth.state.poses.position, alone.state.poses.position)
        assert truth.state.light.angle_to(light) < 1e-6
    assert low.shadows.sum() > 2 * high.shadows.sum()
    np.testing.assert_array_equal(low.objects, high.objects)


def test_equal_images_score_best_and_each_kind_of_pixel_counts_for_its_own_figure(truth):
    for view in compare_scene(truth, truth.images):
        assert (view.psnr, view.psnr_object, view.psnr_shadow) == (100, 100, 100)
        assert view.ssim == pytest.approx(1)
    off = truth.images + 0.1 * truth.shadows[..., None]
    for view, in_shadow in zip(compare_scene(truth, off), truth.shadows, strict=True):
        assert view.psnr_shadow == pytest.approx(20, abs=1e-3)
        assert view.psnr_object == 100
        assert view.psnr == pytest.approx(20 - 10 * np.log10(in_shadow.mean()), abs=1e-3)
    off = truth.images + 0.1 * truth.objects[..., None]
    for view in compare_scene(truth, off):
        assert view.psnr_object == pytest.approx(20, abs=1e-3)
        assert view.psnr_shadow == 100


def test_hardly_any_pixels_give_no_figure_and_do_not_count(truth):
    few = np.zeros_like(truth.shadows)
    few[0, 0, :MIN_PIXELS] = True
    few[1, 0, : MIN_PIXELS - 1] = True
    figures = figures_of(compare_scene(replace(truth, shadows=few), truth.images))
    assert figures["psnr_shadow"] == [100, None, None, None]
    assert mean_of([figures, {"psnr_shadow": [50.0]}], "psnr_shadow") == 75
    assert mean_of([{"psnr_shadow": [None]}], "psnr_shadow") is None


def test_solids_of_the_right_size_cast_the_right_shadows(truth, solids):
    """Boxes and a can of one colour: objects differ, but table and shadows must agree."""
    fields = {name: solids.load(name) for name in SOLIDS}
    views = compare_scene(truth, render_scene(SceneRenderer(fields, solids.load_table()), truth))
    assert np.mean([view.psnr_shadow for view in views]) > 22
    assert np.mean([view.psnr_object for view in views]) > 12
    other = replace(truth, state=replace(truth.state, light=Light.from_angles(0.3, 0.5)))
    wrong = compare_scene(truth, render_scene(SceneRenderer(fields, solids.load_table()), other))
    assert np.mean([view.psnr_shadow for view in wrong]) < np.mean([view.psnr_shadow for view in views]) - 5


def test_objects_without_mesh_are_told(library):
    draw = Draw(("024_bowl", "006_mustard_bottle"), Light.from_angles(0, 1), 0)
    with pytest.raises(MissingAssets, match="024_bowl"):
        simulate(draw, library, default_cameras(32))
