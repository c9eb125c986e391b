import contextlib
import itertools
import json
import shutil
import sqlite3
import subprocess
import sys
import threading

import numpy as np
import pytest

from app.processes.messages.scene_messages import SceneRecord
from app.storage.database import FILE, CannotStore, DataDirectoryInUse, Store
from app.storage.schema import MIGRATIONS, SCHEMA_VERSION
from osfcore.errors import CorruptFile
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import state_to_json
from tests.app.conftest import until


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


def begins_with_an_empty_one(folder, name, match):
    """A service starts, and what was there is kept under another name."""
    before = (folder / FILE).read_bytes()
    store = Store(folder)
    assert (store.scenes(), store.jobs()) == (((), None), ())
    (sentence,) = store.oddities
    assert match in sentence
    assert name in sentence
    store.save_job("a", 1, {"x": 1})
    store.close()
    assert (folder / name).read_bytes() == before
    again = Store(folder)
    assert (again.jobs(), again.oddities) == (((1, {"x": 1}),), [])
    again.close()


@pytest.mark.parametrize(
    "content", [b"not a database at all, but long enough" * 50, b"SQLite format 3\0" + b"\xff" * 4096]
)
def test_a_damaged_file_is_put_aside(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    begins_with_an_empty_one(tmp_path, f"{FILE}.damaged", "it is damaged")


def test_a_file_with_damage_inside_is_put_aside(tmp_path):
    store = Store(tmp_path)
    for number in range(200):
        store.save_job(str(number), number, {"x": "y" * 200})
    store.close()
    data = bytearray((tmp_path / FILE).read_bytes())
    data[3 * 4096 : 6 * 4096] = b"\xa5" * (3 * 4096)
    (tmp_path / FILE).write_bytes(data)
    begins_with_an_empty_one(tmp_path, f"{FILE}.damaged", "it is damaged")


def test_a_newer_versions_file_is_put_aside_and_so_is_the_next(tmp_path):
    for name in (f"{FILE}.format-{SCHEMA_VERSION + 1}", f"{FILE}.format-{SCHEMA_VERSION + 1}-2"):
        Store(tmp_path).close()
        with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
            database.execute("DELETE FROM jobs")
            database.commit()
            database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
        begins_with_an_empty_one(tmp_path, name, "a newer version")


def test_another_programs_file_is_refused_and_left(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
        database.execute("CREATE TABLE other (x)")
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(CorruptFile, match="another program"):
        Store(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


FIRST_FORMAT = """
CREATE TABLE scenes (
    id TEXT PRIMARY KEY, seed INTEGER NOT NULL, created_at TEXT NOT NULL, image_size INTEGER NOT NULL,
    initial TEXT NOT NULL, state TEXT NOT NULL, time_s REAL NOT NULL, revision INTEGER NOT NULL,
    is_current INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER NOT NULL, job TEXT NOT NULL);
CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL);
INSERT INTO jobs VALUES ('a', 3, '{"x": 1}');
PRAGMA application_id = 1330857521;
PRAGMA user_version = 1;
"""


def test_a_file_of_the_first_format_is_brought_up_and_kept_as_it_was(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
        database.executescript(FIRST_FORMAT)
    store = Store(tmp_path)
    assert (store.jobs(), store.oddities) == (((3, {"x": 1}),), [])
    store.set_aside("job", "a", "a test")
    assert store.jobs() == ()
    store.close()
    with contextlib.closing(sqlite3.connect(tmp_path / f"{FILE}.format-1")) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (1,)
        assert database.execute("SELECT id FROM jobs").fetchall() == [("a",)]


def test_a_format_never_changes():
    with (
        contextlib.closing(sqlite3.connect(":memory:")) as first,
        contextlib.closing(sqlite3.connect(":memory:")) as now,
    ):
        first.executescript(FIRST_FORMAT)
        now.executescript(MIGRATIONS[0])
        tables = "SELECT name, sql FROM sqlite_master ORDER BY name"
        assert first.execute(tables).fetchall() == now.execute(tables).fetchall()


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotStore, match="cannot be written"):
        Store(tmp_path / "file" / "data")


def changed(folder, statement):
    """Change the database behind the service's back."""
    with contextlib.closing(sqlite3.connect(folder / FILE)) as database:
        database.execute(statement)
        database.commit()


@pytest.mark.parametrize(
    "change",
    [
        "state = '{}'",
        "state = '{'",
        "initial = 'null'",
        "seed = 'x'",
        "time_s = 'x'",
        "revision = 0.5",
        "state = x'ff'",
    ],
)
def test_a_scene_that_makes_no_sense_is_set_aside_and_told(tmp_path, change):
    store = Store(tmp_path)
    store.save_scene(record("a"))
    store.save_scene(record("b"))
    store.close()
    changed(tmp_path, f"UPDATE scenes SET {change} WHERE id = 'a'")
    store = Store(tmp_path)
    assert [kept.id for kept in store.scenes()[0]] == ["b"]
    assert "stored scene (a)" in store.oddities[0]
    store.close()
    again = Store(tmp_path)
    assert [kept.id for kept in again.scenes()[0]] == ["b"]
    assert again.oddities == []
    again.close()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
        ((kind, name, row),) = database.execute("SELECT kind, id, row FROM set_aside").fetchall()
    assert (kind, name) == ("scene", "a")
    assert json.loads(row)["id"] == "a"


@pytest.mark.parametrize("text", ["{", "[]", "null", "", "[" * 100_000])
def test_rows_that_are_no_json_objects_are_set_aside_and_such_events_are_left_out(tmp_path, text):
    store = Store(tmp_path)
    for number, job in enumerate("ab"):
        store.save_job(job, number, {"x": job}, {"x": job})
    store.close()
    changed(tmp_path, f"UPDATE jobs SET job = '{text}' WHERE id = 'a'")
    changed(tmp_path, f"UPDATE events SET job = '{text}' WHERE id = 1")
    store = Store(tmp_path)
    assert store.jobs() == ((1, {"x": "b"}),)
    assert store.events_after(0) == ((2, {"x": "b"}),)
    assert "stored job (a)" in store.oddities[0]
    store.close()


def crash_image(folder, copy):
    """The files of an open database, as a loss of power would leave them."""
    copy.mkdir()
    for name in (FILE, f"{FILE}-wal"):
        shutil.copyfile(folder / name, copy / name)


def test_what_was_acknowledged_is_there_whenever_the_power_fails(tmp_path):
    store, acknowledged, is_over, snapshot = Store(tmp_path / "data"), [], threading.Event(), threading.Lock()

    def write():
        for number in itertools.count():
            if is_over.is_set():
                return
            with snapshot:  # or two files would be copied that were never there together
                store.save_job(str(number), number, {"x": "y" * 300}, {"x": number})
            acknowledged.append(number)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for number in range(8):
            until(lambda least=50 * number: len(acknowledged) > least)
            promised = len(acknowledged)
            with snapshot:
                crash_image(tmp_path / "data", tmp_path / f"copy{number}")
            after = Store(tmp_path / f"copy{number}")
            assert [job for job, _ in after.jobs()][:promised] == list(range(promised))
            assert after.oddities == []
            after.close()
    finally:
        is_over.set()
        writer.join()
        store.close()


WRITER = """
import sys
from pathlib import Path
from app.storage.database import Store
store = Store(Path(sys.argv[1]))
for number in range(100000):
    store.save_job(str(number), number, {"x": number})
    print(number, flush=True)
"""


def test_what_was_acknowledged_is_there_after_a_kill(tmp_path):
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE) as writer:
        told = [int(writer.stdout.readline()) for _ in range(50)]
        writer.kill()
        told += [int(line) for line in writer.stdout.read().split()]
    store = Store(tmp_path)
    assert [number for number, _ in store.jobs()][: len(told)] == told
    store.close()


def test_a_disk_that_refuses_is_told_until_it_takes_something_again(tmp_path):
    store = Store(tmp_path)
    with contextlib.closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as other:
        other.execute("PRAGMA busy_timeout = 0")
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(CannotStore):
            store.save_job("a", 1, {})
        assert "cannot be written" in store.problem
        store.probe()
        assert store.problem
        assert store.jobs() == ()  # reading goes on
        other.execute("ROLLBACK")
    store.probe()
    assert store.problem is None
    store.save_job("a", 1, {})
    store.close()
