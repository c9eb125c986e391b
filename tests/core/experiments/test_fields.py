import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.fields as module
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.harness import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import read_field, write_field
from osfcore.fields.train_osf import Holdout
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.io.image_set import read_image_set
from osfcore.metrics.image_errors import dilated, psnr
from osfcore.render.reference import solid_field
from osfcore.render.renderer import SceneRenderer
from osfcore.world.collect_images import CollectTable, collect_table
from osfcore.world.imaging import TABLE_ALBEDO
from osfcore.world.tasks import draw_scene
from tests.support.ellipsoid_sets import CENTRE, HALF, write_set
from tests.support.errors import about
from tests.support.solids import SOLIDS, write_fields

# Evaluation


def last(steps):
    *_, step = steps
    return step


@pytest.fixture(scope="module")
def evaluated(solids, library, tmp_path_factory):
    """All three objects and two scenes of them, at a small size."""
    out = tmp_path_factory.mktemp("evaluated")
    return out, list(module.evaluate_fields(module.EvaluateFields(out, tasks=2, size=32), solids, library))


def test_the_report_has_every_object_and_sheets_show_them(evaluated, solids):
    out, steps = evaluated
    result = json.loads(json.dumps(steps[-1].report))
    assert set(result["objects"]) == set(SOLIDS)
    rows = result["objects"]
    for name, row in rows.items():
        assert 10 < row["psnr_mask"] < row["psnr_full"] < 40
        assert 0 < row["ssim"] < 1
        assert (row["images"], row["minutes"], row["file_mb"]) == (40, 1.5, solids.info(name).bytes / 1e6)
    assert 15 < result["scene_psnr_mean"] < 40
    assert result["scene_psnr_object_mean"] < result["scene_psnr_mean"]
    assert result["scene_psnr_shadow_mean"] > 15
    for key in ("psnr_full", "psnr_mask", "ssim"):
        assert result[f"{key}_mean"] == pytest.approx(np.mean([row[key] for row in rows.values()]))
    assert (result["scenes"], result["max_file_mb"]) == (2, max(row["file_mb"] for row in rows.values()))
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert steps[-1].done == steps[-1].total == 5
    sheets = {"objects.png": 3, "scenes.png": 2, f"objects/{SOLIDS[0]}.png": 8, "scenes/0001.png": 4}
    for path, columns in sheets.items():
        height, width, _ = cv2.imread(str(out / path)).shape
        assert height > 3 * 32
        assert columns * 32 < width < columns * 32 + 64


@pytest.mark.slow
def test_what_was_measured_is_taken_over(evaluated, solids, library, monkeypatch):
    out, steps = evaluated
    simulated, real = [], module.simulate
    monkeypatch.setattr(module, "simulate", lambda *args: (simulated.append(args), real(*args))[1])
    config = module.EvaluateFields(out, tasks=2, size=32)
    assert last(module.evaluate_fields(config, solids, library)).report == steps[-1].report
    some = last(module.evaluate_fields(replace(config, names=SOLIDS[:1], tasks=0), solids, library)).report
    assert some["objects"][SOLIDS[0]] == steps[-1].report["objects"][SOLIDS[0]]
    assert not simulated
    last(module.evaluate_fields(replace(config, tasks=3), solids, library))
    assert len(simulated) == 1
    few = last(module.evaluate_fields(replace(config, names=SOLIDS[:2]), solids, library)).report
    assert (few["scene_psnr_mean"], few["scenes"]) == (None, 0)  # too few objects for a scene


@pytest.mark.slow
def test_a_killed_evaluation_goes_on_and_new_weights_are_measured_anew(library, tmp_path):
    write_fields(tmp_path / "data", library)
    fields = FieldLibrary(tmp_path / "data", shipped=tmp_path)
    config = module.EvaluateFields(tmp_path / "out", SOLIDS[:2], tasks=0, size=16)
    for step in module.evaluate_fields(config, fields, library):
        if step.done == 1 and "image 3" in step.note:
            break
    *steps, final = module.evaluate_fields(config, fields, library)
    assert {step.note.split()[0] for step in steps} == {SOLIDS[1]}  # the first one was done
    path = fields.info(SOLIDS[0]).path
    field = read_field(path)
    field.rows[:, 1:4] = 0
    write_field(path, field)
    second = last(module.evaluate_fields(config, fields, library)).report
    assert second["objects"][SOLIDS[0]]["psnr_mask"] < final.report["objects"][SOLIDS[0]]["psnr_mask"]
    assert second["objects"][SOLIDS[1]] == final.report["objects"][SOLIDS[1]]


def test_any_set_and_weights_can_be_measured_but_no_table(evaluated, solids, tmp_path):
    out, steps = evaluated
    (data,) = (out / "sets").glob(f"{SOLIDS[2]}*-0")
    weights = solids.info(SOLIDS[2]).path
    result = last(module.evaluate_set(module.EvaluateSet(data, weights, tmp_path / "out"))).report
    assert result["objects"][data.name] == steps[-1].report["objects"][SOLIDS[2]]
    assert (tmp_path / "out" / "objects.png").exists()
    list(collect_table(CollectTable(tmp_path / "table", images=60, size=16)))
    with pytest.raises(CorruptFile, check=about("opaque")):
        last(module.evaluate_set(module.EvaluateSet(tmp_path / "table", weights, tmp_path / "none")))
    assert not (tmp_path / "none").exists()


def test_weights_may_come_without_metrics(solids, tmp_path):
    bare = tmp_path / "bare.safetensors"
    bare.write_bytes(solids.info(SOLIDS[2]).path.read_bytes())
    for metrics in (None, "[]", '{"minutes": "many"}', "{", f'{{"minutes": {10**400}}}', "[" * 100_000):
        if metrics is not None:
            bare.with_suffix(".json").write_text(metrics)
        assert module.field_figures(TaskResult({}, ()), bare)["minutes"] is None


def test_what_cannot_be_measured_is_refused_before_anything_is_done(solids, library, tmp_path):
    config = module.EvaluateFields(tmp_path / "out")
    changes = {"number of names": {"names": ()}, "scenes": {"tasks": -1}, "objects": {"objects": 9},
               "seed": {"seed": -1}, "size": {"size": 2000}}  # fmt: skip
    for what, change in changes.items():
        with pytest.raises(InvalidInput, check=about(what)):
            next(module.evaluate_fields(replace(config, **change), solids, library))
    assert not (tmp_path / "out").exists()


# Views


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


def test_the_right_field_is_close_as_training_says_and_a_shifted_one_is_not(images, egg):
    right = list(module.compare_views(egg, images))
    assert np.mean([view.psnr_full for view in right]) > 28
    assert np.mean([view.ssim for view in right]) > 0.9
    look = Holdout(images).everything(egg)
    assert np.mean([view.psnr_full for view in right]) == pytest.approx(look.psnr_full, abs=0.3)
    assert np.mean([view.psnr_mask for view in right]) == pytest.approx(look.psnr_mask, abs=0.3)
    wrong = module.compare_views(replace(egg, origin=egg.origin + np.float32(0.1)), images)
    for a, b in zip(right, wrong, strict=True):
        assert b.psnr_mask < a.psnr_mask - 6
        assert b.ssim < a.ssim


def test_truth_is_premultiplied_over_black_and_figures_follow_from_the_images(images, egg):
    rgba = images.rgba.copy()
    rgba[..., :3] = 200
    rgba[..., 3] //= 2
    for view, alpha in zip(module.compare_views(egg, replace(images, rgba=rgba)), rgba[..., 3], strict=True):
        np.testing.assert_allclose(view.comparison.truth[..., 0], 200 * (alpha / 255), atol=0.51)
        truth, ours = view.comparison.truth / 255, view.comparison.ours / 255
        assert view.psnr_mask == pytest.approx(psnr(truth, ours, dilated(alpha > 0)), abs=0.1)
        assert view.psnr_full == pytest.approx(psnr(truth, ours), abs=0.1)


# Scenes


@pytest.fixture(scope="module")
def truth(library):
    draw = replace(draw_scene(SOLIDS, 3, 5, 0), light=Light.from_angles(1.0, 0.6))  # casts shadows in every view
    return module.simulate(draw, library, default_cameras(64))


def test_the_truth_shows_the_objects_their_shadows_and_no_pusher(truth):
    assert truth.state.pusher is None
    assert not (truth.objects & truth.shadows).any()
    lit = np.array(TABLE_ALBEDO) * (0.25 + 0.75 * truth.state.light.direction[2])
    views = zip(truth.cameras, truth.images, truth.objects, truth.shadows, strict=True)
    for camera, image, on_object, in_shadow in views:
        x, y = np.floor(camera.project(truth.state.poses.position)).astype(int).T
        assert on_object[y, x].all()
        assert in_shadow.sum() > module.MIN_PIXELS
        assert np.all(image[in_shadow] < lit - 1e-3)
        umbra = np.all(np.abs(image - 0.25 * np.array(TABLE_ALBEDO)) < 1e-4, axis=-1) & ~on_object
        assert umbra.any()
        assert in_shadow[umbra].all()


def test_relit_scenes_differ_by_their_light_alone(library):
    draw = draw_scene(SOLIDS, 2, 1, 0)
    lights = [Light.from_angles(0.7, np.deg2rad(elevation)) for elevation in (20, 70)]
    low, high = module.simulate_relit(draw, lights, library, default_cameras(32))
    alone = module.simulate(replace(draw, light=lights[1]), library, default_cameras(32))
    np.testing.assert_array_equal(high.images, alone.images)
    np.testing.assert_array_equal(high.shadows, alone.shadows)
    np.testing.assert_array_equal(high.state.poses.position, alone.state.poses.position)
    assert low.state.light.angle_to(lights[0]) < 1e-6
    assert high.state.light.angle_to(lights[1]) < 1e-6
    assert low.shadows.sum() > 2 * high.shadows.sum()
    np.testing.assert_array_equal(low.objects, high.objects)


def test_each_kind_of_pixel_counts_for_its_own_figure(truth):
    for view in module.compare_scene(truth, truth.images):
        assert (view.psnr, view.psnr_object, view.psnr_shadow) == (100, 100, 100)
        assert view.ssim == pytest.approx(1)
    off = truth.images + 0.1 * truth.shadows[..., None]
    for view, in_shadow in zip(module.compare_scene(truth, off), truth.shadows, strict=True):
        assert view.psnr_shadow == pytest.approx(20, abs=1e-3)
        assert view.psnr_object == 100
        assert view.psnr == pytest.approx(20 - 10 * np.log10(in_shadow.mean()), abs=1e-3)
    for view in module.compare_scene(truth, truth.images + 0.1 * truth.objects[..., None]):
        assert view.psnr_object == pytest.approx(20, abs=1e-3)
        assert view.psnr_shadow == 100


def test_hardly_any_pixels_give_no_figure_and_do_not_count(truth):
    few = np.zeros_like(truth.shadows)
    few[0, 0, : module.MIN_PIXELS] = True
    few[1, 0, : module.MIN_PIXELS - 1] = True
    figures = module.figures_of(module.compare_scene(replace(truth, shadows=few), truth.images))
    assert figures["psnr_shadow"] == [100, None, None, None]
    assert module.mean_of([figures, {"psnr_shadow": [50.0]}], "psnr_shadow") == 75
    assert module.mean_of([{"psnr_shadow": [None]}], "psnr_shadow") is None


def test_solids_of_the_right_size_cast_the_right_shadows(truth, solids):
    """Boxes and a can of one colour: objects differ, but table and shadows must agree."""
    renderer = SceneRenderer({name: solids.load(name) for name in SOLIDS}, solids.load_table())
    views = module.compare_scene(truth, module.render_scene(renderer, truth))
    assert np.mean([view.psnr_shadow for view in views]) > 22
    assert np.mean([view.psnr_object for view in views]) > 12
    other = replace(truth, state=replace(truth.state, light=Light.from_angles(0.3, 0.5)))
    wrong = module.compare_scene(truth, module.render_scene(renderer, other))
    assert np.mean([view.psnr_shadow for view in wrong]) < np.mean([view.psnr_shadow for view in views]) - 5
