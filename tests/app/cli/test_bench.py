import json
import sys
from functools import partial

import pytest

import osfcore.experiments.bench_estimation as bench_estimate
import osfcore.experiments.bench_rendering as bench
from app.cli.main import main
from osfcore.experiments import bench_rollouts as bench_dynamics
from osfcore.experiments.bench_estimation import BenchEstimate
from osfcore.experiments.bench_rendering import BenchRender
from tests.support.oracle import Oracle
from tests.support.solids import write_fields


@pytest.fixture
def fields_dir(data_dir, library, monkeypatch):
    """Solids for fields, and few and small images."""
    write_fields(data_dir, library)
    monkeypatch.setattr(bench, "CANDIDATES", 2)

    def small(**settings):
        return BenchRender(**settings, counts=(1, 2), sides=(16, 32), batches=(1, 2), side=32)

    monkeypatch.setattr(bench, "BenchRender", small)
    return data_dir


@pytest.mark.slow
def test_figures_are_the_last_line_as_json_and_a_file(fields_dir, tmp_path, capsys):
    arguments = ["bench", "render", "--data-dir", str(fields_dir), "--scenes", "2", "--repeats", "1"]
    assert main([*arguments, "--out", str(tmp_path / "out"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    keys = {"tinyrenderer_ms", "scene_ms", "ratio", "planning_renders_per_s", "reference_ms"}
    assert keys <= set(result)
    assert json.loads((tmp_path / "out" / "render.json").read_text()) == result
    assert (tmp_path / "out" / "render.png").stat().st_size > 1000
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "TinyRenderer" in shown
    assert "renders a second" in shown
    assert "Growth" in shown


@pytest.mark.slow
def test_estimates_are_timed(data_dir, library, tmp_path, capsys, monkeypatch):
    write_fields(data_dir, library)
    oracle = Oracle()
    oracle.install(monkeypatch, bench_estimate)
    monkeypatch.setattr(bench_estimate, "BenchEstimate", partial(BenchEstimate, objects=2, steps=2, size=32))
    arguments = ["bench", "estimate", "--data-dir", str(data_dir), "--scenes", "1"]
    assert main([*arguments, "--out", str(tmp_path / "out"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"first_s", "next_s", "goal_s", "refine_hz", "threads"} <= set(result)
    assert json.loads((tmp_path / "out" / "estimate.json").read_text()) == result
    assert main(arguments) == 0
    assert "1 scenes of 2 objects" in capsys.readouterr().out
    asked = len(oracle.asked)
    for code, more, words in (
        (2, ["--scenes", "0"], "number of scenes is 0"),
        (1, ["--out", "/proc/nowhere"], "/proc"),
    ):
        assert main([*arguments, *more]) == code
        assert words in capsys.readouterr().err
    assert len(oracle.asked) == asked


def test_mistakes_are_one_sentence(fields_dir, tmp_path, capsys):
    assert main(["bench", "render", "--data-dir", str(fields_dir), "--repeats", "0"]) == 2
    assert "repeats" in capsys.readouterr().err
    assert main(["bench", "render", "--data-dir", str(tmp_path / "nowhere")]) == 1
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("osf: ")


def test_places_and_seeds_are_tried_first(fields_dir, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "_Stage", None)  # nothing may be measured
    (tmp_path / "file").write_text("")
    (tmp_path / "out" / "render.png").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    for code, arguments, words in (
        (1, ["--out", str(tmp_path / "file")], "Not a directory"),
        (1, ["--out", str(tmp_path / "out")], "it is a folder"),
        (1, ["--out", str(tmp_path / ("x" * 300))], "too long"),
        (2, ["--seed", "-1"], "seed is -1"),
        (2, ["--seed", str(2**64)], "seed is"),
        (2, ["--scenes", "0"], "number of new scenes is 0"),
    ):
        assert main(["bench", "render", "--data-dir", str(fields_dir), *arguments]) == code
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("osf: ")
        assert words in line
    assert sorted(tmp_path.rglob("*")) == before


def test_the_command_explains_itself(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["bench", "--help"])
    assert stop.value.code == 0
    assert "render" in capsys.readouterr().out


@pytest.mark.slow
def test_rollouts_are_timed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_dynamics, "SEQUENCES", 20)
    arguments = ["bench", "dynamics", "--data-dir", str(tmp_path / "empty"), "--out", str(tmp_path)]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["rollout_steps_per_s"] == pytest.approx(200 / result["rollout_s"])
    assert json.loads((tmp_path / "dynamics.json").read_text()) == result
    assert main(arguments) == 0
    assert "steps of scenes a second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "option"), [("dynamics", "--scenes"), ("estimate", "--repeats"), ("render", "--device")]
)
def test_an_option_that_does_not_apply_is_refused(command, option, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["bench", command, option, "1"])
    assert stop.value.code == 2
    assert option in capsys.readouterr().err


def test_planners_are_compared(tmp_path, capsys):
    pytest.importorskip("gym_pusht")
    pytest.importorskip("pytorch_mppi")
    arguments = ["bench", "planner", "--tasks", "1", "--samples", "20", "--horizon", "2", "--steps", "2"]
    assert main([*arguments, "--out", str(tmp_path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(result["planners"]) == ["ours", "paper", "pytorch_mppi"]
    assert (result["samples"], result["horizon"], result["steps"], result["seed"]) == (20, 2, 2, 0)
    assert json.loads((tmp_path / "planner.json").read_text()) == result
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("1 tasks, 20 sequences of 2 actions")
    assert len(shown.splitlines()) == 5
    assert main([*arguments, "--tasks", "0"]) == 2
    assert "number of tasks is 0" in capsys.readouterr().err


def test_planners_need_the_benchmark(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    monkeypatch.setitem(sys.modules, "gym_pusht.envs.pusht", None)
    assert main(["bench", "planner"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'osf-manipulation[pusht]'" in line
