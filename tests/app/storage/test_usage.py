import os
import threading

import pytest

from app.storage.database import CannotStore
from app.storage.usage import StorageFull, StorageMeter, folder_bytes

GIB = 1 << 30


@pytest.fixture
def open_meter(tmp_path):
    opened = []

    def open_meter(**limits):
        opened.append(StorageMeter(tmp_path, **limits))
        return opened[-1]

    yield open_meter
    for meter in opened:
        meter.stop()
        meter.stop()


def write(path, count):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x" * count)


def test_files_are_counted_by_kind_and_links_are_not_followed(open_meter, tmp_path):
    write(tmp_path / "collections" / "a" / "inputs" / "x", 100)
    write(tmp_path / "collections" / "b" / "y", 20)
    write(tmp_path / "goals" / "g" / "goal.png", 3)
    write(tmp_path / "service.sqlite3", 7)
    write(tmp_path / "logs" / "service.log", 40)
    os.symlink("/usr", tmp_path / "objects")
    usage = open_meter().usage()
    assert {kind: count for kind, count in usage.bytes.items() if count} == {
        "jobs": 120, "goals": 3, "other": 47 + len("/usr")
    }  # fmt: skip
    assert usage.total == 170 + len("/usr")


def test_figures_are_kept_for_a_while_but_for_what_is_known_to_be_outdated(open_meter, tmp_path):
    meter = open_meter()
    assert meter.usage().total == 0
    write(tmp_path / "x", 5)
    assert meter.usage().total == 0
    meter.outdate()
    assert meter.usage().total == 5


def test_more_than_is_allowed_is_refused_until_something_is_deleted(open_meter, tmp_path):
    write(tmp_path / "collections" / "a" / "x", 2048)
    write(tmp_path / "goals" / "g" / "goal.png", 100)
    meter = open_meter(max_bytes=1024)
    with pytest.raises(StorageFull, match="finished jobs"):
        meter.check_room()
    (tmp_path / "collections" / "a" / "x").unlink()
    meter.outdate()
    meter.check_room()


def test_no_limit_refuses_nothing(open_meter, tmp_path):
    write(tmp_path / "x", 2048)
    open_meter().check_room()


def test_a_disk_that_is_almost_full_is_told(open_meter):
    meter = open_meter(min_free_bytes=1 << 62)
    with pytest.raises(StorageFull):
        meter.check_room()
    assert meter.free_bytes > 0


def test_a_stopped_meter_tells_what_it_knew_and_measures_no_more(open_meter, tmp_path):
    meter = open_meter()
    assert meter.usage().total == 0
    write(tmp_path / "x", 5)
    meter.stop()
    meter.outdate()
    assert meter.usage().total == 0


@pytest.mark.slow
def test_nobody_waits_for_a_walk_that_takes_long(open_meter, tmp_path, monkeypatch):
    let = threading.Event()
    monkeypatch.setattr("app.storage.usage.folder_bytes", lambda *_: let.wait(20) and 9)
    (tmp_path / "goals").mkdir()
    meter = open_meter(max_bytes=1)
    assert meter.usage(wait_s=0.01) is None
    meter.check_room()  # nothing is known yet
    let.set()
    assert meter.usage(wait_s=20).bytes["goals"] == 9


def test_a_walk_that_is_to_end_ends(tmp_path):
    write(tmp_path / "x", 5)
    stop = threading.Event()
    assert folder_bytes(tmp_path, stop) == 5
    stop.set()
    assert folder_bytes(tmp_path, stop) == 0
    assert folder_bytes(tmp_path / "nowhere") == 0


def test_nothing_more_is_taken_in_once_the_data_directory_is_another_one(tmp_path):
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    meter = StorageMeter(data_dir)
    meter.check_room()
    data_dir.rename(tmp_path / "elsewhere")
    for _ in range(2):  # it is gone, and then a new one has its name
        with pytest.raises(CannotStore):
            meter.check_room()
        assert meter.problem is not None
        data_dir.mkdir(exist_ok=True)
    data_dir.rmdir()
    (tmp_path / "elsewhere").rename(data_dir)
    meter.check_room()
    assert meter.problem is None
    meter.stop()
