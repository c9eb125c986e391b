import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from app.cli.commands.collect import CollectObservationCommand
from app.cli.commands.estimate import Estimate
from app.cli.main import main
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.poses import rotation_angle
from osfcore.geometry.states import EstimatedState
from osfcore.io.observation_file import OBSERVATION_FILE, read_observation, write_observation
from osfcore.io.scene_file import read_estimated, read_scene
from osfcore.progress import Progress
from tests.support.errors import about

MUSTARD = "006_mustard_bottle"


@pytest.fixture
def scene(data_dir, tmp_path):
    CollectObservationCommand(tmp_path / "scene", (MUSTARD,), seed=2, size=64, data_dir=data_dir, json=True).run()
    return tmp_path / "scene"


@pytest.fixture
def untried(monkeypatch):
    """What is told before the work begins must be told without it."""
    for place in ("control.estimators.estimate_first", "estimation.goal_image.estimate_goal"):
        monkeypatch.setattr(f"osfcore.{place}", lambda *_: pytest.fail("the work began"))


@pytest.mark.slow
def test_an_observation_becomes_a_state_near_the_truth(scene, data_dir, tmp_path, capsys):
    out, sheets = tmp_path / "state.json", tmp_path / "sheets"
    arguments = ["estimate", "--observation", str(scene), "--out", str(out), "--data-dir", str(data_dir)]
    assert main([*arguments, "--images", str(sheets), "--json"]) == 0
    told = capsys.readouterr()
    (line,) = told.out.splitlines()
    result = json.loads(line)
    assert result.pop("seconds") > 0
    assert result == json.loads(out.read_text())
    assert "] Done" in told.err or "] 006_mustard_bottle" in told.err
    estimate, truth = read_estimated(out), read_scene(scene / "truth.json").state
    assert np.abs(estimate.state.poses.position - truth.poses.position).max() < 0.01
    assert np.rad2deg(rotation_angle(estimate.state.poses.quaternion, truth.poses.quaternion)).max() < 5
    assert np.rad2deg(np.arccos(np.clip(estimate.state.light.direction @ truth.light.direction, -1, 1))) < 5
    np.testing.assert_allclose(estimate.state.pusher, truth.pusher, atol=1e-12)
    assert sorted(path.name for path in sheets.iterdir()) == [f"comparison_{view}.png" for view in range(4)]
    with Image.open(sheets / "comparison_0.png") as sheet:
        assert sheet.size[1] > 3 * 64


def believed(state, reason="") -> EstimatedState:
    count = len(state.names)
    return EstimatedState(state, np.full(count, 0.002), np.full(count, 0.01), 0.1, (reason,) * count, reason)


def test_an_untrusted_goal_is_written_and_told_clearly(scene, data_dir, tmp_path, monkeypatch, capsys):
    CollectObservationCommand(tmp_path / "goal", (MUSTARD,), size=32, goal=True, data_dir=data_dir, json=True).run()
    state = read_scene(tmp_path / "goal" / "truth.json").state
    asked = {}

    def goal(models, observation, prior):
        asked.update(cameras=observation.cameras, prior=prior)
        yield EstimateStep(Progress(1, 2, "Looking"), "orientations", state)
        yield EstimateStep(Progress(2, 2, "Done"), "done", state, estimate=believed(state, "it is hardly visible"))

    monkeypatch.setattr("osfcore.estimation.goal_image.estimate_goal", goal)
    out = tmp_path / "goal.json"
    arguments = ["--observation", str(tmp_path / "goal"), "--out", str(out), "--data-dir", str(data_dir)]
    assert main(["estimate", *arguments, "--goal", "--prior", str(scene / "truth.json")]) == 0
    told = capsys.readouterr()
    assert [camera.name for camera in asked["cameras"]] == ["goal"]
    assert asked["prior"].names == (MUSTARD,)
    assert "[ 50 %] Looking" in told.err
    assert re.search(r"006_mustard_bottle +-?\d+\.\d\d +-?\d+\.\d\d +\d+\.\d\d +2.00 +0.57  it is hardly", told.out)
    assert re.search(r"Light: azimuth -?\d+\.\d deg, elevation \d+\.\d deg, \+- 5.73 deg.", told.out)
    assert "NOT TRUSTED: it is hardly visible." in told.out
    assert not read_estimated(out).trusted


def test_a_later_frame_begins_where_the_last_one_ended(scene, data_dir, tmp_path):
    write_observation(scene, replace(read_observation(scene), masks=None))
    Estimate(scene, tmp_path / "next.json", prior=scene / "truth.json", data_dir=data_dir, json=True).run()
    estimate, truth = read_estimated(tmp_path / "next.json"), read_scene(scene / "truth.json").state
    assert np.abs(estimate.state.poses.position - truth.poses.position).max() < 0.005
    np.testing.assert_array_equal(estimate.state.light.direction, truth.light.direction)  # held


def test_mistakes_are_told_before_the_work_begins(scene, data_dir, tmp_path, untried):
    def refused(kind, words, **changes):
        with pytest.raises(kind, match=words):
            Estimate(**{"observation": scene, "out": tmp_path / "state.json", "data_dir": data_dir, **changes}).run()
        assert not (tmp_path / "state.json").exists()

    (tmp_path / "file").write_text("")
    refused(InvalidInput, "ends in .json", out=tmp_path / "state.png")
    refused(CannotWrite, "file", out=tmp_path / "file" / "state.json")
    refused(CannotWrite, "file", images=tmp_path / "file" / "sheets")
    refused(InvalidInput, "another file than the observation", out=scene / OBSERVATION_FILE)
    refused(CorruptFile, "no folder with an observation.json", observation=tmp_path)
    refused(InvalidInput, "--prior is missing, but it must be given", goal=True)
    refused(CorruptFile, "No such file", goal=True, prior=tmp_path / "nothing.json")
    refused(InvalidInput, "seed", seed=-1)
    write_observation(tmp_path / "spoons", replace(read_observation(scene), names=("spoon",)))
    refused(UnknownName, "no field named 'spoon'", observation=tmp_path / "spoons")


def test_what_the_estimator_refuses_is_told(scene, data_dir, tmp_path):
    arguments = {"out": tmp_path / "state.json", "data_dir": data_dir}
    write_observation(scene, replace(read_observation(scene), masks=None))
    with pytest.raises(InvalidInput, check=about("masks")):
        Estimate(scene, **arguments).run()
    with pytest.raises(InvalidInput, check=about("views")):
        Estimate(scene, **arguments, goal=True, prior=scene / "truth.json").run()
    assert not (tmp_path / "state.json").exists()
