import json
from functools import partial

import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as tasks
import osfcore.experiments.relighting as relighting
import osfcore.experiments.video_prediction as video
import osfcore.experiments.video_prediction as videos
from app.cli.main import main
from osfcore.experiments.relighting import CompareRelighting
from osfcore.experiments.video_prediction import CompareVideos
from tests.support.solids import SOLIDS

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
def test_a_mistake_is_one_sentence(data_dir, tmp_path, capsys, command, arguments, words):
    out = tmp_path / "out"
    assert main(["eval", command, "--out", str(out), "--data-dir", str(data_dir), *arguments]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()
