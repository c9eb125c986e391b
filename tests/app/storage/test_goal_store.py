import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.storage.database import CannotStore
from app.storage.goal_store import IMAGE, GoalRecord, GoalStore, TooManyGoals, poses_to_json
from osfcore.errors import UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from tests.support.errors import about

PNG = b"\x89PNG picture"
POSES = (("box", Pose(np.array([0.1, 0.2, 0.3]), np.array([0.6, 0.8, 0, 0]))),)


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
    assert (found.poses and poses_to_json(found.poses)) == (kept.poses and poses_to_json(kept.poses))
    assert store.image("a").read_bytes() == PNG
    assert left(tmp_path) == ["a"]


def test_the_newest_comes_first(store):
    for name, day in (("a", 2), ("b", 3), ("c", 1)):
        store.keep(goal(name, f"2026-01-0{day}T00:00:00.000Z"), PNG)
    assert [record.id for record in store.all()] == ["b", "a", "c"]


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


@pytest.mark.parametrize("name", ["..", "../goals/a", "", "a/../a"])
def test_names_that_lead_elsewhere_name_nothing(store, tmp_path, name):
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
def test_a_damaged_goal_hides_itself_and_no_other(store, tmp_path, damage):
    store.keep(goal("a"), PNG)
    store.keep(goal("b"), PNG)
    path = tmp_path / "goals" / "b" / "goal.json"
    facts = json.loads(path.read_text())
    damage(facts)
    path.write_text(json.dumps(facts))
    assert [record.id for record in store.all()] == ["a"]
    with pytest.raises(UnknownName):
        store.get("b")


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b'{"a":' * 100_000, b"\xff\xfe", b'{"id": ' + b"9" * 5000 + b"}"]
)
def test_what_is_no_json_hides_no_other(store, tmp_path, content):
    store.keep(goal("a"), PNG)
    (tmp_path / "goals" / "b").mkdir()
    (tmp_path / "goals" / "b" / "goal.json").write_bytes(content)
    assert [record.id for record in store.all()] == ["a"]


def test_what_a_killed_service_left_half_done_goes_at_the_next_start(store, tmp_path):
    store.keep(goal(), PNG)
    (tmp_path / "goals" / ".new-abc").mkdir()
    (tmp_path / "goals" / ".new-abc" / "goal.json").write_text("{")
    assert [record.id for record in store.all()] == ["a"]
    GoalStore(tmp_path / "goals", 3).start()
    assert left(tmp_path) == ["a"]
