"""Episodes as MCAP files, opened again by MCAP's own reader."""

import importlib
import json
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from app.cli.main import main
from app.episodes.file_names import FRAMES_FOLDER, GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE
from app.episodes.mcap import write_mcap
from app.episodes.trajectory import Round, Trajectory, write_trajectory
from osfcore.extras import MissingExtra
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.image_file import write_png
from osfcore.planning.mppi import PlanSketch
from tests.support.errors import about

BOX = "009_gelatin_box"
STEPS = 3
TURN = quaternion_exp(np.array([0.1, -0.2, 0.7]))
NOTICED = "The lamp was moved by 20°: found again."


def at(x):
    return Pose(np.array([[x, 0.05, 0.015]]), TURN[None])


def state(x):
    return SceneState((BOX,), at(x), Light(np.array([0.3, -0.4, 0.87])), np.array([-0.1, 0.1, 0.06]))


def estimate(x):
    return EstimatedState(state(x), np.zeros(1), np.zeros(1), 0.0, ("",), "")


def plan():
    way = np.linspace([-0.1, 0.1, 0.06], [0.2, 0.1, 0.06], 5)[None]
    future = Rollouts((BOX,), np.zeros((1, 5, 1, 3)), np.tile(TURN, (1, 5, 1, 1)), way)
    return PlanSketch(0, way[..., :2], np.zeros(1), future)


@pytest.fixture
def folder(tmp_path):
    """What an episode leaves: three actions in one round, the box moved by 3 cm in each."""
    place = tmp_path / "episode"
    (place / FRAMES_FOLDER).mkdir(parents=True)
    rounds = (Round(0, estimate(0.001), None), Round(STEPS, estimate(0.091), plan()))
    states = tuple(state(0.03 * n) for n in range(STEPS + 1))
    write_trajectory(place / TRAJECTORY_FILE, Trajectory(states, at(0.1), (), rounds))
    report = {"text": "The table looks like the goal.", "steps_done": STEPS}
    noticed = [{"step": 2, "matter": "lamp", "text": NOTICED}]
    (place / REPORT_FILE).write_text(json.dumps({**report, "noticed": noticed}))
    for path in (place / GOAL_FILE, *(place / FRAMES_FOLDER / f"{n:03d}.png" for n in range(2))):
        write_png(path, np.full((64, 64, 3), 90, np.uint8))
    return place


@pytest.fixture
def read(folder, library, tmp_path):
    """Messages by topic, with their times [s]."""
    path = tmp_path / "out" / "episode.mcap"
    assert write_mcap(folder, library, path) == pytest.approx(0.2 * STEPS)
    messages = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time / 1e9, decoded))
    return messages


def poses(read, frame):
    """Times [s], positions [m] and quaternions (x, y, z, w) of a frame."""
    found = [(s, t) for s, message in read["/tf"] for t in message.transforms if t.child_frame_id == frame]
    positions = [(t.translation.x, t.translation.y, t.translation.z) for _, t in found]
    quaternions = [(t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w) for _, t in found]
    return np.array([s for s, _ in found]), np.array(positions), np.array(quaternions)


def test_every_topic_has_its_schema(read):
    kinds = {topic: {type(message).DESCRIPTOR.full_name for _, message in found} for topic, found in read.items()}
    scenes = {topic: {"foxglove.SceneUpdate"} for topic in ("/scene", "/estimate", "/goal", "/plan")}
    images = {topic: {"foxglove.CompressedImage"} for topic in ("/goal/image", "/frames")}
    others = {"/tf": {"foxglove.FrameTransforms"}, "/log": {"foxglove.Log"}}
    assert kinds == {**scenes, **images, **others, "/goal/calibration": {"foxglove.CameraCalibration"}}


def test_frames_are_where_the_episode_had_things(read):
    times_s, positions, quaternions = poses(read, BOX)
    np.testing.assert_allclose(times_s, 0.2 * np.arange(STEPS + 1), atol=1e-12)
    np.testing.assert_allclose(positions[:, 0], 0.03 * np.arange(STEPS + 1), atol=1e-6)
    np.testing.assert_allclose(quaternions, np.tile(np.roll(TURN, -1), (STEPS + 1, 1)), atol=1e-6)
    thought_s, thought, _ = poses(read, f"estimate/{BOX}")
    np.testing.assert_allclose(thought_s, [0, 0.2 * STEPS], atol=1e-12)
    np.testing.assert_allclose(thought[:, 0], [0.001, 0.091], atol=1e-6)
    np.testing.assert_allclose(poses(read, f"goal/{BOX}")[1][0], at(0.1).position[0], atol=1e-6)
    np.testing.assert_allclose(poses(read, "pusher")[1], np.tile([-0.1, 0.1, 0.06], (STEPS + 1, 1)), atol=1e-6)


def test_the_goal_camera_looks_along_its_z_at_what_it_shows(read):
    """The scene's centre, taken through frame and calibration, is in the middle of the goal image."""
    (_, calibration), camera = read["/goal/calibration"][0], goal_camera(64)
    _, position, quaternion = poses(read, "goal_camera")
    seen = Rotation.from_quat(quaternion[0]).inv().apply(np.array([0, 0, 0.04]) - position[0])
    pixel = np.array(calibration.K).reshape(3, 3) @ (seen / seen[2])
    np.testing.assert_allclose(pixel[:2], (32, 32), atol=1e-6)
    np.testing.assert_allclose(np.array(calibration.P).reshape(3, 4)[:, :3], camera.intrinsics, atol=1e-12)
    assert (calibration.width, calibration.height) == (64, 64)


def test_objects_are_drawn_as_they_are(read, library):
    mesh = library.load(BOX).mesh
    drawn = {entity.id: entity for entity in read["/scene"][0][1].entities}
    assert set(drawn) == {"table", "pusher", "light", BOX}
    (shape,) = drawn[BOX].triangles
    np.testing.assert_allclose([(p.x, p.y, p.z) for p in shape.points], mesh.vertices, atol=1e-9)
    np.testing.assert_array_equal(shape.indices, mesh.faces.reshape(-1))
    colours = np.array([(c.r, c.g, c.b) for c in shape.colors])
    assert len(colours) == len(mesh.vertices)
    assert colours.std(axis=0).max() > 0.05
    assert drawn[BOX].frame_id == BOX
    assert read["/estimate"][0][1].entities[0].frame_id == f"estimate/{BOX}"


def test_plans_images_and_words_come_at_their_times(read, folder):
    ((plan_s, drawn),) = read["/plan"]
    way = [(p.x, p.y) for p in drawn.entities[0].lines[0].points]
    assert plan_s == 0
    np.testing.assert_allclose(way, np.linspace([-0.1, 0.1], [0.2, 0.1], 5), atol=1e-6)
    assert [round(time_s, 6) for time_s, _ in read["/frames"]] == [0, 0.6]
    assert read["/goal/image"][0][1].data == (folder / GOAL_FILE).read_bytes()
    assert [(round(s, 6), word.message) for s, word in read["/log"]] == [
        (0.4, NOTICED),
        (0.6, "The table looks like the goal."),
    ]


def test_the_command_writes_it(folder, library, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "objects").symlink_to(library.root)
    out = tmp_path / "episode.mcap"
    assert main(["mcap", str(folder), "--out", str(out), "--data-dir", str(tmp_path / "data"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == {"out": str(out), "seconds": 0.6, "bytes": out.stat().st_size}
    (folder / TRAJECTORY_FILE).unlink()
    assert main(["mcap", str(folder), "--out", str(out)]) == 1
    assert capsys.readouterr().err.endswith("holds no episode: give a folder that 'osf episode' has left.\n")


def test_without_the_library_one_sentence_tells_what_to_install(monkeypatch):
    monkeypatch.setattr("osfcore.extras.find_spec", lambda _: None)
    monkeypatch.delitem(sys.modules, "app.episodes.mcap")
    with pytest.raises(MissingExtra, check=about("mcap")):
        importlib.import_module("app.episodes.mcap")
