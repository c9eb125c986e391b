import csv
import gc
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from app.episodes.file_names import CSV_FILE, FRAMES_FOLDER, GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE, VIDEO_FILE
from app.episodes.frames import HEIGHT, WIDTH, part_of, read_frame
from app.episodes.record import About, EpisodeRecord
from app.episodes.request import SimulatedTable
from app.episodes.trajectory import read_trajectory
from osfcore.control.events import ActionExecuted, EpisodeSettings, Finished, GoalFound, Noticed, Observed, Stepped
from osfcore.control.goal import GoalImage
from osfcore.errors import CannotWrite, OsfError
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState
from osfcore.io.image_file import to_uint8
from osfcore.planning.costs import PoseGoal
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.support.errors import about

CAN, BOX = NAMES = ("005_tomato_soup_can", "009_gelatin_box")
SIDE = 32
ACTION = np.array([0.1, -0.2, 0.0])


def shifted(state, name, metres):
    places = state.poses.position.copy()
    places[state.names.index(name), 0] += metres
    return replace(state, poses=Pose(places, state.poses.quaternion))


def sure(state):
    return EstimatedState(state, np.full(2, 1e-3), np.full(2, 1e-2), 1e-2, ("", ""), "")


class Told:
    """An episode of which every number is known: the box is to go 60 mm, and is taken to be 3 mm off."""

    def __init__(self, library, out):
        self.world = Tabletop(library, cameras=default_cameras(SIDE), request=SceneRequest(names=NAMES))
        self.world.arrange(2)
        self.goal = shifted(self.world.truth(), BOX, 0.06)
        self.image = np.random.default_rng(0).random((SIDE, SIDE, 3))
        self.out = out

    def record(self, truth, moved=(BOX,), table=SimulatedTable, **more):
        symmetries = {name: asset.info.symmetry for name, asset in self.world.assets.items()}
        about = About(NAMES, 5, EpisodeSettings(steps=9), truth, moved, symmetries)
        return EpisodeRecord(self.out, table(self.world), about, **more)

    def begin(self, record):
        record.take(Observed(0, self.world.observe()))
        record.take(GoalFound(PoseGoal(NAMES, self.goal.poses), self.image, goal_camera(SIDE), None))
        self.step(record, 0, {"first": 1.0, "goal": 2.0})

    def act(self, record, number):
        self.world.act(ACTION)
        record.take(ActionExecuted(number, ACTION))

    def step(self, record, number, seconds):
        estimate = sure(shifted(self.world.truth(), BOX, 0.003))
        far, turned = np.array([0.0, 0.063]), np.array([np.pi / 2, 0.0])
        record.take(Stepped(number, 9, estimate, far, turned, 0.25, self.image, seconds))

    def end(self, record, number=2):
        record.take(Finished(number, "out of steps", "2 actions are done.", self.world.truth()))
        return record.finish()


@pytest.fixture
def told(library, tmp_path):
    told = Told(library, tmp_path / "out")
    yield told
    told.world.close()


@pytest.fixture
def whole(told):
    """Two steps, the second of which noticed something."""
    record = told.record(told.goal)
    told.begin(record)
    for number in (1, 2):
        told.act(record, number)
        told.step(record, number, {"estimate": 0.5, "plan": 0.25, "act": 0.125})
    record.take(Noticed(2, "lamp", "The lamp was moved."))
    return record, told.end(record)


def rows(out):
    with (out / CSV_FILE).open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_report_is_what_the_file_holds(told, whole):
    _, report = whole
    assert json.loads((told.out / REPORT_FILE).read_text()) == json.loads(json.dumps(report))
    assert (report["outcome"], report["text"]) == ("out of steps", "2 actions are done.")
    assert (report["seed"], report["objects"]) == (5, list(NAMES))
    assert report["seconds"] >= 0
    assert report["settings"]["steps"] == 9
    assert report["settings"]["plan"]["samples"] == EpisodeSettings().plan.samples
    assert report["actions"] == [ACTION.tolist()] * 2
    assert report["steps_done"] == 2
    assert report["noticed"] == [{"step": 2, "matter": "lamp", "text": "The lamp was moved."}]
    assert [wanted["name"] for wanted in report["goal"]["objects"]] == list(NAMES)
    np.testing.assert_allclose([w["position"] for w in report["goal"]["objects"]], told.goal.poses.position)


def test_lengths_are_in_mm_and_angles_in_degrees(whole):
    _, report = whole
    first, *_, last = report["steps"]
    assert [step["step"] for step in report["steps"]] == [0, 1, 2]
    assert first["seconds"] == {"first": 1.0, "goal": 2.0}
    assert last["seconds"] == {"estimate": 0.5, "plan": 0.25, "act": 0.125}
    assert first["ssim"] == 1.0  # what is rendered here is the goal image
    assert first["to_goal_mm"] == {CAN: 0.0, BOX: 63.0}
    assert first["to_goal_deg"] == {CAN: 90.0, BOX: 0.0}
    assert first["estimate_off_mm"] == pytest.approx({CAN: 0, BOX: 3})
    assert first["truly_to_goal_mm"] == pytest.approx({CAN: 0, BOX: 60})
    ours, true = (first[key]["objects"][1]["position"] for key in ("estimate", "truth"))
    np.testing.assert_allclose(np.subtract(ours, true), [0.003, 0, 0], atol=1e-9)


def test_the_table_has_a_row_for_every_step(told, whole):
    _, report = whole
    table = rows(told.out)
    assert len(table) == len(report["steps"])
    for row, step in zip(table, report["steps"], strict=True):
        assert (int(row["step"]), float(row["image_cost"])) == (step["step"], step["image_cost"])
        assert float(row["ssim"]) == step["ssim"]
        for stage in ("first", "goal", "estimate", "plan", "act"):
            assert row[f"{stage}_s"] == str(step["seconds"].get(stage, ""))
        for key in ("to_goal_mm", "to_goal_deg", "estimate_off_mm", "truly_to_goal_mm"):
            assert {name: float(row[f"{name} {key}"]) for name in NAMES} == step[key]


def test_pictures_and_video_show_every_step(told, whole):
    out = told.out
    seen = cv2.imread(str(out / GOAL_FILE))[..., ::-1]
    np.testing.assert_array_equal(seen, to_uint8(told.image))
    frames = sorted((out / FRAMES_FOLDER).iterdir())
    assert [path.name for path in frames] == ["000.png", "001.png", "002.png"]
    assert all(cv2.imread(str(path)).shape == (HEIGHT, WIDTH, 3) for path in frames)
    video = cv2.VideoCapture(str(out / VIDEO_FILE))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    video.release()


def test_each_round_has_one_frame_however_many_actions_it_has(told):
    record = told.record(told.goal)
    told.begin(record)
    for actions in ((1, 2, 3, 4), (5, 6)):
        for number in actions:
            told.act(record, number)
        told.step(record, actions[-1], {"estimate": 0.5})
    report = told.end(record, 6)
    assert [step["step"] for step in report["steps"]] == [0, 4, 6]
    assert sorted(path.name for path in (told.out / FRAMES_FOLDER).iterdir()) == ["000.png", "001.png", "002.png"]


def test_a_rest_is_not_counted_as_time(told):
    now_s = [100.0]
    record = told.record(told.goal, clock=lambda: now_s[0])
    now_s[0] += 7.0
    told.begin(record)
    now_s[0] += 3600.0
    record.go_on()
    now_s[0] += 2.5
    assert told.end(record)["seconds"] == record.seconds == 9.5


def test_a_state_is_kept_for_the_start_and_every_action(told, whole):
    record, _ = whole
    way = np.array([state.pusher for state in record.states])
    np.testing.assert_allclose(np.diff(way, axis=0), [0.2 * ACTION] * 2, atol=1e-6)


@pytest.mark.parametrize(("short_mm", "success"), [(0, True), (19, True), (21, False)])
def test_the_score_is_of_the_truth(told, short_mm, success):
    record = told.record(told.goal)
    told.begin(record)
    told.world.restore(shifted(told.goal, BOX, -short_mm / 1000))
    report = told.end(record, 0)
    assert report["moved"] == [BOX]
    assert report["score"]["moved_mm"] == pytest.approx(short_mm, abs=1e-6)
    assert report["score"]["others_mm"] == pytest.approx(0, abs=1e-6)
    assert report["score"]["pose6d"] == pytest.approx(short_mm / 2000, abs=1e-6)
    assert report["success_2cm"] is success


def test_where_the_true_goal_is_unknown_nothing_is_said_about_it(told):
    record = told.record(None, ())
    told.begin(record)
    report = told.end(record, 0)
    assert not {"score", "moved", "success_2cm"} & set(report)
    assert "truly_to_goal_mm" not in report["steps"][0]
    (row,) = rows(told.out)
    assert not [column for column in row if "truly" in column]


def test_whatever_is_broken_off_has_left_every_step_until_then(told):
    record = told.record(told.goal)
    told.begin(record)
    for number in (1, 2, 3):
        report = json.loads((told.out / REPORT_FILE).read_text())
        assert (report["outcome"], report["text"]) == (None, None)
        assert [step["step"] for step in report["steps"]] == list(range(number))
        assert report["steps_done"] == number - 1
        assert [int(row["step"]) for row in rows(told.out)] == list(range(number))
        assert len(list((told.out / FRAMES_FOLDER).iterdir())) == number
        told.act(record, number)
        told.step(record, number, {"estimate": 0.5})
    files = {REPORT_FILE, CSV_FILE, GOAL_FILE, TRAJECTORY_FILE, FRAMES_FOLDER}
    assert {path.name for path in told.out.iterdir()} == files


class Leaving:
    """A table whose simulation ends when its second picture is taken."""

    def __init__(self, world):
        self.table, self.pictures = SimulatedTable(world), 0

    def truth(self):
        return self.table.truth()

    def photo(self, camera):
        self.pictures += 1
        if self.pictures > 1:
            raise OsfError("The simulation has ended.")
        return self.table.photo(camera)


def test_a_step_that_was_broken_off_before_its_picture_is_not_told(told):
    record = told.record(told.goal, table=Leaving)
    told.begin(record)
    told.act(record, 1)
    with pytest.raises(OsfError, match="has ended"):
        told.step(record, 1, {"estimate": 0.5})
    record.close()
    report = json.loads((told.out / REPORT_FILE).read_text())
    assert len(report["steps"]) == len(report["step_s"]) == 1
    assert [path.name for path in (told.out / FRAMES_FOLDER).iterdir()] == ["000.png"]


def test_a_long_episode_writes_its_files_ever_more_seldom_and_lacks_few_steps(told):
    record = told.record(told.goal)
    told.begin(record)
    written = []
    for number in range(1, 50):
        told.step(record, number, {"estimate": 0.5})
        report = json.loads((told.out / REPORT_FILE).read_text())
        assert len(report["steps"]) == record.steps_written > 0.95 * number
        written.append(record.steps_written)
    assert written[:20] == [*range(2, 21), 20]
    assert len(set(written)) < 40
    record.close()
    assert len(rows(told.out)) == record.steps_written == 50


def test_what_is_noticed_is_in_the_file_at_once(told):
    record = told.record(told.goal)
    record.take(Noticed(0, "goal", "The goal image is odd."))
    report = json.loads((told.out / REPORT_FILE).read_text())
    assert [notice["text"] for notice in report["noticed"]] == ["The goal image is odd."]
    assert (report["steps"], report["goal"]) == ([], None)


def test_frames_stay_on_disk_and_not_in_memory(told):
    record = told.record(told.goal)
    told.begin(record)
    frame_bytes = HEIGHT * WIDTH * 3

    def kept_bytes():
        seen = {id(value): value for value in gc.get_referents(*vars(record).values()) if isinstance(value, np.ndarray)}
        return sum(value.nbytes for value in seen.values())

    before = kept_bytes()
    for number in range(1, 6):
        told.act(record, number)
        told.step(record, number, {"estimate": 0.5})
    assert kept_bytes() - before < frame_bytes
    assert len(list((told.out / FRAMES_FOLDER).iterdir())) == 6


def test_frames_of_an_earlier_and_longer_episode_are_not_in_the_video(told, whole):
    record = told.record(told.goal)
    assert list((told.out / FRAMES_FOLDER).iterdir()) == []
    told.begin(record)
    told.end(record, 0)
    video = cv2.VideoCapture(str(told.out / VIDEO_FILE))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 1
    video.release()


def test_the_table_now_is_seen_by_the_camera_of_the_goal_in_whatever_proportions(told):
    record = told.record(told.goal)
    camera = replace(goal_camera(2 * SIDE), height=SIDE)
    image = np.zeros((SIDE, 2 * SIDE, 3))
    record.take(Observed(0, told.world.observe()))
    record.take(GoalFound(PoseGoal(NAMES, told.goal.poses), image, camera, None))
    estimate = sure(told.world.truth())
    record.take(Stepped(0, 9, estimate, np.zeros(2), np.zeros(2), 0.0, image, {}))
    now = part_of(read_frame(told.out / FRAMES_FOLDER / "000.png"), "now")
    assert now[: len(now) // 2].std() > 5
    assert len(np.unique(now[len(now) // 2 + 1 :])) == 1  # the camera is twice as wide as it is high


def test_a_folder_that_cannot_be_written_is_told(told):
    told.out.write_text("")
    with pytest.raises(CannotWrite, check=about("goal.png")):
        told.begin(told.record(told.goal))


def test_a_method_that_looks_at_images_alone_leaves_all_but_the_distances(told):
    symmetries = {name: asset.info.symmetry for name, asset in told.world.assets.items()}
    goal = GoalImage(goal_camera(SIDE), told.image)
    record = EpisodeRecord(
        told.out, SimulatedTable(told.world), About(NAMES, 5, EpisodeSettings(), None, (), symmetries, "paper", goal)
    )
    record.take(Observed(0, told.world.observe()))
    unknown, estimate = np.zeros(0), sure(told.world.truth())
    for number in range(2):
        record.take(Stepped(number, 9, estimate, unknown, unknown, 0.25, told.image, {"estimate": 0.5}))
        told.act(record, number + 1)
    report = told.end(record)
    assert (report["method"], report["goal"], report["steps_done"]) == ("paper", None, 2)
    step = report["steps"][0]
    assert (step["to_goal_mm"], step["to_goal_deg"], step["image_cost"]) == (None, None, 0.25)
    assert step["ssim"] == pytest.approx(1.0)
    header, *rows = csv.reader((told.out / CSV_FILE).read_text().splitlines())
    assert len(rows) == 2
    assert not any("to_goal" in column for column in header)
    assert f"{BOX} estimate_off_mm" in header
    assert (told.out / GOAL_FILE).is_file()
    assert (told.out / VIDEO_FILE).is_file()
    assert read_trajectory(told.out / TRAJECTORY_FILE).goal is None
