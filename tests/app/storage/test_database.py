import sqlite3

import numpy as np
import pytest

from app.processes.messages.scene_messages import SceneRecord
from app.storage.database import FILE, SCHEMA_VERSION, CannotStore, DataDirectoryInUse, Store
from osfcore.errors import CorruptFile
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import state_to_json


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path, max_events=20)
    yield store
    store.close()


def record(scene="a", revision=1, pusher=(0.1, 0.2, 0.06)):
    poses = Pose(np.array([[0.0, 0.1, 0.2], [0.3, 0.0, 0.1]]), np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]]))
    hand = None if pusher is None else np.array(pusher)
    state = SceneState(("x", "y"), poses, Light(np.array([0.0, 0.6, 0.8])), hand)
    return SceneRecord(scene, 7, "2026-01-01T00:00:00.000Z", 128, state, state, 0.4, revision)


@pytest.mark.parametrize("pusher", [None, (0.1, 0.2, 0.06)])
def test_scenes_come_back_bit_for_bit(store, pusher):
    kept = record(pusher=pusher)
    store.save_scene(kept)
    (found,), current = store.scenes()
    assert current is None
    assert state_to_json(found.state) == state_to_json(kept.state)
    assert np.array_equal(found.initial.poses.quaternion, kept.initial.poses.quaternion)
    assert (found.id, found.seed, found.image_size, found.time_s, found.revision) == ("a", 7, 128, 0.4, 1)


def test_saving_again_updates_and_current_moves(store):
    store.save_scene(record("a"))
    store.save_scene(record("b"))
    store.set_current("a")
    store.save_scene(record("a", revision=9))
    assert store.scenes()[1] == "a"
    store.set_current("b")
    records, current = store.scenes()
    assert current == "b"
    assert {r.id: r.revision for r in records} == {"a": 9, "b": 1}
    store.delete_scene("b")
    records, current = store.scenes()
    assert ([r.id for r in records], current) == (["a"], None)


def test_events_are_numbered_and_pruned(store):
    numbers = [store.add_event({"n": n}) for n in range(50)]
    assert numbers == sorted(set(numbers))
    kept = store.events_after(0)
    assert [fields["n"] for _, fields in kept] == list(range(30, 50))
    assert store.events_after(numbers[-3]) == kept[-2:]


def test_numbers_of_events_are_never_used_again(tmp_path):
    store = Store(tmp_path)
    last = [store.add_event({}) for _ in range(3)][-1]
    store.close()
    store = Store(tmp_path)
    assert store.add_event({}) == last + 1
    store.close()


def test_jobs_come_back_in_order(store):
    store.save_job("b", 1, {"x": 1})
    store.save_job("a", 2, {"x": 2})
    store.save_job("b", 1, {"x": 3})
    assert store.jobs() == ((1, {"x": 3}), (2, {"x": 2}))


def test_a_second_service_is_kept_out_until_the_first_leaves(tmp_path):
    first = Store(tmp_path)
    with pytest.raises(DataDirectoryInUse, match="Another service"):
        Store(tmp_path)
    first.close()
    Store(tmp_path).close()


def refused_and_untouched(tmp_path, match):
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(CorruptFile, match=match):
        Store(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


@pytest.mark.parametrize(
    "content", [b"not a database at all, but long enough" * 50, b"SQLite format 3\0" + b"\xff" * 4096]
)
def test_damaged_files_are_told_and_left(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    refused_and_untouched(tmp_path, "damaged")


def test_damage_inside_is_found(tmp_path):
    store = Store(tmp_path)
    for number in range(200):
        store.save_job(str(number), number, {"x": "y" * 200})
    store.close()
    data = bytearray((tmp_path / FILE).read_bytes())
    data[3 * 4096 : 6 * 4096] = b"\xa5" * (3 * 4096)
    (tmp_path / FILE).write_bytes(data)
    refused_and_untouched(tmp_path, "damaged")


def test_newer_versions_and_strangers_are_refused(tmp_path):
    Store(tmp_path).close()
    with sqlite3.connect(tmp_path / FILE) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    database.close()
    refused_and_untouched(tmp_path, "newer version")
    (tmp_path / FILE).unlink()
    with sqlite3.connect(tmp_path / FILE) as database:
        database.execute("CREATE TABLE other (x)")
    database.close()
    refused_and_untouched(tmp_path, "another program")


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotStore, match="cannot be written"):
        Store(tmp_path / "file" / "data")


def test_a_scene_that_makes_no_sense_is_told(tmp_path):
    store = Store(tmp_path)
    store.save_scene(record())
    store.close()
    with sqlite3.connect(tmp_path / FILE) as database:
        database.execute("UPDATE scenes SET state = '{}'")
    database.close()
    store = Store(tmp_path)
    with pytest.raises(CorruptFile, match="makes no sense"):
        store.scenes()
    store.close()
