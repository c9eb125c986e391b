import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from app.cli.main import main
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.files import write_json
from osfcore.io.scene_file import Scene, scene_to_json
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

NAMES = ("005_tomato_soup_can", "009_gelatin_box")


@pytest.fixture(scope="module")
def state(library) -> SceneState:
    world = Tabletop(library, request=SceneRequest(names=NAMES))
    world.arrange(3)
    state = world.truth()
    world.close()
    return state


@pytest.fixture
def files(state, tmp_path):
    """A scene, and one sequence toward the can and one of standing still."""
    write_json(tmp_path / "state.json", scene_to_json(Scene(state, ())))
    way = state.poses.position[0, :2] - state.pusher[:2]
    velocity = 0.28 * way / np.abs(way).max()
    count = int(np.ceil(np.abs(way).max() / 0.056)) + 1
    actions = np.zeros((2, count, 3))
    actions[0, :, :2] = velocity
    (tmp_path / "actions.json").write_text(json.dumps({"actions": actions.tolist(), "step_s": 0.2}))
    return tmp_path, count


def call(folder, data_dir, *more: str) -> int:
    given = [("--state", "state.json"), ("--actions", "actions.json"), ("--out", "rollouts.json")]
    places = [part for key, name in given for part in (key, str(folder / name))]
    return main(["predict", *places, "--data-dir", str(data_dir), *more])


def test_rollouts_are_written_and_told(files, state, data_dir, capsys):
    folder, count = files
    assert call(folder, data_dir, "--json") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["sequences"], result["steps"]) == (2, count)
    written = json.loads((folder / "rollouts.json").read_text())
    positions = np.array(written["positions"])
    assert positions.shape == (2, count + 1, 2, 3)
    assert tuple(written["names"]) == state.names
    np.testing.assert_allclose(positions[:, 0], np.stack([state.poses.position] * 2), atol=1e-8)
    assert np.linalg.norm(positions[0, -1, 0] - positions[0, 0, 0]) > 0.02  # the can was pushed
    assert (positions[1] == positions[1, :1]).all()
    assert result["farthest_mm"][NAMES[0]] > 20
    assert call(folder, data_dir) == 0
    shown = capsys.readouterr().out
    assert f"2 x {count} actions" in shown
    assert NAMES[0] in shown


def test_what_was_moving_goes_on(files, state, data_dir, capsys):
    folder, _ = files
    (folder / "actions.json").write_text(json.dumps({"actions": [[[0, 0, 0]]], "step_s": 0.2}))
    earlier = replace(state, poses=Pose(state.poses.position - [[0.03, 0, 0], [0, 0, 0]], state.poses.quaternion))
    write_json(folder / "before.json", scene_to_json(Scene(earlier, ())))
    assert call(folder, data_dir, "--before", str(folder / "before.json"), "--json") == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["farthest_mm"][NAMES[0]] > 0
    only = SceneState(state.names[:1], state.poses[:1], state.light, state.pusher)
    write_json(folder / "before.json", scene_to_json(Scene(only, ())))
    assert call(folder, data_dir, "--before", str(folder / "before.json")) == 1
    assert "objects one action ago" in capsys.readouterr().err


def test_the_papers_model_predicts_on_request(files, data_dir, capsys):
    folder, count = files
    assert call(folder, data_dir, "--json") == 0
    ours = json.loads((folder / "rollouts.json").read_text())
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    before = ["--before", str(folder / "state.json")]  # which plays no part
    assert call(folder, data_dir, "--method", "paper", *before, "--json") == 0
    paper = json.loads((folder / "rollouts.json").read_text())
    assert set(json.loads(capsys.readouterr().out.splitlines()[-1])) == set(told)
    assert set(paper) == set(ours)
    assert np.shape(paper["positions"]) == (2, count + 1, 2, 3)
    assert paper["positions"] != ours["positions"]
    assert paper["positions"][0][0] == ours["positions"][0][0]


def test_pictures_lie_beside_the_simulators(files, data_dir, capsys):
    folder, count = files
    assert (
        call(folder, data_dir, "--images", str(folder / "images"), "--sequence", "0", "--camera", "goal", "--json") == 0
    )
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(result["psnr"]) == count + 1
    assert result["psnr"][0] > 25
    assert (folder / "images" / "prediction.png").exists()
    assert len(list((folder / "images").glob("*_true.png"))) == count + 1


def test_without_meshes_there_are_predictions_alone(files, tmp_path, capsys):
    folder, count = files
    assert call(folder, tmp_path / "empty", "--images", str(folder / "images")) == 0
    assert "the simulator lacks" in capsys.readouterr().out
    assert len(list((folder / "images").glob("*.png"))) == count + 1


def test_without_the_simulator_there_are_predictions_alone(files, data_dir, capsys, monkeypatch):
    folder, count = files
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name == "pybullet" else name)
    assert call(folder, data_dir, "--images", str(folder / "images")) == 0
    assert "predictions alone; the simulator lacks pybullet." in capsys.readouterr().out
    assert len(list((folder / "images").glob("*.png"))) == count + 1


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ([[[0.31, 0, 0]]], "0.3"),
        ([[[0, 0, 0.1]]], "(vx, vy, 0)"),
        ([[[float("nan"), 0, 0]]], "finite"),
        ([[[1e400, 0, 0]]], "finite"),
        ([[[0, 0]]], "K x T x 3"),
        ([[]], "K x T x 3"),
        ([[[0, 0, 0]] * 10_000], "horizon [actions] is 10000"),
        (np.zeros((1, 0, 3)).tolist(), "K x T x 3"),
        ("push", "K x T x 3"),
        ([[[0, 0, 0]], [[0, 0, 0]] * 2], "K x T x 3"),
    ],
)
def test_bad_actions_are_told_in_one_sentence(files, data_dir, capsys, actions, words):
    folder, _ = files
    (folder / "actions.json").write_text(json.dumps({"actions": actions}))
    assert call(folder, data_dir) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not (folder / "rollouts.json").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s["objects"][0].update(name="teapot"), "teapot"),
        (lambda s: s["objects"][0].update(quaternion=[1, 1, 0, 0]), "quaternion"),
        (lambda s: s["objects"][0].update(position=[0, float("nan"), 0]), "position"),
        (lambda s: s.update(objects=[]), "number of objects"),
        (lambda s: s.pop("pusher"), "pusher"),
    ],
)
def test_a_bad_state_is_told_in_one_sentence(files, data_dir, capsys, change, words):
    folder, _ = files
    content = json.loads((folder / "state.json").read_text())
    change(content)
    (folder / "state.json").write_text(json.dumps(content))
    assert call(folder, data_dir) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (folder / "rollouts.json").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--camera", "nowhere"], "goal"), (["--sequence", "2"], "between 0 and 1"), (["--device", "cuda"], "cuda")],
)
def test_bad_options_are_told_before_anything_is_written(files, data_dir, capsys, more, words):
    folder, _ = files
    assert call(folder, data_dir, "--images", str(folder / "images"), *more) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (folder / "rollouts.json").exists()


def test_the_scenes_own_cameras_can_look(files, state, data_dir, capsys):
    folder, _ = files
    camera = default_cameras()[0].resized(48, 48)
    own = type(camera)("mine", camera.T_world_camera, camera.intrinsics, 48, 48)
    lit = SceneState(state.names, state.poses, Light(np.array([0.3, 0.2, 0.9])), state.pusher)
    write_json(folder / "state.json", scene_to_json(Scene(lit, (own,))))
    assert call(folder, data_dir, "--images", str(folder / "images"), "--camera", "mine", "--json") == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["psnr"]


@pytest.mark.slow
def test_every_shipped_field_has_a_shape():
    code = "from osfcore.dynamics.rollout import load_push_model; "
    code += "from osfcore.fields.field_library import FieldLibrary; "
    code += "f = FieldLibrary(None); print(len(load_push_model(None, f, f.names()).names))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == str(len(FieldLibrary(None).names())), done.stderr
