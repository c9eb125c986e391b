import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.processes.messages.scene_messages import SceneRecord
from app.storage.database import FILE, SCHEMA_VERSION, CannotStore, DataDirectoryInUse, Store, check_data_dir
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import state_to_json
from tests.app.conftest import full_disk, until


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


def change(tmp_path, *statements):
    """Change a database behind the service's back."""
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database, database:
        for statement, *values in statements:
            database.execute(statement, values)


@pytest.mark.parametrize("pusher", [None, (0.1, 0.2, 0.06)])
def test_scenes_come_back_bit_for_bit(store, pusher):
    kept = record(pusher=pusher)
    store.save_scene(kept)
    (found,), current = store.scenes()
    assert current is None
    assert state_to_json(found.state) == state_to_json(kept.state)
    assert np.array_equal(found.initial.poses.quaternion, kept.initial.poses.quaternion)
    assert (found.id, found.seed, found.image_size, found.time_s, found.revision) == ("a", 7, 128, 0.4, 1)


def test_scenes_are_in_the_order_in_which_they_were_made_whatever_the_clock_said(tmp_path, store):
    for name, year in (("a", 2026), ("b", 2027), ("c", 2025)):
        store.save_scene(replace(record(), id=name, created_at=f"{year}-01-01T00:00:00.000Z"))
    store.save_scene(replace(record(), id="a", revision=7))
    assert [scene.id for scene in store.scenes()[0]] == ["a", "b", "c"]


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
    numbers = [store.save_job("a", 1, {"n": n}) for n in range(50)]
    assert numbers == sorted(set(numbers))
    kept = store.events_after(0)
    assert [fields["n"] for _, fields in kept] == list(range(30, 50))
    assert store.events_after(numbers[-3]) == kept[-2:]


def test_an_event_tells_more_than_is_kept_of_the_job(store):
    store.save_job("a", 1, {"x": 1}, {"x": 1, "position": 2})
    assert store.jobs() == ((1, {"x": 1}),)
    assert [fields for _, fields in store.events_after(0)] == [{"x": 1, "position": 2}]


def test_numbers_of_events_are_never_used_again(tmp_path):
    store = Store(tmp_path)
    last = [store.save_job("a", 1, {}) for _ in range(3)][-1]
    store.close()
    store = Store(tmp_path)
    assert store.save_job("a", 1, {}) == last + 1
    store.close()


def test_jobs_come_back_in_order(store):
    store.save_job("b", 1, {"x": 1})
    store.save_job("a", 2, {"x": 2})
    store.save_job("b", 1, {"x": 3})
    assert store.jobs() == ((1, {"x": 3}), (2, {"x": 2}))


def garbled(path):
    with path.open("r+b") as file:
        file.seek(3 * 4096)
        file.write(b"\xa5" * (3 * 4096))


def replaced_by_a_copy(path):
    copy = path.with_name("copy")
    shutil.copyfile(path, copy)
    copy.replace(path)


DAMAGE = {
    "deleted": Path.unlink,
    "emptied": lambda path: os.truncate(path, 0),
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "garbled": garbled,
    "replaced": replaced_by_a_copy,
    "log deleted": lambda path: path.with_name(f"{path.name}-wal").unlink(),
    "folder renamed": lambda path: path.parent.rename(path.parent.with_name("elsewhere")),
}


@pytest.fixture
def filled(tmp_path):
    """A database of which most is in the file itself, open."""
    with contextlib.closing(Store(tmp_path / "data")) as store:
        for number in range(200):
            store.save_job(str(number), number, {"x": "y" * 200})
    with contextlib.closing(Store(tmp_path / "data")) as store:
        yield store


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_nothing_is_accepted_that_would_be_gone_at_the_next_start(filled, tmp_path, damage):
    filled.save_job("before", 200, {})
    assert filled.probe() is None
    damage(tmp_path / "data" / FILE)
    with pytest.raises(CannotStore):
        filled.save_job("after", 201, {})
    assert FILE in filled.probe()
    filled.save_job("before", 200, {"is": "done"}, can_wait=True)
    assert filled.unwritten == 1


def test_a_data_folder_that_is_put_back_is_written_to_again(filled, tmp_path):
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    filled.save_job("a", 200, {}, can_wait=True)
    (tmp_path / "elsewhere").rename(tmp_path / "data")
    assert filled.probe() is None
    assert (filled.unwritten, len(filled.jobs())) == (0, 201)


def test_a_second_service_is_kept_out_until_the_first_leaves(tmp_path):
    first = Store(tmp_path)
    with pytest.raises(DataDirectoryInUse):
        Store(tmp_path)
    with pytest.raises(DataDirectoryInUse):
        check_data_dir(tmp_path)
    first.close()
    check_data_dir(tmp_path)
    Store(tmp_path).close()


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    for opened in (Store, check_data_dir):
        with pytest.raises(CannotStore):
            opened(tmp_path / "file" / "data")


# What the disk refuses


def test_what_has_to_be_stored_is_refused_by_a_full_disk_and_nothing_of_it_is_left(store):
    store.save_job("a", 1, {"x": 1})
    store.save_scene(record("s"))
    with full_disk():
        for write in (
            lambda: store.save_job("b", 2, {"x": 2}),
            lambda: store.save_scene(record()),
            lambda: store.delete_scene("s"),
        ):
            with pytest.raises(CannotStore):
                write()
        assert store.jobs() == ((1, {"x": 1}),)
    assert store.unwritten == 0
    store.save_job("c", 3, {"x": 3})
    assert [number for number, _ in store.jobs()] == [1, 3]
    assert [scene.id for scene in store.scenes()[0]] == ["s"]


def test_what_can_wait_is_written_as_soon_as_the_disk_takes_it(store, caplog):
    store.save_scene(record("a"))
    with full_disk():
        assert store.save_job("j", 1, {"x": 1}, can_wait=True) == 0
        store.save_job("j", 1, {"x": 2}, can_wait=True)
        store.save_scene(record("a", revision=5), can_wait=True)
        store.set_current("a")
        assert store.unwritten == 3
        store.retry()
        assert store.unwritten == 3
    assert "tried again" in caplog.text
    store.retry()
    assert store.unwritten == 0
    (scene,), current = store.scenes()
    assert (store.jobs(), scene.revision, current) == (((1, {"x": 2}),), 5, "a")


@pytest.mark.parametrize("how", ["next write", "end"])
def test_what_waits_goes_with_the_next_write_or_at_the_end(tmp_path, how):
    store = Store(tmp_path)
    with full_disk():
        store.save_job("j", 1, {"x": 1}, can_wait=True)
    if how == "next write":
        store.save_job("k", 2, {})
        assert store.unwritten == 0
    store.close()
    with contextlib.closing(Store(tmp_path)) as store:
        assert (1, {"x": 1}) in store.jobs()


def test_a_scene_that_was_deleted_does_not_come_back_with_what_waited(store):
    store.save_scene(record("a"))
    with full_disk():
        store.save_scene(record("a", revision=2), can_wait=True)
    store.delete_scene("a")
    store.retry()
    assert store.scenes()[0] == ()


# What makes no sense


ODD_SCENES = [
    "state = '{}'",
    "state = 'no json'",
    "state = '" + '{"a":' * 20_000 + "'",
    "initial = '[]'",
    "initial = x'ff00'",
    "image_size = 3",
    "image_size = 'wide'",
    "seed = -1",
    "time_s = 1e999",
    "created_at = x'ff'",
    """state = '{"objects": [], "light": {"position": [0, 0, 1]}}'""",
    """state = json_replace(state, '$.objects[0].quaternion', json('[0, 0, 0, 0]'))""",
    """state = json_replace(state, '$.objects[0].name', 'y')""",
]


@pytest.mark.parametrize("damage", ODD_SCENES, ids=range(len(ODD_SCENES)))
def test_a_scene_that_makes_no_sense_is_set_aside_and_hides_no_other(tmp_path, damage):
    with contextlib.closing(Store(tmp_path)) as store:
        store.save_scene(record("a"))
        store.save_scene(record("b"))
        store.set_current("a")
    change(tmp_path, (f"UPDATE scenes SET {damage} WHERE id = 'a'",))
    with contextlib.closing(Store(tmp_path)) as store:
        records, current = store.scenes()
        assert ([r.id for r in records], current) == (["b"], None)
        (entry,) = store.set_aside
        assert (entry.kind, entry.id) == ("scene", "a")
        assert "makes no sense" in entry.sentence
        assert len(store.scenes()[0]) == 1
        assert store.set_aside == (entry,)
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
        ((kind, name, row, reason),) = database.execute("SELECT kind, id, row, reason FROM set_aside").fetchall()
        assert database.execute("SELECT id FROM scenes").fetchall() == [("b",)]
    assert (kind, name, reason) == ("scene", "a", entry.reason)
    assert json.loads(row)["id"] == "a"


@pytest.mark.parametrize(
    "text", ["no json", "[]", "5", '{"id": "other"}', '{"x": NaN}', '{"x": "\\ud800"}', '{"a":' * 20_000, None, b"\xff"]
)
def test_a_job_that_makes_no_sense_is_set_aside_and_hides_no_other(tmp_path, text):
    with contextlib.closing(Store(tmp_path)) as store:
        store.save_job("a", 1, {"x": 1})
        store.save_job("b", 2, {"x": 2})
    change(tmp_path, ("DROP TABLE jobs",), ("CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER, job TEXT)",))
    change(tmp_path, ("INSERT INTO jobs VALUES ('a', 1, ?), ('b', 2, '{\"x\": 2}')", text))
    with contextlib.closing(Store(tmp_path)) as store:
        assert store.jobs() == ((2, {"x": 2}),)
        assert [(entry.kind, entry.id) for entry in store.set_aside] == [("job", "a")]
    with contextlib.closing(Store(tmp_path)) as store:
        assert store.jobs() == ((2, {"x": 2}),)
        assert store.set_aside == ()


def test_what_a_reader_refuses_is_set_aside_too(store):
    def parse(fields):
        if fields["x"] == 1:
            raise InvalidInput("x", 1, "another one")
        return fields["x"]

    store.save_job("a", 1, {"x": 1})
    store.save_job("b", 2, {"x": 2})
    assert store.events_after(0, parse) == ((2, 2),)
    assert store.jobs(parse) == ((2, 2),)
    assert [entry.reason for entry in store.set_aside] == ["x is 1, but it must be another one"]


def test_events_that_cannot_be_read_are_skipped(tmp_path):
    with contextlib.closing(Store(tmp_path)) as store:
        for n in range(3):
            store.save_job("a", 1, {"n": n})
    change(tmp_path, ("UPDATE events SET job = '{' WHERE id = 2",))
    with contextlib.closing(Store(tmp_path)) as store:
        assert [fields["n"] for _, fields in store.events_after(0)] == [0, 2]


def test_odd_rows_on_a_full_disk_do_not_stop_the_start(tmp_path):
    with contextlib.closing(Store(tmp_path)) as store:
        store.save_job("a", 1, {})
    change(tmp_path, ("UPDATE jobs SET job = '{'",))
    with contextlib.closing(Store(tmp_path)) as store:
        with full_disk():
            assert store.jobs() == ()
        assert len(store.set_aside) == 1
    with contextlib.closing(Store(tmp_path)) as store:  # it could not be moved, so it is found once more
        assert store.jobs() == ()
        assert len(store.set_aside) == 1


# Files of other versions, damaged ones and strangers


# As version 1 made it.
VERSION_1 = """
BEGIN; PRAGMA application_id = 1330857521; PRAGMA user_version = 1;
CREATE TABLE scenes (
    id TEXT PRIMARY KEY, seed INTEGER NOT NULL, created_at TEXT NOT NULL, image_size INTEGER NOT NULL,
    initial TEXT NOT NULL, state TEXT NOT NULL, time_s REAL NOT NULL, revision INTEGER NOT NULL,
    is_current INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (id TEXT PRIMARY KEY, number INTEGER NOT NULL, job TEXT NOT NULL);
CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL);
COMMIT;
"""


def version_of(path):
    with contextlib.closing(sqlite3.connect(path)) as database:
        return database.execute("PRAGMA user_version").fetchone()[0]


def test_a_file_of_the_first_version_is_migrated_and_a_copy_of_it_is_kept(tmp_path):
    state = json.dumps(state_to_json(record().state))
    with contextlib.closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.executescript(VERSION_1)
        values = ("a", 7, "2026", 128, state, state, 0.4, 3, 1)
        database.execute("INSERT INTO scenes VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", values)
        database.execute("""INSERT INTO jobs VALUES ('j', 4, '{"x": 1}')""")
        database.execute("""INSERT INTO events VALUES (9, '{"x": 1}')""")
    with contextlib.closing(Store(tmp_path)) as store:
        (scene,), current = store.scenes()
        assert (scene.id, scene.revision, current) == ("a", 3, "a")
        assert store.jobs() == ((4, {"x": 1}),)
        assert store.save_job("k", 5, {}) == 10
        assert store.set_aside == ()
    assert version_of(tmp_path / FILE) == SCHEMA_VERSION
    copy = tmp_path / f"{FILE}.format-1"
    assert version_of(copy) == 1
    with contextlib.closing(sqlite3.connect(copy)) as database:
        assert database.execute("SELECT id, number FROM jobs").fetchall() == [("j", 4)]
    Store(tmp_path).close()
    assert [path.name for path in tmp_path.glob(f"*{FILE}*")] in ([FILE, copy.name], [copy.name, FILE])


def test_a_migration_for_which_there_is_no_room_changes_nothing(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as database:
        database.executescript(VERSION_1)
    with full_disk(), pytest.raises(CannotStore):
        Store(tmp_path)
    assert version_of(tmp_path / FILE) == 1
    Store(tmp_path).close()


def put_aside(tmp_path, name, reason):
    """The store that starts with an empty database beside the one of this name, with the same content."""
    before = (tmp_path / FILE).read_bytes()
    check_data_dir(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before
    store = Store(tmp_path)
    (entry,) = store.set_aside
    assert (entry.kind, entry.id) == ("database", name)
    assert reason in entry.reason
    assert name in entry.sentence
    assert (tmp_path / name).read_bytes() == before
    assert (store.jobs(), store.scenes()) == ((), ((), None))
    store.save_job("new", 1, {})
    store.close()


def test_a_file_of_no_bytes_is_put_aside_with_its_log(tmp_path):
    (tmp_path / f"{FILE}-wal").write_bytes(b"what was written last")
    (tmp_path / FILE).write_bytes(b"")
    put_aside(tmp_path, f"{FILE}.empty", "it is empty")
    assert (tmp_path / f"{FILE}.empty-wal").read_bytes() == b"what was written last"


@pytest.mark.parametrize("folder", ["goals", "photos", "collections", "sets"])
def test_a_database_that_is_missing_where_a_service_has_worked_is_reported(tmp_path, folder):
    (tmp_path / folder / "a").mkdir(parents=True)
    with contextlib.closing(Store(tmp_path)) as store:
        (entry,) = store.set_aside
        assert (entry.kind, entry.id) == ("database", "")
        assert entry.reason in entry.sentence
    with contextlib.closing(Store(tmp_path)) as store:
        assert store.set_aside == ()


@pytest.mark.parametrize(
    "content", [b"not a database at all, but long enough" * 50, b"SQLite format 3\0" + b"\xff" * 4096]
)
def test_damaged_files_are_put_aside(tmp_path, content):
    for name in (f"{FILE}.damaged", f"{FILE}.damaged.2"):
        (tmp_path / FILE).write_bytes(content)
        put_aside(tmp_path, name, "damaged")


def test_damage_inside_is_found(tmp_path):
    store = Store(tmp_path)
    for number in range(200):
        store.save_job(str(number), number, {"x": "y" * 200})
    store.close()
    data = bytearray((tmp_path / FILE).read_bytes())
    data[3 * 4096 : 6 * 4096] = b"\xa5" * (3 * 4096)
    (tmp_path / FILE).write_bytes(data)
    put_aside(tmp_path, f"{FILE}.damaged", "damaged")


def test_a_file_that_lacks_a_table_is_put_aside(tmp_path):
    Store(tmp_path).close()
    change(tmp_path, ("DROP TABLE jobs",))
    put_aside(tmp_path, f"{FILE}.damaged", "damaged")


def test_a_file_of_a_newer_version_is_put_aside_and_can_come_back(tmp_path):
    with contextlib.closing(Store(tmp_path)) as store:
        store.save_job("a", 1, {"x": 1})
    change(tmp_path, (f"PRAGMA user_version = {SCHEMA_VERSION + 1}",))
    put_aside(tmp_path, f"{FILE}.newer-{SCHEMA_VERSION + 1}", "a newer version wrote it")
    (tmp_path / f"{FILE}.newer-{SCHEMA_VERSION + 1}").rename(tmp_path / FILE)
    change(tmp_path, (f"PRAGMA user_version = {SCHEMA_VERSION}",))
    with contextlib.closing(Store(tmp_path)) as store:
        assert store.jobs() == ((1, {"x": 1}),)


def test_what_was_only_in_the_log_of_a_damaged_file_is_put_aside_with_it(tmp_path):
    with contextlib.closing(Store(tmp_path)) as store:
        for number in range(200):
            store.save_job(f"old{number}", number, {"text": "y" * 1000})
    with writer(tmp_path) as process:
        accepted = []
        until(lambda: accepted.extend(told(process)) or len(accepted) > 20)
    data = (tmp_path / FILE).read_bytes()
    assert b"xxxx" not in data
    (tmp_path / FILE).write_bytes(data[:4096] + b"\xa5" * (len(data) - 4096))
    with contextlib.closing(Store(tmp_path)) as store:
        assert [entry.id for entry in store.set_aside] == [f"{FILE}.damaged"]
    assert any(b"xxxx" in path.read_bytes() for path in tmp_path.glob(f"{FILE}.damaged*"))


def test_the_database_of_another_program_is_refused_and_left(tmp_path):
    change(tmp_path, ("CREATE TABLE other (x)",))
    before = (tmp_path / FILE).read_bytes()
    for opened in (Store, check_data_dir):
        with pytest.raises(CorruptFile):
            opened(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


# What is there after a crash


WRITER = """
import sys
from pathlib import Path
from app.storage.database import Store
store = Store(Path(sys.argv[1]))
for number in range(1_000_000):
    store.save_job(f"j{number}", number, {"text": "x" * (number * 37 % 3000)})
    sys.stdout.write(f"{number}\\n")  # one write: the process may be stopped at any moment, and print makes two
    sys.stdout.flush()
"""


@contextlib.contextmanager
def writer(place):
    """A process that keeps jobs, and tells the number of each when it is accepted, until it is killed."""
    with subprocess.Popen([sys.executable, "-c", WRITER, str(place)], stdout=subprocess.PIPE, text=True) as process:
        try:
            os.set_blocking(process.stdout.fileno(), False)
            yield process
        finally:
            process.kill()


def told(process):
    """The numbers that have come since the last call."""
    text = ""
    with contextlib.suppress(BlockingIOError, TypeError):  # what it has not told yet
        while piece := process.stdout.read():
            text += piece
    return [int(line) for line in text.splitlines()]


def found(place):
    with contextlib.closing(sqlite3.connect(place / FILE)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    with contextlib.closing(Store(place)) as store:
        assert store.set_aside == ()
        return [number for number, _ in store.jobs()]


@pytest.mark.slow
def test_every_accepted_job_is_in_the_image_of_any_moment_and_after_a_kill(tmp_path):
    rng = random.Random(0)
    accepted = []
    with writer(tmp_path / "data") as process:
        until(lambda: accepted.extend(told(process)) or accepted)
        for moment in range(12):
            time.sleep(rng.uniform(0.01, 0.15))
            process.send_signal(signal.SIGSTOP)
            until(lambda: " T " in Path(f"/proc/{process.pid}/stat").read_text())
            image = tmp_path / f"image{moment}"
            image.mkdir()
            for suffix in ("", "-wal"):
                (image / f"{FILE}{suffix}").write_bytes((tmp_path / "data" / f"{FILE}{suffix}").read_bytes())
            accepted += told(process)
            process.send_signal(signal.SIGCONT)
            assert set(accepted) <= set(found(image))
    accepted += told(process) if not process.stdout.closed else []
    assert accepted
    assert set(accepted) <= set(found(tmp_path / "data"))


def test_a_log_that_was_cut_off_costs_no_more_than_its_end(tmp_path):
    with writer(tmp_path / "data") as process:
        accepted = []
        until(lambda: accepted.extend(told(process)) or len(accepted) > 50)
    log = (tmp_path / "data" / f"{FILE}-wal").read_bytes()
    before = (tmp_path / "data" / FILE).read_bytes()
    rng = random.Random(1)
    for cut in range(8):
        image = tmp_path / f"image{cut}"
        image.mkdir()
        (image / FILE).write_bytes(before)
        (image / f"{FILE}-wal").write_bytes(log[: rng.randrange(len(log) // 2, len(log))])
        numbers = found(image)
        assert numbers == list(range(len(numbers)))
        assert numbers
