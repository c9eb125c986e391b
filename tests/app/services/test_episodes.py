"""Episodes as the service keeps them: what is refused, what is told, and one that really runs."""

import csv
import importlib.util
import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.episodes.file_names import (
    ARCHIVE_FILE,
    CLIP_FILE,
    CSV_FILE,
    FRAMES_FOLDER,
    GOAL_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VIDEO_FILE,
)
from app.episodes.frames import HEIGHT, TILE_PX, WIDTH, frame, part_of
from app.episodes.settings import ChosenSettings
from app.jobs.job import FINISHED
from app.processes.messages.scene_messages import ComposedGoal
from app.services.episodes import FILES, EpisodeGoesOn, Episodes, GoalUnknown, NoGoal, NoTrajectory
from app.services.fields import FieldCatalogue, MissingFields, NoPublishedField
from app.services.goals import GoalRefused, NoTable
from app.storage.database import CannotStore
from app.storage.records import GoalRecord, GoalStore
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.extras import MissingExtra
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import encode_png, write_png
from osfcore.io.scene_file import Scene, scene_to_json
from tests.app.api.test_problems import is_problem
from tests.app.conftest import until
from tests.app.services.test_estimates import BOX, MUSTARD, Jobs, Runner, believed
from tests.support.errors import about

POSES = tuple(
    (name, Pose(np.array([x, 0.0, 0.05]), np.array([1.0, 0, 0, 0]))) for name, x in ((BOX, 0), (MUSTARD, 0.2))
)
WANTED = [
    {"name": name, "position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()} for name, pose in POSES
]
PNG = encode_png(np.zeros((2, 2, 3), np.uint8))


class ChangingJobs(Jobs):
    """A registry that never works, whose jobs may change their minds."""

    def change(self, name, params):
        job = self.get(name)
        self._all[self._all.index(job)] = replace(job, params={**job.params, **params})
        return self.get(name)

    def put(self, name, **changes):
        job = self.get(name)
        self._all[self._all.index(job)] = replace(job, **changes)
        return self.get(name)


class Goals(GoalStore):
    """Goals beside which one is being composed."""

    has_draft = True

    def drop_draft(self):
        self.has_draft = False


@pytest.fixture
def runner(tmp_path, library):
    runner = Runner(tmp_path, library)
    runner.jobs = ChangingJobs(tmp_path / "collections")
    return runner


@pytest.fixture
def goals(tmp_path):
    """One that was made from the scene, and a photo."""
    goals = Goals(tmp_path / "goals", 10)
    made = GoalRecord("made", "Made", "2026-01-01T00:00:00.000Z", "composed", "s", goal_camera(64), POSES)
    goals.keep(made, PNG)
    goals.keep(replace(made, id="photo", source="upload", scene=None, poses=None), PNG)
    return goals


class Checks:
    """Lets every goal pass but one."""

    refused = None

    def require(self, goal, scene):
        if goal == self.refused:
            raise GoalRefused(f"{goal} does not show what is on {scene}.")


@pytest.fixture
def checks():
    return Checks()


@pytest.fixture
def episodes(runner, goals, checks, tmp_path):
    return Episodes(runner, FieldCatalogue(tmp_path, lambda: ()), goals, checks)


def left_over(tmp_path):
    return list((tmp_path / "collections").glob(".new-*"))


def chosen(changes=None, method="ours"):
    return ChosenSettings.defaults(method).changed(changes or {})


# Asking for one


@pytest.mark.slow
def test_an_episode_toward_a_goal_image_takes_its_own_copy_along(episodes, runner, goals, tmp_path):
    job = episodes.start(chosen({"samples": 8}), goal="made", seed=5)
    assert (job.kind, job.params["scene"], job.params["names"], job.params["seed"]) == (
        "episode",
        "s",
        [BOX, MUSTARD],
        5,
    )
    goal = job.params["goal"]
    assert (goal["id"], goal["poses"], goal["camera"]["width"]) == ("made", None, 64)
    assert goal["truth"] == WANTED
    assert job.params["settings"]["samples"] == 8
    goals.remove("made")
    assert (runner.jobs.inputs(job.id) / GOAL_FILE).read_bytes() == PNG
    assert json.loads(json.dumps(job.params)) == job.params
    assert left_over(tmp_path) == []


@pytest.mark.slow
def test_an_episode_toward_poses_knows_where_everything_truly_should_be(episodes, tmp_path):
    goal = episodes.start(chosen(), scene="s", poses=POSES).params["goal"]
    assert goal == {"id": None, "camera": None, "poses": WANTED, "truth": WANTED}
    assert left_over(tmp_path) == []


def test_a_goal_that_shows_something_else_is_refused_unless_doubts_do_not_matter(episodes, goals, checks, tmp_path):
    checks.refused = "photo"
    with pytest.raises(GoalRefused):
        episodes.start(chosen(), goal="photo")
    assert goals.has_draft
    assert left_over(tmp_path) == []
    assert episodes.start(chosen({"despite_doubts": True}), goal="photo").kind == "episode"
    assert episodes.start(chosen(), goal="made").kind == "episode"


def test_one_clip_at_a_time_is_made_of_an_episode_that_is_over(episodes, runner):
    job = episodes.start(chosen(), goal="made")
    with pytest.raises(EpisodeGoesOn):
        episodes.make_clip(job)
    job = runner.jobs.put(job.id, state="done")
    with pytest.raises(NoTrajectory):
        episodes.make_clip(job)
    (runner.jobs.folder(job.id) / TRAJECTORY_FILE).touch()
    clip = episodes.make_clip(job)
    assert (clip.kind, clip.params) == ("clip", {"episode": job.id, "title": "Made"})
    assert episodes.make_clip(job).id == clip.id
    runner.jobs.put(clip.id, state="failed")
    assert episodes.make_clip(job).id != clip.id
    assert CLIP_FILE not in episodes.files(job)
    (runner.jobs.folder(job.id) / CLIP_FILE).touch()
    assert CLIP_FILE in episodes.files(job)


def test_composing_ends_when_an_episode_takes_the_scene_but_not_when_it_is_refused(episodes, goals):
    with pytest.raises(NoGoal):
        episodes.start(chosen())
    assert goals.has_draft
    episodes.start(chosen(), poses=POSES)
    assert not goals.has_draft


@pytest.mark.parametrize("other", [{"scene": "t"}, {"poses": POSES[:1]}, {"poses": None}, {"scene": None}])
def test_of_an_image_of_something_else_the_truth_is_unknown(episodes, goals, other):
    goals.keep(replace(goals.get("made"), id="other", **other), PNG)
    assert episodes.start(chosen(), goal="other").params["goal"]["truth"] is None
    assert episodes.start(chosen(), goal="photo").params["goal"]["truth"] is None


@pytest.mark.parametrize(
    ("asked", "kind", "words"),
    [
        ({}, NoGoal, "needs a goal"),
        ({"goal": "made", "poses": POSES}, NoGoal, "needs a goal"),
        ({"goal": "none"}, UnknownName, "no such goal"),
        ({"scene": "t", "goal": "made"}, UnknownName, "no scene named 't'"),
        ({"goal": "made", "seed": -1}, InvalidInput, "seed"),
        ({"poses": POSES[:1]}, InvalidInput, f"{BOX}, {MUSTARD}, each once"),
        ({"poses": (*POSES, POSES[0])}, InvalidInput, "each once"),
        ({"poses": ()}, InvalidInput, "none"),
        ({"poses": (POSES[0], (MUSTARD, Pose(np.zeros(3), np.zeros(4))))}, InvalidInput, "unit quaternion"),
    ],
)
def test_what_cannot_be_is_refused_and_leaves_nothing(episodes, runner, tmp_path, asked, kind, words):
    with pytest.raises(kind, match=words):
        episodes.start(chosen(), **asked)
    assert runner.jobs.all() == ()
    assert left_over(tmp_path) == []


def test_without_a_scene_or_without_fields_there_is_nothing_to_do(episodes, runner):
    runner.scenes.names = (BOX, "spoon")
    with pytest.raises(MissingFields):
        episodes.start(chosen(), goal="made")
    runner.scenes.current = None
    with pytest.raises(NoTable):
        episodes.start(chosen(), goal="made")


def test_a_full_disk_is_told_and_leaves_nothing(episodes, tmp_path, monkeypatch):
    def full(_, to):
        to.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(CannotStore):
        episodes.start(chosen(), goal="made")
    assert left_over(tmp_path) == []


def test_settings_may_change_and_what_is_left_out_stays(episodes, runner):
    job = episodes.start(chosen({"samples": 8, "steps": 9}), goal="made")
    job = episodes.change(job, {"horizon": 4})
    now = episodes.settings(job)
    assert (now.steps, now.samples, now.horizon) == (9, 8, 4)
    with pytest.raises(InvalidInput, check=about("horizon")):
        episodes.change(job, {"horizon": 0})
    assert episodes.settings(runner.jobs.get(job.id)) == now


def test_only_episodes_are_told_of(episodes, runner, tmp_path):
    first, second = (episodes.start(chosen(), poses=POSES) for _ in range(2))
    (tmp_path / "inputs").mkdir()
    other = runner.jobs.submit("estimate", {}, tmp_path / "inputs")
    assert [job.id for job in episodes.page(10).jobs] == [second.id, first.id]
    assert episodes.get(first.id) is first
    for name in (other.id, "none", ""):
        with pytest.raises(UnknownName):
            episodes.get(name)


# What was broken off


def drawn(number):
    images = np.random.default_rng(number).random((7, 32, 32, 3))
    return frame(*images[:3], images[3:], f"step {number}")


@pytest.fixture
def broken_off(episodes, runner):
    """An episode that stopped after two steps."""
    job = episodes.start(chosen(), poses=POSES)
    folder = runner.jobs.folder(job.id)
    for number in range(2):
        write_png(folder / FRAMES_FOLDER / f"{number:03d}.png", drawn(number))
    truth = scene_to_json(Scene(believed().state, ()))
    (folder / REPORT_FILE).write_text(json.dumps({"steps": [{"step": n, "truth": truth} for n in range(2)]}))
    (folder / CSV_FILE).write_text("step\n0\n1\n")
    (folder / GOAL_FILE).write_bytes(PNG)
    return runner.jobs.put(job.id, state="interrupted")


def test_video_and_recording_are_made_when_they_are_asked_for(episodes, runner, broken_off):
    assert set(episodes.files(broken_off)) == set(FILES) - {CLIP_FILE}
    folder = runner.jobs.folder(broken_off.id)
    assert not (folder / VIDEO_FILE).exists()
    path = episodes.file(broken_off, VIDEO_FILE)
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    video.release()
    recording = episodes.file(broken_off, RECORDING_FILE)
    assert recording.stat().st_size > 1000
    made = os.stat(recording).st_ino
    assert os.stat(episodes.file(broken_off, RECORDING_FILE)).st_ino == made  # once
    assert [path.name for path in folder.glob(".*")] == []


def test_without_ffmpeg_there_is_all_but_video_and_clip(episodes, runner, broken_off, monkeypatch, tmp_path):
    found = importlib.util.find_spec
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name == "imageio_ffmpeg" else found(name))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert set(episodes.files(broken_off)) == set(FILES) - {CLIP_FILE, VIDEO_FILE}
    assert episodes.file(broken_off, ARCHIVE_FILE).is_file()
    with pytest.raises(MissingExtra, check=about("imageio_ffmpeg")):
        episodes.make_clip(broken_off)


@pytest.mark.parametrize("state", ["running", "paused"])
def test_while_it_runs_nothing_is_made(episodes, runner, broken_off, state):
    live = runner.jobs.put(broken_off.id, state=state)
    assert set(episodes.files(live)) == {REPORT_FILE, CSV_FILE, GOAL_FILE}
    with pytest.raises(UnknownName, check=about(VIDEO_FILE)):
        episodes.file(live, VIDEO_FILE)


@pytest.mark.parametrize("name", ["", "..", "../a", FRAMES_FOLDER, "inputs", "frames/000.png", ".video.mp4.part.mp4"])
def test_nothing_else_can_be_downloaded(episodes, broken_off, name):
    with pytest.raises(UnknownName):
        episodes.file(broken_off, name)


@pytest.mark.parametrize("report", [None, "{", "[]", '{"steps": []}', '{"steps": [1]}', '{"steps": [{"truth": {}}]}'])
def test_a_recording_of_a_damaged_report_cannot_be_made(episodes, runner, broken_off, report):
    path = runner.jobs.folder(broken_off.id) / REPORT_FILE
    path.unlink() if report is None else path.write_text(report)
    with pytest.raises(CorruptFile, check=about(REPORT_FILE)):
        episodes.file(broken_off, RECORDING_FILE)


@pytest.mark.parametrize("report", ["{", "[]", "{}", '{"steps": 5}', "\x00"])
def test_a_damaged_report_is_told(episodes, runner, broken_off, report):
    assert len(episodes.report(broken_off)["steps"]) == 2
    path = runner.jobs.folder(broken_off.id) / REPORT_FILE
    path.write_text(report)
    with pytest.raises(CorruptFile, check=about(REPORT_FILE)):
        episodes.report(broken_off)
    path.unlink()
    assert episodes.report(broken_off) is None


def test_frames_are_shown_whole_and_in_parts(episodes, broken_off):
    for part in ("all", "goal", "now", "estimate", "difference"):
        png = np.frombuffer(episodes.frame(broken_off, 1, part), np.uint8)
        np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1], part_of(drawn(1), part))
    with pytest.raises(UnknownName, check=about("frame")):
        episodes.frame(broken_off, 2, "all")


def test_a_frame_that_is_deleted_while_it_is_asked_for_is_unknown(episodes, runner, broken_off, monkeypatch):
    frames = runner.jobs.folder(broken_off.id) / FRAMES_FOLDER
    (frames / "001.png").unlink()
    monkeypatch.setattr(Path, "is_file", lambda _: True)  # as it was a moment ago
    with pytest.raises(UnknownName, check=about("frame")):
        episodes.frame(broken_off, 1, "all")


def test_frames_that_are_damaged_or_not_there_yet_are_told(episodes, runner, broken_off):
    (runner.jobs.folder(broken_off.id) / FRAMES_FOLDER / "001.png").write_bytes(b"no picture")
    with pytest.raises(CorruptFile, check=about("001.png")):
        episodes.frame(broken_off, 1, "goal")
    with pytest.raises(CorruptFile, check=about("001.png")):
        episodes.file(broken_off, VIDEO_FILE)
    fresh = episodes.start(chosen(), poses=POSES)
    with pytest.raises(UnknownName, check=about("frame")):
        episodes.frame(fresh, 0, "all")
    assert episodes.files(fresh) == ()


# One that really runs


@pytest.fixture(scope="module")
def done(service):
    """A short episode with one object, followed to its end; and how the scene was before."""
    scene = service.post("/api/scenes", json={"seed": 2, "objects": [MUSTARD], "image_size": 64}).json()
    (bottle,) = scene["objects"]
    x, y, z = bottle["position"]
    goal = {"name": MUSTARD, "position": [x + 0.05, y, z], "quaternion": bottle["quaternion"]}
    asked = {"poses": [goal], "seed": 1, "settings": {"steps": 2, "samples": 8, "horizon": 4}}
    accepted = service.post("/api/episodes", json=asked)
    assert accepted.status_code == 202, accepted.text
    address = accepted.headers["location"]
    until(lambda: service.get(address).json()["status"] != "queued", 60)
    refused = service.post(f"/api/scenes/{scene['id']}/actions", json={"actions": [[0.1, 0, 0]]})
    until(lambda: service.get(address).json()["status"] not in ("running", "queued"), 300)
    yield service.get(address).json(), scene, refused
    service.delete(f"/api/scenes/{scene['id']}")


@pytest.mark.slow
def test_an_episode_is_followed_to_its_end(service, services, done):
    episode, scene, refused = done
    assert (episode["status"], episode["error"]) == ("done", None)
    assert "pause or cancel" in is_problem(refused, 409)["detail"]
    assert (episode["outcome"], episode["done"], episode["total"]) == ("out of steps", 2, 2)
    assert (episode["scene"], episode["goal"], episode["objects"]) == (scene["id"], None, [MUSTARD])
    assert episode["settings"]["samples"] == 8
    assert [step["step"] for step in episode["steps"]] == [0, 1, 2]
    first = episode["steps"][0]
    assert first["truly_to_goal_mm"][MUSTARD] == pytest.approx(50, abs=0.1)
    assert first["estimate_off_mm"][MUSTARD] < 10
    assert set(first["seconds"]) == {"first", "goal"} or set(first["seconds"]) == {"first"}
    assert episode["files"] == [name for name in FILES if name != CLIP_FILE]
    now = services.runner.scenes.get(scene["id"])
    assert now.time_s == pytest.approx(0.4)
    assert not np.array_equal(now.state.pusher, scene["pusher"]["position"])
    listed = service.get("/api/episodes").json()["episodes"]
    assert [one["seconds"] for one in listed if one["id"] == episode["id"]] == [episode["seconds"]]
    assert episode["seconds"] > 0
    job = service.get(f"/api/jobs/{episode['id']}").json()
    assert (job["kind"], job["state"], job["result"]["steps"]) == ("episode", "done", 3)
    is_problem(service.delete(f"/api/episodes/{episode['id']}"), 409)


@pytest.mark.slow
def test_every_file_can_be_downloaded_and_read(service, done, tmp_path):
    episode, *_ = done
    kinds, files = {}, {}
    for name in episode["files"]:
        answer = service.get(f"/api/episodes/{episode['id']}/files/{name}")
        assert answer.status_code == 200
        kinds[name], files[name] = answer.headers["content-type"].split(";")[0], answer.content
    assert kinds == {
        REPORT_FILE: "application/json",
        CSV_FILE: "text/csv",
        GOAL_FILE: "image/png",
        VIDEO_FILE: "video/mp4",
        RECORDING_FILE: "application/octet-stream",
        ARCHIVE_FILE: "application/zip",
    }
    with zipfile.ZipFile(io.BytesIO(files.pop(ARCHIVE_FILE))) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == files
    report = json.loads(files[REPORT_FILE])
    assert (report["outcome"], report["text"]) == (episode["outcome"], episode["text"])
    assert [step["to_goal_mm"] for step in report["steps"]] == [step["to_goal_mm"] for step in episode["steps"]]
    assert report["moved"] == [MUSTARD]
    table = list(csv.DictReader(io.StringIO(files[CSV_FILE].decode())))
    assert [int(row["step"]) for row in table] == [0, 1, 2]
    assert cv2.imdecode(np.frombuffer(files[GOAL_FILE], np.uint8), cv2.IMREAD_COLOR).std() > 1
    (tmp_path / VIDEO_FILE).write_bytes(files[VIDEO_FILE])
    video = cv2.VideoCapture(str(tmp_path / VIDEO_FILE))
    pictures = [picture for is_there, picture in iter(video.read, (False, None)) if is_there]
    video.release()
    assert [picture.shape for picture in pictures] == [(HEIGHT, WIDTH, 3)] * 3
    assert len(files[RECORDING_FILE]) > 1000
    is_problem(service.get(f"/api/episodes/{episode['id']}/files/none.txt"), 404)


@pytest.mark.parametrize("state", [state for state in FINISHED if state != "done"])
def test_episodes_are_listed_by_every_state_in_which_they_can_end(service, state):
    listed = service.get("/api/episodes", params={"outcome": state})
    assert listed.status_code == 200
    assert {one["status"] for one in listed.json()["episodes"]} <= {state}


def test_it_has_a_name_that_can_be_changed_and_found(service, done):
    episode, *_ = done
    address = f"/api/episodes/{episode['id']}"
    assert episode["name"].startswith("Mustard bottle")
    renamed = service.patch(address, json={"name": " Bottle to the left "})
    assert renamed.json()["name"] == service.get(address).json()["name"] == "Bottle to the left"
    is_problem(service.patch(address, json={"name": "  "}), 422)
    is_problem(service.patch(address, json={"name": ""}), 422)
    is_problem(service.patch("/api/episodes/nobody", json={"name": "x"}), 404)

    def found(**query):
        return [one["id"] for one in service.get("/api/episodes", params=query).json()["episodes"]]

    assert episode["id"] in found(search="LEFT bottle")
    assert episode["id"] in found(search="mustard", outcome="out of steps")  # its object is called so
    assert episode["id"] not in found(search="left shoe")
    assert episode["id"] not in found(outcome="reached")
    is_problem(service.get("/api/episodes", params={"outcome": "unhappy"}), 422)


def test_its_thumbnails_are_small_and_of_its_ends(service, done):
    episode, *_ = done
    address = f"/api/episodes/{episode['id']}"
    for at, step in (("start", 0), ("end", 2)):
        small = cv2.imdecode(np.frombuffer(service.get(f"{address}/thumbnail.png?at={at}").content, np.uint8), 1)
        whole = cv2.imdecode(np.frombuffer(service.get(f"{address}/frames/{step}.png?part=now").content, np.uint8), 1)
        np.testing.assert_allclose(small, cv2.resize(whole, small.shape[:2], interpolation=cv2.INTER_AREA), atol=1)


def test_names_that_are_taken_get_a_number(episodes):
    names = [episodes.name(episodes.start(chosen(), goal="made")) for _ in range(3)]
    assert names == ["Made", "Made 2", "Made 3"]


def test_every_step_can_be_seen(service, done):
    episode, *_ = done
    for part, shape in (("all", (HEIGHT, WIDTH, 3)), ("now", (TILE_PX, TILE_PX, 3))):
        for step in range(3):
            answer = service.get(f"/api/episodes/{episode['id']}/frames/{step}.png", params={"part": part})
            assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR).shape == shape
    is_problem(service.get(f"/api/episodes/{episode['id']}/frames/3.png"), 404)


def test_the_events_of_one_that_is_over_end_at_once(service, done):
    episode, *_ = done
    text = service.get(f"/api/episodes/{episode['id']}/events").text
    (data,) = [json.loads(line[6:]) for line in text.splitlines() if line.startswith("data: ")]
    assert (data["id"], data["state"], data["result"]["outcome"]) == (episode["id"], "done", "out of steps")


# The method as published


@pytest.fixture
def published(episodes):
    """An episode of it that waits."""
    return episodes.start(chosen({"steps": 4}, method="paper"), goal="made")


def test_objects_without_a_field_as_published_are_refused_before_the_start(episodes, monkeypatch, tmp_path):
    monkeypatch.setattr(FieldCatalogue, "published", lambda _: (BOX,))
    with pytest.raises(NoPublishedField):
        episodes.start(chosen(method="paper"), goal="made")
    assert episodes.start(chosen(), goal="made").params["settings"]["method"] == "ours"
    assert left_over(tmp_path) == []


def test_poses_become_the_image_that_the_method_as_published_wants(episodes, runner, monkeypatch):
    asked = []

    def compose(command):
        asked.append(command)
        return ComposedGoal(PNG, POSES)

    monkeypatch.setattr(runner.scenes, "compose", compose, raising=False)
    job = episodes.start(chosen(method="paper"), scene="s", poses=POSES)
    assert [(command.id, command.poses) for command in asked] == [("s", POSES)]
    goal = job.params["goal"]
    assert (goal["id"], goal["poses"], goal["truth"]) == (None, None, WANTED)
    assert goal["camera"]["width"] == asked[0].size
    assert (runner.jobs.inputs(job.id) / GOAL_FILE).read_bytes() == PNG


def test_an_episode_keeps_its_method_and_the_one_as_published_all_else(episodes, published):
    with pytest.raises(InvalidInput):
        episodes.change(published, {"steps": 5})
    ours = episodes.start(chosen(), goal="made")
    with pytest.raises(InvalidInput, check=about("method")):
        episodes.change(ours, {"method": "paper"})
    assert episodes.change(ours, {"method": "ours", "steps": 5}).params["settings"]["steps"] == 5


def test_what_never_knew_goal_poses_becomes_no_clip(episodes, runner, published):
    with pytest.raises(GoalUnknown):
        episodes.make_clip(runner.jobs.put(published.id, state="done"))
