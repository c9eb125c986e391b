"""Clips of episodes: what their frames show, how long they are, and what stands on the last card."""

import json
from concurrent.futures import ThreadPoolExecutor

import imageio_ffmpeg
import numpy as np
import pytest

from app.episodes.clip import (
    CARD_S,
    FPS,
    GOLD,
    HEIGHT,
    LONGEST_S,
    PAUSE_S,
    VIEW,
    WIDTH,
    ClipFacts,
    Layout,
    NoClip,
    SceneView,
    clip_of,
    closing_card,
    length_text,
    write_clip,
)
from app.episodes.file_names import REPORT_FILE, TRAJECTORY_FILE
from app.episodes.trajectory import Round, Trajectory, write_trajectory
from osfcore.errors import CannotWrite
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.world.imaging import TracedMesh

BOX = "009_gelatin_box"
UPRIGHT = np.array([[1.0, 0, 0, 0]])
SHIFT_M, STEPS = 0.1, 2
SMALL = (160, 80)


def at(x, y=0.0):
    return Pose(np.array([[x, y, 0.015]]), UPRIGHT)


def state(x):
    return SceneState((BOX,), at(x), Light(np.array([0.3, -0.4, 0.87])), np.array([-0.1, 0.1, 0.06]))


def estimate(x):
    return EstimatedState(state(x), np.zeros(1), np.zeros(1), 0.0, ("",), "")


@pytest.fixture
def trajectory():
    states = tuple(state(SHIFT_M * (n / STEPS - 1)) for n in range(STEPS + 1))
    rounds = (Round(0, estimate(-SHIFT_M), None), Round(STEPS, estimate(0.0), None))
    return Trajectory(states, at(0.0), (), rounds)


@pytest.fixture(scope="module")
def meshes(library):
    return {BOX: TracedMesh(library.load(BOX).mesh)}


def size_and_length(path):
    frames = imageio_ffmpeg.read_frames(str(path))
    facts = next(frames)
    frames.close()
    return facts["size"], facts["duration"]


@pytest.mark.slow
def test_an_episode_becomes_a_film_of_full_size_that_every_browser_plays(library, trajectory, tmp_path):
    write_trajectory(tmp_path / TRAJECTORY_FILE, trajectory)
    report = {"outcome": "reached", "text": "The table looks like the goal.", "seconds": 12.3, "steps": []}
    (tmp_path / REPORT_FILE).write_text(json.dumps(report))
    with ThreadPoolExecutor(2) as executor:
        steps = list(clip_of(tmp_path, library, tmp_path / "clip.mp4", executor))
    assert [step.done for step in steps] == list(range(1, steps[-1].total + 1))
    size, length_s = size_and_length(tmp_path / "clip.mp4")
    assert size == (WIDTH, HEIGHT) == (1920, 1080)
    assert length_s == pytest.approx(steps[-1].total / FPS, abs=0.1)
    assert PAUSE_S + CARD_S < length_s < LONGEST_S + PAUSE_S + CARD_S + 0.1
    assert [path.name for path in tmp_path.glob("*.mp4")] == ["clip.mp4"]


def test_of_an_episode_that_pushed_nothing_there_is_no_clip(library, trajectory, tmp_path):
    with pytest.raises(NoClip):
        list(clip_of(tmp_path, library, tmp_path / "clip.mp4"))
    (tmp_path / REPORT_FILE).write_text("{}")
    write_trajectory(tmp_path / TRAJECTORY_FILE, Trajectory(trajectory.states[:1], at(0.0), (), ()))
    with pytest.raises(NoClip):
        list(clip_of(tmp_path, library, tmp_path / "clip.mp4"))


def test_a_clip_that_cannot_be_written_leaves_nothing(meshes, trajectory, tmp_path):
    goal = np.zeros((64, 64, 3), np.uint8)
    path = tmp_path / "nowhere" / "clip.mp4"
    with pytest.raises(CannotWrite):
        list(write_clip(path, trajectory, goal, meshes, ClipFacts(is_reached=False, verdict="No.")))
    assert list(tmp_path.iterdir()) == []


def golden(image):
    """Pixels that are close to the colour of goals."""
    return int((np.abs(image.astype(int) - GOLD).max(axis=-1) < 40).sum())


def test_golden_copies_stand_where_objects_are_to_go_and_nowhere_else(meshes):
    view = SceneView(meshes, *SMALL)
    plain = view.scene(state(-SHIFT_M))
    assert plain.shape == (SMALL[1], SMALL[0], 3)
    assert golden(plain) == 0
    view.show_goal((BOX,), at(0.1), np.array([False]), state(0.0).light)
    np.testing.assert_array_equal(view.scene(state(-SHIFT_M)), plain)
    view.show_goal((BOX,), at(0.1), np.array([True]), state(0.0).light)
    shown = view.scene(state(-SHIFT_M))
    assert golden(shown) > 10
    changed = np.abs(shown.astype(int) - plain).max(axis=-1) > 8
    assert changed[:, : SMALL[0] // 2].sum() == 0  # the box itself, and all to the left of the goal
    assert changed[:, SMALL[0] // 2 :].sum() > 20


def test_a_view_wider_than_a_camera_may_be_has_no_seam(meshes):
    wide, tall = SceneView(meshes, 1200, 80), SceneView(meshes, 1200, 80, ThreadPoolExecutor(2))
    image = wide.scene(state(0.0))
    np.testing.assert_array_equal(image, tall.scene(state(0.0)))
    seam = np.abs(image[:, 600].astype(int) - image[:, 599]).mean()
    beside = np.abs(np.diff(image[:, 580:620].astype(int), axis=1)).mean(axis=(0, 2))
    assert seam <= beside.max() + 1


def test_a_frame_holds_view_pictures_curve_and_distance():
    goal, now = np.full((64, 64, 3), 200, np.uint8), np.full((64, 64, 3), 90, np.uint8)
    layout = Layout(goal, np.array([0.1, 0.05, 0.002]))
    view = np.full((VIEW[3], VIEW[2], 3), 60, np.uint8)
    first, last = layout.frame(view, now, "Planning", 0.0), layout.frame(view, now, "Planning", 2.0)
    assert first.shape == (HEIGHT, WIDTH, 3)
    x, y, width, height = VIEW
    assert (first[y + 5, x + 5] == 60).all()
    assert (first == 200).all(axis=-1).sum() >= 400**2
    assert (first == 90).all(axis=-1).sum() >= 400**2
    np.testing.assert_array_equal(first[y : y + height, x : x + width], last[y : y + height, x : x + width])
    assert (first != last).any(axis=-1)[y + height :].sum() > 1000  # the curve has come, and the number has changed


def test_the_card_tells_good_and_bad_news_in_different_colours():
    frame = np.full((HEIGHT, WIDTH, 3), 250, np.uint8)
    good, bad = (closing_card(frame, "9 cm to 2 mm", "18 pushes", "How it ended.", is_reached=is_reached)
                 for is_reached in (True, False))  # fmt: skip
    assert good.shape == frame.shape
    assert good.mean() < 100
    assert (good != bad).any()


def test_distances_are_those_of_the_report():
    steps = [
        {"step": 0, "to_goal_mm": {"box": 61.0, "can": 2.0}, "truly_to_goal_mm": {"box": 60.0, "can": 1.0}},
        {"step": 4, "to_goal_mm": {"box": 1.0, "can": 2.5}, "truly_to_goal_mm": {"box": 3.0, "can": 2.0}},
    ]
    facts = ClipFacts.of_report({"outcome": "reached", "text": "There.", "seconds": 31.5, "steps": steps}, 4)
    assert (facts.is_reached, facts.verdict, facts.seconds) == (True, "There.", 31.5)
    np.testing.assert_allclose(facts.far_m[[0, -1]], [0.060, 0.003])
    assert len(facts.far_m) == 5
    unknown = ClipFacts.of_report({"steps": [{"step": 0, "to_goal_mm": None}]}, 1)
    assert (unknown.is_reached, unknown.verdict, unknown.far_m) == (False, "It was ended early.", None)


@pytest.mark.parametrize(
    ("metres", "text"), [(0.0934, "9.3 cm"), (0.0021, "2.1 mm"), (0.0, "0.0 mm"), (0.01, "1.0 cm")]
)
def test_lengths_are_told_for_people(metres, text):
    assert length_text(metres) == text
