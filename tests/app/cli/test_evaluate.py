import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

import osfcore.experiments.estimation
import osfcore.experiments.estimation_tasks as tasks
import osfcore.experiments.fields
import osfcore.experiments.relighting as relighting
import osfcore.experiments.video_prediction as video
import osfcore.experiments.video_prediction as videos
from app.cli.evaluate import EvaluateFieldsCommand
from app.cli.main import main
from osfcore.control.events import Finished
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments import bench_rollouts as bench_dynamics
from osfcore.experiments import dynamics
from osfcore.experiments import rearrangement as mpc
from osfcore.experiments.estimation import EvaluateEstimate
from osfcore.experiments.fields import EvaluateFields
from osfcore.experiments.rearrangement_runs import Ended
from osfcore.experiments.relighting import CompareRelighting
from osfcore.experiments.video_prediction import CompareVideos
from osfcore.world.collect_images import CollectObject, collect_object
from tests.support.errors import about
from tests.support.oracle import Oracle
from tests.support.solids import SOLIDS, write_fields


@pytest.fixture
def fields_dir(data_dir, library, monkeypatch):
    """Solids for fields, and small images."""
    write_fields(data_dir, library)
    monkeypatch.setattr(osfcore.experiments.fields, "EvaluateFields", partial(EvaluateFields, size=32))
    return data_dir


@pytest.mark.slow
def test_figures_are_the_last_line_as_json(fields_dir, tmp_path, capsys):
    arguments = ["--out", str(tmp_path / "out"), "--data-dir", str(fields_dir), "--names", *SOLIDS[:2], "--tasks", "1"]
    assert main(["eval", "fields", *arguments, "--objects", "2", "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert set(result["objects"]) == set(SOLIDS[:2])
    assert result["scene_psnr_mean"] > 10
    assert SOLIDS[1] in told.err  # progress
    assert main(["eval", "fields", *arguments, "--objects", "2"]) == 0  # taken over
    shown = capsys.readouterr().out
    assert all(name in shown for name in SOLIDS[:2])
    assert f"{result['psnr_mask_mean']:.2f}" in shown
    assert "1 scenes" in shown


def test_any_set_and_weights(fields_dir, library, tmp_path):
    name = SOLIDS[2]
    for _ in collect_object(CollectObject(name, tmp_path / "set", 60, 32, seed=9), library):
        pass
    weights = fields_dir / "fields" / name / "field.safetensors"
    result = EvaluateFieldsCommand(tmp_path / "out", data=tmp_path / "set", weights=weights).run()
    assert set(result["objects"]) == {"set"}
    assert result["scene_psnr_mean"] is None
    with pytest.raises(InvalidInput):
        EvaluateFieldsCommand(tmp_path / "out", data=tmp_path / "set").run()
    table = fields_dir / "fields" / "table" / "field.safetensors"
    with pytest.raises(CorruptFile, check=about("format")):
        EvaluateFieldsCommand(tmp_path / "out", data=tmp_path / "set", weights=table).run()
    with pytest.raises(CorruptFile, check=about("anno.json")):
        EvaluateFieldsCommand(tmp_path / "out", data=tmp_path, weights=weights).run()


@pytest.fixture
def oracle(fields_dir, monkeypatch):
    """Estimators that know the truth, and little to do for them."""
    small = partial(EvaluateEstimate, size=32, steps=2)
    monkeypatch.setattr(osfcore.experiments.estimation, "EvaluateEstimate", small)
    oracle = Oracle()
    oracle.install(monkeypatch)
    return oracle


@pytest.mark.slow
def test_estimators_are_measured(fields_dir, oracle, capsys):
    arguments = ["--data-dir", str(fields_dir), "--names", *SOLIDS, "--tasks", "2", "--objects", "2", "--bad", "1",
                 "--workers", "1"]  # fmt: skip
    assert main(["eval", "estimate", *arguments, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert (result["objects_total"], result["frac_1cm_5deg"], result["track_lost"], result["bad_cases"]) == (4, 1, 0, 1)
    assert "Tracks (1 of 2)" in told.err
    assert (fields_dir / "evaluation" / "estimate" / "2-objects-seed-0" / "report.json").exists()
    asked = len(oracle.asked)
    assert main(["eval", "estimate", *arguments]) == 0  # taken over
    assert len(oracle.asked) == asked
    shown = capsys.readouterr().out
    for words in (
        "First frames: 2 scenes, 4 objects: 100.0 %",
        "0 of 2 lost",
        "Goals: 100.0 % of 8",
        "2 views",
        "Bad cases: 1",
    ):
        assert words in shown, words


@pytest.mark.slow
def test_estimators_are_measured_in_pieces(fields_dir, oracle, tmp_path, capsys):
    arguments = ["--data-dir", str(fields_dir), "--out", str(tmp_path), "--names", *SOLIDS, "--tasks", "1",
                 "--workers", "1"]  # fmt: skip
    assert main(["eval", "estimate", *arguments, "--parts", "first"]) == 0
    assert [what for what, _ in oracle.asked] == ["first search 4"]
    shown = capsys.readouterr().out
    assert "First frames" in shown
    assert not any(words in shown for words in ("Tracks", "Goals", "views", "Bad"))
    assert main(["eval", "estimate", *arguments, "--parts", "track", "--json"]) == 0
    assert [what for what, _ in oracle.asked] == ["first search 4", "next", "next"]
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["goal_frac_1cm_5deg"] is None


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        (2, ["--names", "teapot"], "teapot"),
        (2, ["--tasks", "0"], "number of tasks is 0"),
        (1, ["--names", "011_banana"], "osf assets fetch"),
    ],
)
def test_a_mistake_about_estimators_is_one_sentence(fields_dir, oracle, tmp_path, capsys, code, arguments, words):
    out = tmp_path / "out"
    assert main(["eval", "estimate", "--out", str(out), "--data-dir", str(fields_dir), *arguments]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()
    assert not oracle.asked


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--names", "teapot"], "teapot"), (["--tasks", "-1"], "scenes"), (["--objects", "9"], "between 1 and 8")],
)
def test_a_mistake_in_an_evaluation_of_fields_is_one_sentence(fields_dir, tmp_path, capsys, arguments, words):
    out = tmp_path / "out"
    assert main(["eval", "fields", "--out", str(out), "--data-dir", str(fields_dir), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()


@pytest.mark.slow
def test_predicted_pushes_are_measured(data_dir, library, monkeypatch, capsys):
    monkeypatch.setattr(dynamics, "_STEPS", 34)
    monkeypatch.setattr(dynamics, "COUNTS", (2, 3))
    monkeypatch.setattr(bench_dynamics, "SEQUENCES", 10)
    arguments = ["eval", "dynamics", "--data-dir", str(data_dir), "--tasks", "1", "--workers", "1"]
    assert main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert result["windows"] > 0
    assert "Predicting directed pushes of 3 objects" in told.err
    assert json.loads((data_dir / "evaluation" / "dynamics.json").read_text()) == result
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert f"{result['median_mm_4']:.1f} mm" in shown
    assert "2 objects" in shown


@pytest.fixture
def runs(monkeypatch):
    """Runs that cost nothing: all reach the goal. Tells by what futures were compared."""
    made, image = [], np.full((16, 16, 3), 0.5)

    def ours(task, _assets, _parts, settings, _rng, _factor, _variant, _published):
        made.append(settings.cost)
        yield Finished(0, "reached", "The table looks like the goal.", task.goal)
        yield Ended(task.goal, image, image)

    monkeypatch.setattr(mpc, "run_from_images", ours)
    monkeypatch.setattr(mpc, "run_told_the_truth", lambda task, *_, **__: Ended(task.goal, image, image))
    monkeypatch.setattr(mpc, "load_scene_models", lambda *_: SimpleNamespace(symmetries={}))
    return made


@pytest.mark.slow
def test_episodes_are_measured(data_dir, runs, capsys):
    arguments = ["eval", "mpc", "--data-dir", str(data_dir), "--tasks", "2", "--objects", "1", "--workers", "1"]
    assert main([*arguments, "--names", "009_gelatin_box", "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert (result["tasks"], result["objects"], result["success_2cm"], result["oracle_success_2cm"]) == (2, 1, 1, 1)
    assert (result["noaction_success_2cm"], result["final_mm_mean"], result["replan_s_median"]) == (0, 0, None)
    assert "2 of 4 episodes" in told.err
    assert json.loads((data_dir / "evaluation" / "mpc.json").read_text()) == result
    assert main([*arguments, "--names", "009_gelatin_box"]) == 0  # taken over
    shown = capsys.readouterr().out
    assert runs == ["pose", "pose"]
    for words in (
        "2 tasks of the family 'shifted' with 1 objects and 30 actions, pose cost:",
        "100.0 % within 2 cm and 0.1 rad (34 to 100.0 %)",
        "0 goals refused",
        "100.0 % of 1",
        "Told the truth",
        "A plan takes - s",
    ):
        assert words in shown, words
    assert main([*arguments, "--cost", "image", "--no-oracle"]) == 0
    assert "Told the truth" not in capsys.readouterr().out
    assert runs[2:] == ["image", "image"]


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        (2, ["--names", "teapot"], "teapot"),
        (2, ["--tasks", "0"], "number of tasks is 0"),
        (2, ["--objects", "7"], "between 1 and 6"),
        (2, ["--workers", "0"], "workers"),
        (2, ["--truths", "goal", "--method", "paper"], "given with method ours alone"),
        (2, ["--views", "5"], "between 1 and 4"),
        (2, ["--samples", "7"], "number of samples is 7"),
        (1, ["--method", "nerf", "--names", "013_apple"], "013_apple"),
    ],
)
def test_a_mistake_about_episodes_is_one_sentence(data_dir, runs, tmp_path, capsys, code, arguments, words):
    out = tmp_path / "out"
    assert main(["eval", "mpc", "--out", str(out), "--data-dir", str(data_dir), *arguments]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()
    assert not runs


def test_the_command_explains_itself(capsys):
    for command, option in (
        ("fields", "--weights"),
        ("estimate", "--bad"),
        ("dynamics", "--workers"),
        ("mpc", "--cost"),
        ("relighting", "--elevations"),
        ("video", "--steps"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["eval", command, "--help"])
        assert stop.value.code == 0
        assert option in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("mpc", "--bad"),
        ("dynamics", "--objects"),
        ("fields", "--workers"),
        ("estimate", "--data"),
        ("fields", "--cost"),
    ],
)
def test_an_option_that_does_not_apply_is_refused(command, option, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["eval", command, option, "1"])
    assert stop.value.code == 2
    assert option in capsys.readouterr().err


COMMON = ["--names", *SOLIDS, "--tasks", "1", "--objects", "2", "--workers", "1"]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small images, and predictions that take no time."""
    monkeypatch.setattr(relighting, "CompareRelighting", partial(CompareRelighting, size=32))
    monkeypatch.setattr(video, "CompareVideos", partial(CompareVideos, size=32))
    monkeypatch.setattr(tasks, "PUSHED_M", 0.0)
    monkeypatch.setattr(videos, "predict_through_fields", lambda seen, *_: np.full_like(seen.frames, 0.5))


@pytest.mark.slow
def test_lights_are_compared(data_dir, capsys):
    arguments = ["eval", "relighting", "--data-dir", str(data_dir), *COMMON, "--elevations", "20", "70"]
    arguments += ["--methods", "ours", "paper"]
    assert main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert (list(result["methods"]), result["elevations_deg"]) == (["ours", "paper"], [20, 70])
    assert "1 of 2 scenes" in told.err
    assert main(arguments) == 0  # taken over
    shown = capsys.readouterr().out
    assert "ours - paper" in shown
    assert f"{result['methods']['ours']['psnr']['spans']['all']['mean']:.4g}" in shown
    assert f"1 scenes. Pictures and figures: {data_dir / 'evaluation'}" in shown.replace("\n", " ")


@pytest.mark.slow
def test_predictions_are_compared(data_dir, tmp_path, capsys):
    arguments = ["eval", "video", "--data-dir", str(data_dir), "--out", str(tmp_path / "out"), *COMMON, "--steps", "2"]
    arguments += ["--methods", "copied", "ours"]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (list(result["methods"]), result["steps"]) == (["copied", "ours"], 2)
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "ours - copied" in shown
    assert f"{result['against']['copied']['psnr']['2']['difference']:.4g}" in shown


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        ("relighting", ["--methods", "ours", "--elevations", "2"], "elevations"),
        ("relighting", ["--methods", "ours", "--tasks", "0"], "number of tasks is 0"),
        ("relighting", ["--methods", "nerf", "--objects", "8", "--names"], "at least 8"),
        ("video", ["--methods", "copied", "--steps", "0"], "predicted steps is 0"),
        ("video", ["--methods", "copied", "--names", "teapot"], "teapot"),
    ],
)
def test_a_mistake_in_a_comparison_of_images_is_one_sentence(data_dir, tmp_path, capsys, command, arguments, words):
    out = tmp_path / "out"
    assert main(["eval", command, "--out", str(out), "--data-dir", str(data_dir), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--tasks", "0"], "number of tasks is 0"),
        (["--names", "teapot"], "teapot"),
        (["--seed", "-1"], "seed"),
        (["--objects", "9"], "objects in a scene is 9"),
        (["--actions", "0"], "number of steps is 0"),
    ],
)
def test_a_mistake_in_a_reproduction_is_one_sentence(data_dir, tmp_path, capsys, arguments, words):
    out = tmp_path / "report"
    assert main(["reproduce", "--out", str(out), "--data-dir", str(data_dir), "--only", "ladder", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()
