import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.jobs.folders import JobFolders
from app.services.image_sets import ImageSets
from app.storage.field_files import (
    install,
    install_published,
    open_workshop,
    remove_workshop,
    uninstall,
    uninstall_published,
)
from app.storage.records import GoalStore, TablePhotoStore, mask_file
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE
from osfcore.io.files import folder_at_once, put_in_place, write_atomically
from osfcore.io.image_file import write_png
from tests.app.storage.test_records import JPEG, PNG, goal, table_photo


@pytest.fixture
def synced(monkeypatch):
    """What was written to the disk and what was renamed, in order: inodes, and names of places."""
    found, fsync = [], os.fsync

    def noting_fsync(descriptor):
        found.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    def noting(rename):
        def noting_rename(self, target):
            found.append(Path(target).name)
            return rename(self, target)

        return noting_rename

    monkeypatch.setattr(os, "fsync", noting_fsync)
    monkeypatch.setattr(Path, "rename", noting(Path.rename))
    monkeypatch.setattr(Path, "replace", noting(Path.replace))
    return found


def is_safe(synced, place):
    """Whether all of a place was on the disk before it took its name, and the name after."""
    at = len(synced) - 1 - synced[::-1].index(place.name)
    inside = {place.stat().st_ino, *(path.stat().st_ino for path in place.rglob("*"))}
    return inside <= set(synced[:at]) and place.parent.stat().st_ino in synced[at:]


def test_everything_is_on_the_disk_before_its_name_is(tmp_path, synced):
    made = tmp_path / "made" / "deep"
    made.mkdir(parents=True)
    (made / "a").write_text("a")
    (made.parent / "b").write_text("b")
    (tmp_path / "places").mkdir()
    put_in_place(made.parent, tmp_path / "places" / "p")
    assert is_safe(synced, tmp_path / "places" / "p")
    assert tmp_path.stat().st_ino in synced[synced.index("p") :]
    (tmp_path / "file").write_text("x")
    put_in_place(tmp_path / "file", tmp_path / "places" / "f")
    assert is_safe(synced, tmp_path / "places" / "f")


def test_files_and_folders_of_the_core_outlive_a_power_failure(tmp_path, synced):
    for _ in range(2):  # anew, and over an older one
        synced.clear()
        write_atomically(tmp_path / "new" / "report.json", b"{}")
        assert is_safe(synced, tmp_path / "new" / "report.json")
    with folder_at_once(tmp_path / "set") as folder:
        (folder / "train").mkdir()
        (folder / "train" / "0000.png").write_bytes(PNG)
    assert is_safe(synced, tmp_path / "set")


def test_a_changed_goal_outlives_a_power_failure(tmp_path, synced):
    store = GoalStore(tmp_path / "goals", 3)
    store.keep(goal("a"), PNG)
    synced.clear()
    store.replace(goal("a"), PNG)
    for path in (tmp_path / "goals" / "a").iterdir():
        assert is_safe(synced, path)


def test_goals_outlive_a_power_failure(tmp_path, synced):
    GoalStore(tmp_path / "goals", 3).keep(goal("a"), PNG)
    assert is_safe(synced, tmp_path / "goals" / "a")


def test_a_deleted_goal_stays_deleted_after_a_power_failure(tmp_path, synced):
    store = GoalStore(tmp_path / "goals", 3)
    store.keep(goal("a"), PNG)
    synced.clear()
    store.remove("a")
    assert isinstance(synced[0], str)  # it loses its name, and then that is put on the disk
    assert (tmp_path / "goals").stat().st_ino in synced[1:]


def test_what_is_changed_of_a_photo_outlives_a_power_failure(tmp_path, synced):
    store = TablePhotoStore(tmp_path / "photos", 3)
    store.keep(table_photo("p"), b"sent", JPEG)
    synced.clear()
    store.change("p", lambda photo: replace(photo, job="j"), {mask_file("mug"): PNG})
    for name in (mask_file("mug"), "photo.json"):
        assert is_safe(synced, store.picture("p").with_name(name))
    synced.clear()
    store.change("p", lambda photo: photo, {mask_file("mug"): None})
    assert store.picture("p").parent.stat().st_ino in synced


def test_pictures_of_episodes_outlive_a_power_failure(tmp_path, synced):
    write_png(tmp_path / "frames" / "000.png", np.zeros((8, 8, 3), np.uint8))
    assert is_safe(synced, tmp_path / "frames" / "000.png")


def test_inputs_of_a_job_outlive_a_power_failure(tmp_path, synced):
    folders = JobFolders(tmp_path)
    with folders.new_inputs() as folder:
        folder.mkdir(parents=True)
        (folder / "goal.png").write_bytes(PNG)
        folders.take("j", folder)
    assert is_safe(synced, folders.inputs("j"))
    assert (tmp_path / "collections").stat().st_ino in synced


def test_files_of_a_forgotten_job_stay_away_after_a_power_failure(tmp_path, synced):
    folders = JobFolders(tmp_path)
    folders.folder("j").mkdir(parents=True)
    aside = folders.put_aside("j")
    assert (tmp_path / "collections").stat().st_ino in synced[synced.index(aside.name) :]


def test_a_deleted_set_of_images_stays_deleted_after_a_power_failure(tmp_path, synced):
    facts = {"id": "s", "file_name": "s.zip", "created_at": "2026", "train": 1, "test": 1, "summary": ""}
    write_atomically(tmp_path / "sets" / "s" / "set.json", json.dumps(facts).encode())
    synced.clear()
    ImageSets(tmp_path / "sets").remove("s")
    assert synced[-1] == (tmp_path / "sets").stat().st_ino


def test_deleted_fields_and_leftovers_of_training_stay_deleted_after_a_power_failure(tmp_path, synced):
    made = tmp_path / "made"
    made.mkdir()
    for name in (FIELD_FILE, METRICS_FILE):
        (made / name).write_text("{}")
    field, published = tmp_path / "fields" / "mug", tmp_path / "paper_fields" / "mug.safetensors"
    install(made, field)
    install_published(made, published)
    leftover = open_workshop(tmp_path, "mug", {})
    for place, delete in (
        (field, lambda: uninstall(field)),
        (published, lambda: uninstall_published(published)),
        (leftover, lambda: remove_workshop(tmp_path, "mug")),
    ):
        synced.clear()
        delete()
        assert not place.exists()
        assert synced[-1] == place.parent.stat().st_ino


def test_fields_outlive_a_power_failure_also_those_that_replace_one(tmp_path, synced):
    made, place = tmp_path / "made", tmp_path / "fields" / "mug"
    made.mkdir()
    for name in (FIELD_FILE, METRICS_FILE):
        (made / name).write_text("{}")
    for _ in range(2):
        synced.clear()
        install(made, place)
        assert is_safe(synced, place)
