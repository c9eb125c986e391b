import json
import shutil
from dataclasses import replace

import cv2
import pytest

import osfcore.experiments.fields as module
from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.fields import (
    EvaluateFields,
    EvaluateSet,
    FieldFigures,
    FieldsReport,
    evaluate_fields,
    evaluate_set,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import read_field, write_field
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.collect_images import CollectTable, collect_table
from tests.core.experiments.solids import SOLIDS, write_fields

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
