"""Episodes as data sets of LeRobot, read back by the readers of their files, and by LeRobot itself where it is."""

import json
import os
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from app.cli.main import main
from app.episodes.file_names import GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE
from app.episodes.lerobot import NothingPushed, write_lerobot
from app.episodes.record import NoEpisode
from app.episodes.trajectory import Trajectory, write_trajectory
from osfcore.contrib.export.lerobot import DatasetSize
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.extras import MissingExtra
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import to_uint8, write_png
from osfcore.world.imaging import RayTracer, TracedMesh
from tests.support.errors import about

BOX, CAN = "009_gelatin_box", "005_tomato_soup_can"
LENGTHS = (3, 2)
SIDE = 64
TASK = "Push the gelatin box to its goal and leave the tomato soup can where it is."
GOAL = np.array([200, 40, 90], np.uint8)


def state(x):
    turns = quaternion_exp(np.array([[0.0, 0, 0.5], [0, 0, 4.0]]))  # q of the second has w < 0
    poses = Pose(np.array([[x, 0.05, 0.015], [-0.1, -0.1, 0.05]]), turns)
    return SceneState((BOX, CAN), poses, Light(np.array([0.3, -0.4, 0.87])), np.array([x - 0.06, 0.05, 0.06]))


def course(count):
    states = tuple(state(0.03 * n) for n in range(count + 1))
    return Trajectory(states, states[-1].poses, (), ())


def leave(place, trajectory, **report):
    """What an episode leaves."""
    place.mkdir(parents=True)
    write_trajectory(place / TRAJECTORY_FILE, trajectory)
    actions = [[0.15, 0.01 * n, 0.0] for n in range(len(trajectory.states) - 1)]
    (place / REPORT_FILE).write_text(json.dumps({"actions": actions, "moved": [BOX], **report}))
    write_png(place / GOAL_FILE, np.broadcast_to(GOAL, (48, 48, 3)))
    return place


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("episodes")
    return [leave(place / str(n), course(count)) for n, count in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def written(folders, library, tmp_path_factory):
    place = tmp_path_factory.mktemp("lerobot") / "set"
    assert write_lerobot(folders, library, place, image_side=SIDE) == DatasetSize(2, sum(LENGTHS), 1)
    return place


@pytest.fixture(scope="module")
def views(library):
    """What each camera sees of the first episode before each action."""
    tracer = RayTracer({name: TracedMesh(library.load(name).mesh) for name in (BOX, CAN)})
    states = course(LENGTHS[0]).states[:-1]
    return np.array([[to_uint8(p.rgb) for p in tracer.render(one, default_cameras(SIDE))] for one in states])


def read_video(path):
    """RGB frames, and how many a second."""
    video = cv2.VideoCapture(str(path))
    frames = []
    while (taken := video.read())[0]:
        frames.append(taken[1][..., ::-1])
    return np.array(frames), video.get(cv2.CAP_PROP_FPS)


def test_each_row_tells_the_state_before_its_action(written):
    table = pq.read_table(written / "data").to_pydict()
    steps = np.array(table["frame_index"])
    np.testing.assert_allclose(table["action"], [(0.15, 0.01 * n) for n in steps], atol=1e-6)
    np.testing.assert_allclose(table["observation.state"], [(0.03 * n - 0.06, 0.05) for n in steps], atol=1e-6)
    told = np.array(table["observation.environment_state"]).reshape(-1, 4, 7)
    np.testing.assert_allclose(told[:, 0, 0], 0.03 * steps, atol=1e-6)
    lengths = np.repeat(LENGTHS, LENGTHS)
    np.testing.assert_allclose(told[:, 2, 0], 0.03 * lengths, atol=1e-6)
    assert np.all(told[..., 3] >= 0)
    np.testing.assert_allclose(np.linalg.norm(told[..., 3:], axis=-1), 1, atol=1e-5)


def test_videos_show_what_the_cameras_saw(written, views):
    info = json.loads((written / "meta" / "info.json").read_text())
    told = pq.read_table(written / "meta" / "episodes").to_pylist()[0]
    names = [*(f"observation.images.camera_{n}" for n in range(4)), "observation.images.goal"]
    assert {key for key, feature in info["features"].items() if feature["dtype"] == "video"} == set(names)
    for number, name in enumerate(names):
        place = {key: told[f"videos/{name}/{key}"] for key in ("chunk_index", "file_index")}
        shown, fps = read_video(written / info["video_path"].format(video_key=name, **place))
        assert fps == info["fps"] == 5
        expected = views[:, number] if number < 4 else np.broadcast_to(GOAL, shown.shape)
        assert shown.shape == expected.shape
        assert np.abs(shown.astype(float) - expected).mean() < 4
        assert told[f"videos/{name}/to_timestamp"] == pytest.approx(0.2 * LENGTHS[0])


def test_a_goal_photo_of_another_shape_is_not_distorted(folders, library, tmp_path):
    place = leave(tmp_path / "episode", course(1))
    write_png(place / GOAL_FILE, np.broadcast_to(GOAL, (30, 60, 3)))
    write_lerobot([place], library, tmp_path / "set", obs="pixels", image_side=SIDE)
    video = tmp_path / "set" / "videos" / "observation.images.goal" / "chunk-000" / "file-000.mp4"
    ((shown,), _) = read_video(video)
    np.testing.assert_allclose(shown[SIDE // 2, SIDE // 2], GOAL, atol=8)
    assert shown[: SIDE // 4 - 4].max() < 16


@pytest.mark.slow
@pytest.mark.parametrize(("obs", "left_out"), [("poses", "observation.images"), ("pixels", "environment_state")])
def test_what_is_not_asked_for_is_left_out(folders, library, tmp_path, obs, left_out):
    write_lerobot(folders, library, tmp_path / "set", obs=obs, image_side=SIDE)
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    assert not [key for key in info["features"] if left_out in key]
    assert (tmp_path / "set" / "videos").exists() == (obs == "pixels")


def test_other_numbers_of_objects_go_with_pixels_alone(folders, library, tmp_path):
    alone = [SceneState((BOX,), one.poses[:1], one.light, one.pusher) for one in course(1).states]
    other = leave(tmp_path / "alone", Trajectory(tuple(alone), alone[-1].poses, (), ()))
    with pytest.raises(InvalidInput, check=about("objects")):
        write_lerobot([*folders, other], library, tmp_path / "set")
    assert write_lerobot([*folders, other], library, tmp_path / "set", obs="pixels", image_side=SIDE).tasks == 2


def test_an_episode_without_poses_of_its_goal_goes_with_pixels_alone(library, tmp_path):
    place = leave(tmp_path / "episode", replace(course(1), goal=None), moved=None)
    with pytest.raises(InvalidInput, check=about("goal")):
        write_lerobot([place], library, tmp_path / "set", obs="poses")
    write_lerobot([place], library, tmp_path / "set", obs="pixels", image_side=SIDE)
    (task,) = pq.read_table(tmp_path / "set" / "meta" / "episodes").to_pydict()["tasks"]
    assert task == ["Push the gelatin box and the tomato soup can to where the goal shows them."]


@pytest.mark.parametrize(
    ("chosen", "said"), [({"obs": "smells"}, "poses, pixels, both"), ({"image_side": 65}, "must be even")]
)
def test_choices_that_there_are_not_are_refused(folders, library, tmp_path, chosen, said):
    with pytest.raises(InvalidInput, match=said):
        write_lerobot(folders, library, tmp_path / "set", **chosen)


def test_folders_that_cannot_be_learned_from_are_refused_by_name(library, tmp_path):
    with pytest.raises(NoEpisode):
        write_lerobot([tmp_path / "nowhere"], library, tmp_path / "set")
    with pytest.raises(NothingPushed):
        write_lerobot([leave(tmp_path / "still", course(0))], library, tmp_path / "set")
    blind = replace(course(1), states=tuple(replace(one, pusher=None) for one in course(1).states))
    with pytest.raises(InvalidInput, check=about("pusher")):
        write_lerobot([leave(tmp_path / "blind", blind)], library, tmp_path / "set")
    with pytest.raises(CorruptFile):
        write_lerobot([leave(tmp_path / "torn", course(2), actions=[[0, 0, 0]])], library, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.slow
def test_the_command_writes_it_into_a_new_folder_alone(folders, library, tmp_path, capsys):
    (tmp_path / "objects").symlink_to(library.root)
    out = tmp_path / "set"
    command = ["lerobot", *map(str, folders), "--out", str(out), "--image-side", "64", "--data-dir", str(tmp_path)]
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == {"out": str(out), "episodes": 2, "frames": 5, "tasks": 1}
    assert main(command) == 2
    assert capsys.readouterr().err == f"osf: output folder is {out}, but it must be new or empty.\n"


def test_without_the_library_one_sentence_tells_what_to_install(folders, library, tmp_path, monkeypatch):
    monkeypatch.setattr("osfcore.extras.find_spec", lambda _: None)
    with pytest.raises(MissingExtra, check=about("lerobot")):
        write_lerobot(folders, library, tmp_path / "set")


OPENED = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("osf/episodes", root=sys.argv[1], delta_timestamps={"action": [0, 0.2]})
rows = [data[n] for n in range(len(data))]
image = lambda row, name: (255 * row[f"observation.images.{name}"]).permute(1, 2, 0).tolist()
print(json.dumps({
    "episodes": data.num_episodes, "tasks": [row["task"] for row in rows],
    "actions": [row["action"].tolist() for row in rows],
    "states": [row["observation.state"].tolist() for row in rows],
    "images": [image(row, "camera_2") for row in rows[:3]],
    "mean": data.meta.stats["observation.images.camera_2"]["mean"].reshape(-1).tolist(),
}))
"""


@pytest.mark.slow
def test_lerobot_reads_what_was_recorded(written, views, tmp_path):
    python = os.environ.get("OSF_TEST_LEROBOT_PYTHON")
    if not python:
        pytest.skip("OSF_TEST_LEROBOT_PYTHON names no Python that has LeRobot")
    environment = {"HF_HOME": str(tmp_path), "HF_HUB_OFFLINE": "1", "PATH": os.environ["PATH"]}
    done = subprocess.run(
        [python, "-c", OPENED, str(written)], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["episodes"] == 2
    assert told["tasks"] == [TASK] * sum(LENGTHS)
    steps = np.array([n for length in LENGTHS for n in range(length)])
    np.testing.assert_allclose(np.array(told["actions"])[:, 0, 1], 0.01 * steps, atol=1e-6)
    np.testing.assert_allclose(np.array(told["states"])[:, 0], 0.03 * steps - 0.06, atol=1e-6)
    assert np.abs(np.array(told["images"]) - views[:, 2]).mean() < 4
    np.testing.assert_allclose(told["mean"], views[:, 2].mean(axis=(0, 1, 2)) / 255, atol=0.02)
