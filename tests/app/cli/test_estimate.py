import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from app.cli.collect import CollectObservationCommand
from app.cli.estimate import Estimate, Render
from app.cli.main import main
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.steps import EstimateStep
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.files import write_json
from osfcore.io.observation_file import OBSERVATION_FILE, read_observation, write_observation
from osfcore.io.scene_file import Scene, read_estimated, read_scene, scene_to_json
from osfcore.progress import Progress
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
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
    assert call(folder, data_dir, "--before", str(folder / "before.json")) == 2
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
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name == "mujoco" else name)
    assert call(folder, data_dir, "--images", str(folder / "images")) == 0
    assert "predictions alone; the simulator lacks mujoco." in capsys.readouterr().out
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
    ("code", "change", "words"),
    [
        (2, lambda s: s["objects"][0].update(name="teapot"), "teapot"),
        (1, lambda s: s["objects"][0].update(quaternion=[1, 1, 0, 0]), "quaternion"),
        (1, lambda s: s["objects"][0].update(position=[0, float("nan"), 0]), "position"),
        (2, lambda s: s.update(objects=[]), "number of objects"),
        (2, lambda s: s.pop("pusher"), "pusher"),
    ],
)
def test_a_bad_state_is_told_in_one_sentence(files, data_dir, capsys, code, change, words):
    folder, _ = files
    content = json.loads((folder / "state.json").read_text())
    change(content)
    (folder / "state.json").write_text(json.dumps(content))
    assert call(folder, data_dir) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (folder / "rollouts.json").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--camera", "nowhere"], "goal"), (["--sequence", "2"], "between 0 and 1"), (["--device", "cuda"], "cuda")],
)
def test_bad_options_are_told_before_anything_is_written(files, data_dir, capsys, more, words):
    folder, _ = files
    assert call(folder, data_dir, "--images", str(folder / "images"), *more) == 2
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


@pytest.fixture
def scene_file(tmp_path):
    def write(*names: str):
        poses = Pose(np.tile([0.0, 0, 0.096], (len(names), 1)), np.tile([1.0, 0, 0, 0], (len(names), 1)))
        scene = Scene(SceneState(names, poses, Light(np.array([0.5, 0, 1.0])), None), default_cameras(64))
        path = tmp_path / "scene.json"
        path.write_text(json.dumps(scene_to_json(scene)))
        return path

    return write


def test_a_shipped_object_is_rendered_on_the_table(scene_file, tmp_path):
    out = tmp_path / "image.png"
    result = Render(scene_file(MUSTARD), out, data_dir=tmp_path).run()
    assert (result["width"], result["height"]) == (64, 64)
    pixels = np.asarray(Image.open(out)).astype(int)
    yellow = (pixels[..., 0] - pixels[..., 2] > 60).sum()
    assert 40 < yellow < 800  # a yellow bottle of about 9 x 17 px among grey wood


@pytest.mark.parametrize("camera", ["0", "goal"])
def test_a_scene_without_cameras_is_seen_by_the_usual_ones(scene_file, tmp_path, camera):
    path = scene_file(MUSTARD)
    content = json.loads(path.read_text())
    del content["cameras"]
    path.write_text(json.dumps({**content, "trusted": True}))
    result = Render(path, tmp_path / "image.png", camera=camera, data_dir=tmp_path).run()
    assert (result["width"], result["height"]) == (128, 128)


def test_mistakes_are_told_in_words(scene_file, tmp_path):
    out = tmp_path / "image.png"
    with pytest.raises(InvalidInput, check=about("camera")):
        Render(scene_file(MUSTARD), out, camera="9", data_dir=tmp_path).run()
    with pytest.raises(InvalidInput, check=about("output file")):
        Render(scene_file(MUSTARD), tmp_path / "image.jpg", data_dir=tmp_path).run()
    with pytest.raises(UnknownName, check=about("spoon")):
        Render(scene_file("spoon"), out, data_dir=tmp_path).run()
    with pytest.raises(CorruptFile):
        Render(tmp_path / "nothing.json", out, data_dir=tmp_path).run()
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        Render(scene_file(MUSTARD), tmp_path / "file" / "image.png", data_dir=tmp_path).run()


def test_a_disk_that_is_full_leaves_the_older_picture(scene_file, tmp_path, monkeypatch):
    out = tmp_path / "image.png"
    out.write_bytes(b"older")

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite):
        Render(scene_file(MUSTARD), out, data_dir=tmp_path).run()
    assert out.read_bytes() == b"older"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["image.png", "scene.json"]
