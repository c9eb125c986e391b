"""Fields: evaluation, view figures, composite scenes."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.fields as module
from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.fields import (
    MIN_PIXELS,
    EvaluateFields,
    EvaluateSet,
    FieldFigures,
    FieldsReport,
    compare_scene,
    compare_views,
    evaluate_fields,
    evaluate_set,
    figures_of,
    mean_of,
    render_scene,
    simulate,
    simulate_relit,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import read_field, write_field
from osfcore.fields.train_osf import Holdout
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import read_image_set
from osfcore.metrics.image_errors import dilated, psnr
from osfcore.objects.asset_library import AssetLibrary
from osfcore.render.reference import solid_field
from osfcore.render.renderer import SceneRenderer
from osfcore.world.collect_images import CollectTable, collect_table
from osfcore.world.imaging import TABLE_ALBEDO
from osfcore.world.tasks import Draw, draw_scene
from tests.core.experiments.solids import SOLIDS, write_fields
from tests.core.fields.sets import CENTRE, HALF, write_set

# Evaluation


KEYS = {
    "psnr_full_mean",
    "psnr_mask_mean",
    "ssim_mean",
    "scene_psnr_mean",
    "scene_psnr_object_mean",
    "scene_psnr_shadow_mean",
    "max_file_mb",
    "objects",
}


def last(steps):
    *_, step = steps
    return step


@pytest.fixture(scope="module")
def evaluated(solids, library, tmp_path_factory):
    """All three objects and two scenes of them, at a small size."""
    out = tmp_path_factory.mktemp("evaluated")
    steps = list(evaluate_fields(EvaluateFields(out, tasks=2, size=32), solids, library))
    return out, steps


def refuse(*_args, **_more):
    raise AssertionError("this was measured before")


@pytest.mark.slow
def test_the_report_has_every_object_and_means_over_them(evaluated, solids):
    _, steps = evaluated
    result = json.loads(json.dumps(steps[-1].report.to_json()))
    assert set(result) >= KEYS
    assert set(result["objects"]) == set(SOLIDS)
    for name, row in result["objects"].items():
        assert 10 < row["psnr_mask"] < row["psnr_full"] < 40
        assert 0 < row["ssim"] < 1
        assert row["images"] == 40
        assert row["minutes"] == 1.5
        assert row["file_mb"] == solids.info(name).bytes / 1e6
    for key in ("psnr_full", "psnr_mask", "ssim"):
        rows = [row[key] for row in result["objects"].values()]
        assert result[f"{key}_mean"] == pytest.approx(sum(rows) / 3)
    assert result["max_file_mb"] == max(row["file_mb"] for row in result["objects"].values())
    assert 15 < result["scene_psnr_mean"] < 40
    assert result["scene_psnr_object_mean"] < result["scene_psnr_mean"]
    assert result["scene_psnr_shadow_mean"] > 15
    assert result["scenes"] == 2


@pytest.mark.slow
def test_progress_grows_and_only_the_last_step_reports(evaluated):
    _, steps = evaluated
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert steps[-1].done == steps[-1].total == 5
    assert all(step.report is None for step in steps[:-1])
    assert any("image 7 of 40" in step.note for step in steps)


def test_there_are_sheets_of_everything(evaluated):
    out, _ = evaluated
    for path, columns in (
        ("objects.png", 3),
        ("scenes.png", 2),
        (f"objects/{SOLIDS[0]}.png", 8),
        ("scenes/0001.png", 4),
    ):
        height, width, _ = cv2.imread(str(out / path)).shape
        assert height > 3 * 32
        assert columns * 32 < width < columns * 32 + 64


def test_what_was_measured_is_taken_over(evaluated, solids, library, monkeypatch):
    out, steps = evaluated
    monkeypatch.setattr(module, "compare_views", refuse)
    monkeypatch.setattr(module, "simulate", refuse)
    again = last(evaluate_fields(EvaluateFields(out, tasks=2, size=32), solids, library))
    assert again.report.to_json() == steps[-1].report.to_json()
    some = last(evaluate_fields(EvaluateFields(out, SOLIDS[:1], tasks=0, size=32), solids, library))
    assert some.report.objects[SOLIDS[0]] == steps[-1].report.objects[SOLIDS[0]]
    with pytest.raises(AssertionError, match="measured before"):  # a third scene is new
        last(evaluate_fields(EvaluateFields(out, tasks=3, size=32), solids, library))


def test_a_killed_evaluation_goes_on_and_new_weights_are_measured_anew(library, tmp_path, monkeypatch):
    write_fields(tmp_path / "data", library)
    fields = FieldLibrary(tmp_path / "data", shipped=tmp_path)
    config = EvaluateFields(tmp_path / "out", SOLIDS[:2], tasks=0, size=32)
    for step in evaluate_fields(config, fields, library):
        if step.done == 1 and "image 3" in step.note:
            break
    measured = []
    real = module.read_field
    monkeypatch.setattr(module, "read_field", lambda path: (measured.append(path.parent.name), real(path))[1])
    first = last(evaluate_fields(config, fields, library)).report
    assert measured == [SOLIDS[1]]

    path = fields.info(SOLIDS[0]).path
    field = read_field(path)
    field.rows[:, 1:4] = 0
    write_field(path, field)
    second = last(evaluate_fields(config, fields, library)).report
    assert measured == [SOLIDS[1], SOLIDS[0]]
    assert second.objects[SOLIDS[0]].psnr_mask < first.objects[SOLIDS[0]].psnr_mask
    assert second.objects[SOLIDS[1]] == first.objects[SOLIDS[1]]


@pytest.mark.slow
def test_another_mesh_is_measured_anew_alone_and_in_scenes(solids, library, tmp_path, monkeypatch):
    assets = AssetLibrary(shutil.copytree(library.root, tmp_path / "objects"))
    config = EvaluateFields(tmp_path / "out", SOLIDS, tasks=1, size=32)
    first = last(evaluate_fields(config, solids, assets)).report
    asset = assets.load(SOLIDS[0])
    assets.write(replace(asset, mesh=replace(asset.mesh, texture=asset.mesh.texture // 4)), "a test")
    simulated = []
    real = module.simulate
    monkeypatch.setattr(module, "simulate", lambda *args: (simulated.append(args), real(*args))[1])
    second = last(evaluate_fields(config, solids, assets)).report
    assert second.objects[SOLIDS[0]].psnr_mask != first.objects[SOLIDS[0]].psnr_mask
    assert second.objects[SOLIDS[1]] == first.objects[SOLIDS[1]]
    assert len(simulated) == 1
    assert second.scene_psnr_object != first.scene_psnr_object


def test_a_set_of_the_table_measures_no_object(solids, tmp_path):
    list(collect_table(CollectTable(tmp_path / "table", images=60, size=16)))
    weights = solids.info(SOLIDS[0]).path
    with pytest.raises(CorruptFile, match="opaque all over; an object before a transparent background is expected"):
        last(evaluate_set(EvaluateSet(tmp_path / "table", weights, tmp_path / "out")))
    assert not (tmp_path / "out").exists()


def test_other_seeds_are_other_images(evaluated, solids, library):
    out, steps = evaluated
    other = last(evaluate_fields(EvaluateFields(out, SOLIDS[:1], tasks=0, seed=1, size=32), solids, library)).report
    assert other.objects[SOLIDS[0]].psnr_full != steps[-1].report.objects[SOLIDS[0]].psnr_full
    assert other.objects[SOLIDS[0]].psnr_full == pytest.approx(steps[-1].report.objects[SOLIDS[0]].psnr_full, abs=3)


def test_too_few_objects_make_no_scenes(evaluated, solids, library):
    out, _ = evaluated
    result = last(evaluate_fields(EvaluateFields(out, SOLIDS[:2], size=32), solids, library)).report.to_json()
    assert (result["scene_psnr_mean"], result["scene_psnr_shadow_mean"], result["scenes"]) == (None, None, 0)


def test_any_set_and_weights_can_be_measured(evaluated, solids, tmp_path):
    out, steps = evaluated
    (data,) = (out / "sets").glob(f"{SOLIDS[2]}*-0")
    weights = solids.info(SOLIDS[2]).path
    step = last(evaluate_set(EvaluateSet(data, weights, tmp_path)))
    result = step.report.to_json()
    assert set(result) >= KEYS
    assert result["scene_psnr_mean"] is result["scene_psnr_object_mean"] is result["scene_psnr_shadow_mean"] is None
    assert step.report.objects[data.name] == steps[-1].report.objects[SOLIDS[2]]
    assert (tmp_path / "objects.png").exists()


def test_weights_may_come_without_metrics(solids, tmp_path):
    bare = tmp_path / "bare.safetensors"
    bare.write_bytes(solids.info(SOLIDS[2]).path.read_bytes())
    for metrics in (None, "[]", '{"minutes": "many"}', "{", f'{{"minutes": {10**400}}}', "[" * 100_000):
        if metrics is not None:
            bare.with_suffix(".json").write_text(metrics)
        figures = module.field_figures(module.TaskResult({**_figures(), "images": 1}, ()), bare)
        assert figures.minutes is None


def _figures():
    return {"psnr_full": 30.0, "psnr_mask": 25.0, "ssim": 0.9}


def test_means_are_over_objects():
    objects = {
        "a": FieldFigures(**_figures(), images=40, file_mb=0.5, minutes=None),
        "b": FieldFigures(40.0, 35.0, 0.8, 10, 1.5, 3.0),
    }
    result = FieldsReport(objects).to_json()
    assert result["psnr_full_mean"] == 35
    assert result["psnr_mask_mean"] == 30
    assert result["ssim_mean"] == pytest.approx(0.85)
    assert result["max_file_mb"] == 1.5


def test_what_cannot_be_measured_is_told_before_anything_is_done(solids, library, tmp_path):
    out = tmp_path / "out"
    cases = [
        (EvaluateFields(out, ("teapot",)), UnknownName, "teapot"),
        (EvaluateFields(out, ()), InvalidInput, "number of names is 0, but it must be 1 or more"),
        (EvaluateFields(out, tasks=-1), InvalidInput, "scenes"),
        (EvaluateFields(out, objects=9), InvalidInput, "objects in a scene"),
        (EvaluateFields(out, seed=-1), InvalidInput, "seed"),
        (EvaluateFields(out, size=2000), InvalidInput, "size"),
    ]
    for config, error, words in cases:
        with pytest.raises(error, match=words):
            next(evaluate_fields(config, solids, library))
    nothing = AssetLibrary(tmp_path / "none")
    with pytest.raises(MissingAssets, match=SOLIDS[0]):
        next(evaluate_fields(EvaluateFields(out), solids, nothing))
    with pytest.raises(MissingAssets, match=SOLIDS[1]):
        next(evaluate_fields(EvaluateFields(out, SOLIDS[1:2]), solids, nothing))
    with pytest.raises(InvalidInput, match="train one"):
        next(evaluate_fields(EvaluateFields(out), FieldLibrary(None, shipped=tmp_path), library))
    assert not out.exists()


# View figures


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return read_image_set(write_set(tmp_path_factory.mktemp("views") / "egg", test=6, size=48), "test")


@pytest.fixture(scope="module")
def egg():
    """The ellipsoid of those images as a field, where the images have it."""

    def depth(x):
        return (1 - np.linalg.norm(x / HALF, axis=-1)) * HALF.min()

    def normal(x):
        n = x / HALF**2
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)

    field = solid_field(depth, normal, HALF, (0.8, 0.5, 0.3), voxel=0.02, hidden=16)
    return replace(field, origin=(field.origin + CENTRE).astype(np.float32))


def test_the_right_field_is_close_and_a_shifted_one_is_not(images, egg):
    right = list(compare_views(egg, images))
    assert len(right) == 6
    assert np.mean([view.psnr_full for view in right]) > 28
    assert np.mean([view.ssim for view in right]) > 0.9
    shifted = replace(egg, origin=egg.origin + np.float32(0.1))
    wrong = list(compare_views(shifted, images))
    for a, b in zip(right, wrong, strict=True):
        assert b.psnr_mask < a.psnr_mask - 6
        assert b.ssim < a.ssim


def test_figures_agree_with_those_that_training_tells(images, egg):
    views = list(compare_views(egg, images))
    look = Holdout(images).everything(egg)
    assert np.mean([view.psnr_full for view in views]) == pytest.approx(look.psnr_full, abs=0.3)
    assert np.mean([view.psnr_mask for view in views]) == pytest.approx(look.psnr_mask, abs=0.3)


def test_truth_is_premultiplied_over_black_and_figures_follow_from_the_images(images, egg):
    rgba = images.rgba.copy()
    rgba[..., :3] = 200
    rgba[..., 3] //= 2
    half = replace(images, rgba=rgba)
    for view, alpha in zip(compare_views(egg, half), rgba[..., 3], strict=True):
        expected = 200 * (alpha / 255)
        np.testing.assert_allclose(view.comparison.truth[..., 0], expected, atol=0.51)
        truth, ours = view.comparison.truth / 255, view.comparison.ours / 255
        assert view.psnr_mask == pytest.approx(psnr(truth, ours, dilated(alpha > 0)), abs=0.1)
        assert view.psnr_full == pytest.approx(psnr(truth, ours), abs=0.1)
        assert to_uint8(truth).max() == 100  # 200 * 127 / 255


# Composite scenes


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
