import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.processes.messages.photo_messages import Mark, Stroke
from app.storage.database import CannotStore
from app.storage.photos import PhotoCrop
from app.storage.records import (
    IMAGE,
    GoalRecord,
    GoalStore,
    MarkedObject,
    PhotoRecord,
    TablePhoto,
    TablePhotoStore,
    TooManyGoals,
    TooManyPhotos,
    mask_file,
)
from osfcore.errors import CorruptFile, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import encode_jpeg, encode_png
from tests.support.errors import about

PNG = encode_png(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
JPEG = encode_jpeg(np.zeros((8, 8, 3), np.uint8))
POSES = (("box", Pose(np.array([0.1, 0.2, 0.3]), np.array([0.6, 0.8, 0, 0]))),)


def entries(poses):
    return [(name, pose.position.tolist(), pose.quaternion.tolist()) for name, pose in poses or ()]


def goal(key="a", at="2026-01-01T00:00:00.000Z", **changes):
    return replace(GoalRecord(key, "My goal", at, "composed", "s", goal_camera(64), POSES), **changes)


@pytest.fixture
def store(tmp_path):
    store = GoalStore(tmp_path / "goals", max_goals=3)
    store.start()
    return store


def left(tmp_path):
    return sorted(path.name for path in (tmp_path / "goals").iterdir())


@pytest.mark.parametrize("changes", [{}, {"source": "upload", "scene": None, "poses": None}, {"name": "Ö\n\U0001f600"}])
def test_a_goal_comes_back_as_it_was(store, tmp_path, changes):
    kept = goal(**changes)
    store.keep(kept, PNG)
    found = GoalStore(tmp_path / "goals", 3).get("a")
    for key in ("id", "name", "created_at", "source", "scene"):
        assert getattr(found, key) == getattr(kept, key)
    np.testing.assert_array_equal(found.camera.intrinsics, kept.camera.intrinsics)
    assert (found.camera.width, found.camera.name) == (64, "goal")
    assert entries(found.poses) == entries(kept.poses)
    assert store.image("a").read_bytes() == PNG
    assert left(tmp_path) == ["a"]


def test_the_newest_comes_first_also_when_the_clock_went_back(store, tmp_path):
    for name, day in (("a", 2), ("b", 3), ("c", 1)):
        store.keep(goal(name, f"2026-01-0{day}T00:00:00.000Z"), PNG)
    assert [record.id for record in store.all()] == ["c", "b", "a"]
    store.replace(store.get("a"), PNG)
    assert [record.id for record in GoalStore(tmp_path / "goals", 3).all()] == ["c", "b", "a"]


def test_goals_of_the_version_before_come_by_their_time_behind_newer_ones(store, tmp_path):
    for name, day in (("old", 2), ("older", 1)):
        store.keep(goal(name, f"2026-01-0{day}T00:00:00.000Z"), PNG)
        change_facts(tmp_path, name, lambda facts: facts.pop("number"))
    store.keep(goal("new", "2025-01-01T00:00:00.000Z"), PNG)
    assert [record.id for record in store.all()] == ["new", "old", "older"]


BEFORE = """{
 "id": "g", "name": "Mine", "created_at": "2026-01-01T00:00:00.000Z", "source": "photo", "scene": "s", "example": null,
 "camera": {
  "name": "goal", "T_world_camera": [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, -1.0, 0.75], [0, 0, 0, 1]],
  "K": [[80.0, 0.0, 32.0], [0.0, 80.0, 32.0], [0.0, 0.0, 1.0]], "width": 64, "height": 48
 },
 "objects": [{"name": "box", "position": [0.1, 0.2, 0.3], "quaternion": [0.6, 0.8, 0, 0]}],
 "photo": {"width": 300, "height": 200, "crop": {"left": 1, "top": 2.5, "width": 64.0, "turn_deg": -3.0}}
}"""


def test_a_file_of_the_version_before_is_read(store, tmp_path):
    store.keep(goal("g"), PNG)
    (tmp_path / "goals" / "g" / "goal.json").write_text(BEFORE)
    found = store.get("g")
    assert (found.name, found.source, found.scene, found.example) == ("Mine", "photo", "s", None)
    assert found.photo == PhotoRecord(300, 200, PhotoCrop(1, 2.5, 64, -3))
    assert (found.camera.height, found.camera.T_world_camera.position.tolist()) == (48, [0, 0.5, 0.75])
    assert entries(found.poses) == entries(POSES)


def test_there_is_an_end_to_what_is_kept(store, tmp_path):
    for name in "abc":
        store.keep(goal(name), PNG)
    with pytest.raises(TooManyGoals):
        store.keep(goal("d"), PNG)
    assert left(tmp_path) == ["a", "b", "c"]
    store.remove("b")
    store.keep(goal("d"), PNG)


def test_many_at_once_do_not_overrun_the_limit(store):
    outcomes = []

    def keep(number):
        try:
            store.keep(goal(f"g{number}"), PNG)
            outcomes.append(True)
        except TooManyGoals:
            outcomes.append(False)

    threads = [threading.Thread(target=keep, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(outcomes) == len(store.all()) == 3


def test_a_goal_that_was_removed_is_gone_with_its_image(store, tmp_path):
    store.keep(goal(), PNG)
    store.remove("a")
    assert left(tmp_path) == []
    for call in (store.get, store.remove):
        with pytest.raises(UnknownName, check=about("goal")):
            call("a")


@pytest.mark.parametrize("name", ["..", "../goals/a", "", "a/../a", "a" * 256, "é" * 128])
def test_names_that_lead_elsewhere_or_are_too_long_name_nothing(store, tmp_path, name):
    store.keep(goal(), PNG)
    with pytest.raises(UnknownName):
        store.remove(name)
    assert left(tmp_path) == ["a"]


@pytest.mark.parametrize(
    ("step", "file"), [("mkdir", None), ("write_bytes", "goal.png"), ("write_bytes", "goal.json"), ("replace", None)]
)
def test_a_full_disk_is_told_and_leaves_nothing(store, tmp_path, monkeypatch, step, file):
    store.keep(goal(), PNG)
    usual = getattr(Path, step)

    def full(path, *given, **named):
        if file in (None, path.name):
            raise OSError(28, "No space left on device")
        return usual(path, *given, **named)

    monkeypatch.setattr(Path, step, full)
    with pytest.raises(CannotStore):
        store.keep(goal("b"), PNG)
    monkeypatch.undo()
    assert left(tmp_path) == ["a"]
    assert [record.id for record in store.all()] == ["a"]


def test_a_goal_that_may_not_be_removed_stays(store, tmp_path, monkeypatch):
    store.keep(goal(), PNG)

    def denied(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "rename", denied)
    with pytest.raises(CannotStore):
        store.remove("a")
    monkeypatch.undo()
    assert (tmp_path / "goals" / "a" / IMAGE).read_bytes() == PNG


def change_facts(tmp_path, name, change):
    path = tmp_path / "goals" / name / "goal.json"
    facts = json.loads(path.read_text())
    change(facts)
    path.write_text(json.dumps(facts))


def check_b_is_damaged(store):
    """It is listed as such beside goal a, cannot be used, and can be removed."""
    assert [record.id for record in store.all()] == ["a"]
    assert [record.id for record in store.damaged()] == ["b"]
    with pytest.raises(CorruptFile, check=about(store.damaged()[0].reason)):
        store.get("b")
    store.remove("b")
    assert ([record.id for record in store.all()], store.damaged()) == (["a"], ())
    with pytest.raises(UnknownName):
        store.get("b")


def odd(**changes):
    return lambda facts: facts.update(changes)


def odd_pose(**changes):
    return lambda facts: facts["objects"][0].update(changes)


@pytest.mark.parametrize(
    "damage",
    [
        odd(name=5),
        odd(name="\ud800"),
        odd(created_at=None),
        odd(source="theft"),
        odd(source=["upload"]),
        odd(scene=0),
        odd(scene=["s"]),
        odd(scene="\ud800"),
        odd(camera={}),
        odd(camera=None),
        odd(objects=5),
        odd(objects=["box"]),
        odd(id="other"),
        odd_pose(name="\ud800"),
        odd_pose(position=[0, 0]),
        odd_pose(position=[0, 0, float("nan")]),
        odd_pose(position=[0, 0, 1e999]),
        odd_pose(quaternion=[0, 0, 0, 0]),
        odd_pose(quaternion="1000"),
        lambda facts: facts.pop("objects"),
        dict.clear,
    ],
)
def test_a_damaged_goal_hides_no_other_and_can_be_removed(store, tmp_path, damage):
    store.keep(goal("a"), PNG)
    store.keep(goal("b"), PNG)
    change_facts(tmp_path, "b", damage)
    check_b_is_damaged(store)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b'{"a":' * 100_000, b"\xff\xfe", b'{"id": ' + b"9" * 5000 + b"}"]
)
def test_what_is_no_json_is_damaged_and_hides_no_other(store, tmp_path, content):
    store.keep(goal("a"), PNG)
    (tmp_path / "goals" / "b").mkdir()
    (tmp_path / "goals" / "b" / "goal.json").write_bytes(content)
    check_b_is_damaged(store)


@pytest.mark.parametrize(
    "content",
    [b"", PNG[: len(PNG) // 2], PNG[:40] + b"\0" + PNG[41:], b"GIF89a", None],
    ids=["empty", "half", "garbled", "something else", "gone"],
)
def test_a_goal_without_a_whole_picture_is_damaged(store, tmp_path, content):
    for name in "ab":
        store.keep(goal(name), PNG)
    path = store.image("b")
    path.unlink() if content is None else path.write_bytes(content)
    check_b_is_damaged(store)


def test_a_goal_that_was_damaged_while_it_was_known_is_found_to_be(store):
    for name in "ab":
        store.keep(goal(name), PNG)
    assert store.get("b").id == "b"
    store.image("b").write_bytes(PNG[:-8])
    check_b_is_damaged(store)


def test_one_goal_is_had_without_reading_the_others(store, monkeypatch):
    for name in "abc":
        store.keep(goal(name), PNG)
    read, usual = [], Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, **given: read.append(path.parent.name) or usual(path, **given))
    assert store.get("b").id == "b"
    assert set(read) <= {"b"}


def test_what_a_killed_service_left_half_done_goes_at_the_next_start(store, tmp_path):
    store.keep(goal(), PNG)
    (tmp_path / "goals" / ".new-abc").mkdir()
    (tmp_path / "goals" / ".new-abc" / "goal.json").write_text("{")
    assert [record.id for record in store.all()] == ["a"]
    GoalStore(tmp_path / "goals", 3).start()
    assert left(tmp_path) == ["a"]


# Photographs of tables

K = np.array([[600.0, 0, 320], [0, 610.0, 240], [0, 0, 1]])
MUG = MarkedObject(
    "025_mug",
    Mark((10.0, 20.0, 110.0, 140.0), ((60.0, 80.0),), ((12.0, 22.0),), (Stroke(True, 5.0, ((1.0, 2.0), (3.0, 4.0))),)),
    (((10.0, 20.0), (110.0, 20.0), (60.0, 140.0)),),
)
BOARD = Pose(np.array([0.1, -0.4, 0.5]), np.array([0.6, 0.8, 0.0, 0.0]))


def table_photo(name="p1", **changes):
    photo = TablePhoto(
        name, "My table", "2026-01-01T00:00:00Z", 640, 480, 1280, K, "board", BOARD, ("A note.",), (MUG,)
    )
    return replace(photo, **changes)


@pytest.fixture
def photos(tmp_path):
    return TablePhotoStore(tmp_path / "photos", 3)


def test_a_photo_is_read_as_it_was_kept(photos):
    kept = table_photo(job="j", scene="s", T_table_photo=BOARD)
    photos.keep(kept, b"sent", JPEG)
    read = photos.get("p1")
    assert read.objects == kept.objects
    assert (read.source, read.notes, read.job, read.scene) == ("board", ("A note.",), "j", "s")
    np.testing.assert_array_equal(read.K, K)
    for pose in (read.T_world_camera, read.T_table_photo):
        np.testing.assert_allclose(pose.matrix(), BOARD.matrix(), atol=1e-12)
    assert (photos.sent("p1").read_bytes(), photos.picture("p1").read_bytes()) == (b"sent", JPEG)


def test_a_photo_without_a_board_has_no_pose(photos):
    photos.keep(table_photo(T_world_camera=None, source="assumed", objects=()), b"", JPEG)
    assert photos.get("p1").T_world_camera is None


def test_other_facts_take_the_place_of_those_before_with_files(photos):
    photos.keep(table_photo(objects=()), b"", JPEG)
    with_choice = (replace(MUG, choice=2),)
    files = {mask_file(MUG.name): b"png"}
    photos.change("p1", lambda latest: replace(latest, objects=with_choice), files)
    assert photos.get("p1").marked(MUG.name).choice == 2
    assert photos.mask("p1", MUG.name).read_bytes() == b"png"


def test_only_so_many_photos_are_kept_and_one_may_go(photos):
    for name in ("p1", "p2", "p3"):
        photos.keep(table_photo(name), b"", JPEG)
    with pytest.raises(TooManyPhotos):
        photos.keep(table_photo("p4"), b"", JPEG)
    photos.remove("p1")
    assert [photo.id for photo in photos.all()] == ["p3", "p2"]
    with pytest.raises(UnknownName, check=about("photo")):
        photos.get("p1")


def test_a_damaged_photo_does_not_hide_the_others(photos):
    for name in ("p1", "p2", "p3"):
        photos.keep(table_photo(name), b"", JPEG)
    (photos.picture("p1").parent / "photo.json").write_text("{")
    photos.picture("p2").write_bytes(JPEG[:-9])
    assert [photo.id for photo in photos.all()] == ["p3"]
    assert {photo.id for photo in photos.damaged()} == {"p1", "p2"}


def test_an_object_marked_again_keeps_its_place_among_the_others():
    other = replace(MUG, name="024_bowl")
    photo = table_photo(objects=(MUG, other)).with_object(replace(MUG, outline=()))
    assert [entry.name for entry in photo.objects] == ["025_mug", "024_bowl"]
    assert photo.marked("025_mug").outline == ()
    with pytest.raises(UnknownName, check=about("003_cracker_box")):
        photo.marked("003_cracker_box")


def test_a_smaller_picture_has_the_camera_of_the_photo():
    camera = table_photo().camera(BOARD, 320)
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.intrinsics, [[300, 0, 160], [0, 305, 120], [0, 0, 1]], atol=1e-12)
