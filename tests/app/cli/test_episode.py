import contextlib
import csv
import io
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from app.cli.main import main
from app.episodes.clip import length_text
from app.episodes.request import EpisodeStep

BOX = "009_gelatin_box"
ASKED = ("--names", BOX, "--steps", "2", "--samples", "16", "--horizon", "6", "--despite-doubts", "--moved", "1")


class Ran:
    """A real episode, as short as one can be, and what it left."""

    def __init__(self, folder: Path, library):
        self.out = folder / "out"
        shutil.copytree(library.root, folder / "data" / "objects", copy_function=os.link)
        arguments = ["episode", "--out", str(self.out), *ASKED, "--seed", "0", "--json", "--data-dir"]
        with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(io.StringIO()) as told:
            self.code = main([*arguments, str(folder / "data")])
        self.lines, self.told = said.getvalue().splitlines(), told.getvalue()
        self.report = json.loads((self.out / "report.json").read_text())


@pytest.fixture(scope="module")
def ran(library, tmp_path_factory):
    return Ran(tmp_path_factory.mktemp("episode"), library)


@pytest.mark.slow
def test_the_last_line_is_the_report_without_its_steps(ran):
    assert ran.code == 0
    told = json.loads(ran.lines[-1])
    assert told == {key: value for key, value in ran.report.items() if key not in ("steps", "actions", "goal")}
    assert "[  0 %] Loading fields" in ran.told
    assert "[100 %]" in ran.told
    assert "Traceback" not in ran.told


@pytest.mark.slow
def test_nothing_else_is_on_stdout(ran):
    assert len(ran.lines) == 1


@pytest.mark.slow
def test_the_report_tells_what_was_asked_and_done(ran):
    report, settings = ran.report, ran.report["settings"]
    assert (report["seed"], report["objects"], report["moved"]) == (0, [BOX], [BOX])
    assert (settings["steps"], settings["plan"]["samples"], settings["plan"]["horizon"]) == (2, 16, 6)
    assert settings["despite_doubts"]
    assert report["outcome"] == "out of steps"
    assert report["steps_done"] == len(report["actions"]) == 2
    assert np.abs(report["actions"]).max() <= 0.3 + 1e-9
    assert report["score"]["moved"] == 1
    assert report["seconds"] > 0


@pytest.mark.slow
def test_every_step_has_its_times_offsets_and_truth(ran):
    steps = ran.report["steps"]
    assert [step["step"] for step in steps] == [0, 1, 2]
    assert set(steps[0]["seconds"]) == {"first", "goal"}
    for step in steps:
        assert all(value >= 0 for value in step["seconds"].values())
        assert step["estimate_off_mm"][BOX] < 10
        assert step["truly_to_goal_mm"][BOX] == pytest.approx(step["to_goal_mm"][BOX], abs=15)
        assert step["truth"]["objects"][0]["name"] == step["estimate"]["objects"][0]["name"] == BOX
    for step in steps[1:]:
        assert set(step["seconds"]) == {"estimate", "plan", "act"}
    assert steps[-1]["truly_to_goal_mm"][BOX] == pytest.approx(ran.report["score"]["moved_mm"], abs=1e-3)


@pytest.mark.slow
def test_every_step_has_a_row_and_a_frame(ran):
    count = len(ran.report["steps"])
    with (ran.out / "steps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == list(range(count))
    assert [float(row["image_cost"]) for row in rows] == [step["image_cost"] for step in ran.report["steps"]]
    assert len(list((ran.out / "frames").glob("*.png"))) == count
    video = cv2.VideoCapture(str(ran.out / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == count
    video.release()


@pytest.mark.slow
def test_everything_lies_in_the_folder_and_nothing_else(ran):
    names = {"report.json", "steps.csv", "goal.png", "frames", "video.mp4", "episode.viser", "trajectory.npz"}
    assert {path.name for path in ran.out.iterdir()} == names
    assert cv2.imread(str(ran.out / "goal.png")).shape == (128, 128, 3)
    assert (ran.out / "episode.viser").stat().st_size > 100_000


@pytest.mark.slow
def test_people_are_told_in_sentences(ran, tmp_path, data_dir, monkeypatch, capsys):
    noticed = [{"step": 1, "matter": "lamp", "text": "The lamp was moved."}]
    last = EpisodeStep(2, 2, "Done", report={**ran.report, "noticed": noticed})
    monkeypatch.setattr("app.episodes.request.run_episode", lambda order: iter([last]))
    out = tmp_path / "out"
    assert main(["episode", "--out", str(out), *ASKED, "--data-dir", str(data_dir)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"{ran.report['text']} 2 actions, ")
    assert "step 1: The lamp was moved." in shown
    assert f"{BOX} had to move; {BOX} ended farthest off, " in shown
    assert length_text(max(ran.report["steps"][-1]["truly_to_goal_mm"].values()) / 1000) in shown
    assert shown.endswith(f"{out}\n")


@pytest.mark.parametrize(
    ("code", "changes", "words"),
    [
        (2, ["--names", "teapot"], "There is no field named 'teapot'"),
        (1, ["--names", "002_master_chef_can"], "osf assets fetch"),
        (2, ["--steps", "0"], "number of steps is 0"),
        (2, ["--replan-every", "0"], "actions of each plan is 0"),
        (2, ["--samples", "0"], "number of samples is 0"),
        (2, ["--horizon", "0"], "horizon [actions] is 0"),
        (2, ["--temperature", "nan"], "temperature is nan"),
        (2, ["--moved", "5"], "number of objects that move is 5, but it must be between 1 and 1"),
        (2, ["--seed", "-1"], "seed is -1"),
        (2, ["--cost", "taste"], "There is no cost named 'taste'; known: image, pose"),
        (2, ["--device", "cuda"], "cuda"),
        (1, ["--out", "file"], "file"),
        (1, ["--goal", "file"], "file cannot be used"),
        (1, ["--goal", "nothing.png"], "nothing.png cannot be used"),
        (2, ["--goal", "wide.png"], "64 x 32"),
    ],
)
def test_mistakes_are_told_in_one_sentence_before_anything_is_written(
    tmp_path, data_dir, monkeypatch, capsys, code, changes, words
):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    Image.new("RGB", (64, 32)).save("wide.png")
    before = sorted(tmp_path.iterdir())
    assert main(["episode", "--out", "out", *ASKED, "--data-dir", str(data_dir), *changes]) == code
    told = capsys.readouterr()
    *progress, line = told.err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert all(text.startswith("[  0 %] Loading") for text in progress)
    assert told.out == ""
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("changes", [["--steps", "many"], ["--speed", "1"]])
def test_a_wrong_call_says_how_it_goes(tmp_path, capsys, changes):
    with pytest.raises(SystemExit) as wrong:
        main(["episode", "--out", str(tmp_path / "out"), *changes])
    assert wrong.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
