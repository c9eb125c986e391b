import contextlib
import json
import os
import stat
import threading
import zipfile
from pathlib import Path

import pytest

from app.jobs.registry import Jobs
from app.storage.backup import FOLDERS, MANIFEST, back_up, restore
from app.storage.database import FILE, SCHEMA_VERSION, Store
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from tests.app.conftest import full_disk
from tests.app.jobs.test_registry import EPISODE
from tests.app.storage.test_database import change, record
from tests.support.errors import about


@pytest.fixture
def place(tmp_path):
    """A data directory with something everywhere."""
    place = tmp_path / "data"
    with contextlib.closing(Store(place)) as store:
        store.save_scene(record("a"))
        store.save_job("j", 1, {"id": "j", "kind": "episode", "params": EPISODE, "state": "running"})
    for name in (*FOLDERS, "downloads", "cache"):
        (place / name / "one" / "deep").mkdir(parents=True)
        (place / name / "one" / "deep" / "file").write_bytes(os.urandom(1000))
        (place / name / ".new-abc").mkdir()
        (place / name / ".new-abc" / "half").write_text("half-made")
        (place / name / "one" / ".part").write_text("half-made")
    (place / "service.log").write_text("log")
    return place


@pytest.fixture
def archive(place, tmp_path):
    back_up(place, tmp_path / "backup.zip")
    return tmp_path / "backup.zip"


def kept(place):
    """Contents of all files but the database's, by their paths."""
    files = (path for path in place.rglob("*") if path.is_file() and not path.name.startswith("service."))
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in files}


def left(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_is_worth_keeping_comes_back(place, archive, tmp_path):
    manifest = restore(archive, tmp_path / "again")
    expected = {name: data for name, data in kept(place).items() if name.startswith(FOLDERS) and "/." not in name}
    assert len(expected) == len(FOLDERS)
    assert kept(tmp_path / "again") == expected
    assert (manifest.files, manifest.schema_version) == (len(expected) + 1, SCHEMA_VERSION)
    assert left(tmp_path / "again") == sorted([FILE, *FOLDERS])
    assert left(tmp_path) == ["again", "backup.zip", "data"]
    with contextlib.closing(Store(tmp_path / "again")) as store:
        assert [scene.id for scene in store.scenes()[0]] == ["a"]
        jobs = Jobs(store, tmp_path / "again", lambda _: None)
        jobs.start()
        jobs.stop()
        assert jobs.get("j").state == "interrupted"


def test_the_manifest_tells_what_the_backup_holds(archive):
    with zipfile.ZipFile(archive) as file:
        told = json.loads(file.read(MANIFEST))
        others = [info for info in file.infolist() if info.filename != MANIFEST]
    assert (told["files"], told["bytes"]) == (len(others), sum(info.file_size for info in others))
    assert (told["program"], told["schema_version"]) == ("osf-manipulation", SCHEMA_VERSION)
    assert {"version", "created_at"} <= set(told)


def test_a_directory_without_a_database_can_be_backed_up(tmp_path):
    (tmp_path / "data" / "objects").mkdir(parents=True)
    (tmp_path / "data" / "objects" / "x").write_text("x")
    back_up(tmp_path / "data", tmp_path / "backup.zip")
    (tmp_path / "again").mkdir()
    assert restore(tmp_path / "backup.zip", tmp_path / "again").files == 1
    assert kept(tmp_path / "again") == {"objects/x": b"x"}


def test_a_backup_beside_a_service_that_writes_is_sound_and_holds_all_that_was_accepted_before(place, tmp_path):
    accepted, enough = [], threading.Event()

    def write(store):
        while not enough.is_set():
            number = len(accepted) + 2
            folder = place / "collections" / f"j{number}"
            folder.mkdir()
            (folder / "file").write_bytes(b"x" * 5000)
            store.save_job(f"j{number}", number, {"id": f"j{number}", "text": "x" * 2000})
            accepted.append(f"j{number}")
            (place / "collections" / f"j{max(number - 3, 2)}" / "file").unlink(missing_ok=True)

    with contextlib.closing(Store(place)) as store:
        thread = threading.Thread(target=write, args=(store,))
        thread.start()
        try:
            for number in range(5):
                before = list(accepted)
                back_up(place, tmp_path / f"{number}.zip")
                restore(tmp_path / f"{number}.zip", tmp_path / f"again{number}")
                with contextlib.closing(Store(tmp_path / f"again{number}")) as other:
                    assert {*before, "j"} <= {fields["id"] for _, fields in other.jobs()}
                    assert other.set_aside == ()
        finally:
            enough.set()
            thread.join()
    assert accepted


def test_a_file_that_vanishes_meanwhile_is_left_out(place, tmp_path, monkeypatch):
    is_file = Path.is_file

    def is_file_for_the_last_time(self):
        found = is_file(self)
        if self == place / "goals" / "one" / "deep" / "file":
            self.unlink()
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Path, "is_file", is_file_for_the_last_time)
        manifest = back_up(place, tmp_path / "backup.zip")
    assert manifest.files == len(FOLDERS)
    restore(tmp_path / "backup.zip", tmp_path / "again")
    assert "goals/one/deep/file" not in kept(tmp_path / "again")


def test_what_cannot_be_backed_up_is_told_and_an_older_backup_stays(place, archive, tmp_path):
    before = archive.read_bytes()
    with pytest.raises(InvalidInput, check=about("backup")):
        back_up(place, tmp_path / "backup.tar")
    for nothing in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(CorruptFile):
            back_up(nothing, archive)
    with full_disk(), pytest.raises(CannotWrite, check=about("backup.zip")):
        back_up(place, archive)
    change(place, ("DROP TABLE jobs",))
    with pytest.raises(CorruptFile):
        back_up(place, archive)
    assert archive.read_bytes() == before
    assert left(tmp_path) == ["backup.zip", "data"]


def test_nothing_is_restored_over_anything(place, archive, tmp_path):
    before = kept(place)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for target in (place, archive, tmp_path / "link"):
        with pytest.raises(InvalidInput, check=about("data directory")):
            restore(archive, target)
    assert kept(place) == before


def refused(archive, tmp_path, words):
    """That restoring is refused in these words, and leaves nothing."""
    others = left(tmp_path)
    with pytest.raises(CorruptFile, match=words):
        restore(archive, tmp_path / "again")
    assert left(tmp_path) == others


@pytest.mark.parametrize("at", [0.02, 0.5, 0.9])
def test_a_damaged_backup_is_refused_whole(archive, tmp_path, at):
    data = bytearray(archive.read_bytes())
    position = int(len(data) * at)
    data[position : position + 50] = bytes(byte ^ 0x5A for byte in data[position : position + 50])
    archive.write_bytes(data)
    refused(archive, tmp_path, "damaged|no backup")
    archive.write_bytes(data[: len(data) // 2])
    refused(archive, tmp_path, "no zip archive or a damaged one")
    archive.unlink()
    refused(archive, tmp_path, "there is no such file")


def rewritten(archive, **changes):
    """The archive again, with other contents under some names; None leaves one out."""
    with zipfile.ZipFile(archive) as file:
        contents = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(archive, "w") as file:
        for name, data in {**contents, **changes}.items():
            if data is not None:
                file.writestr(name, data)


def with_manifest(archive, **changes):
    with zipfile.ZipFile(archive) as file:
        told = json.loads(file.read(MANIFEST))
    rewritten(archive, **{MANIFEST: json.dumps({**told, **changes})})


def test_a_zip_of_another_kind_is_refused(archive, tmp_path):
    rewritten(archive, **{MANIFEST: None})
    refused(archive, tmp_path, "osf backup")
    rewritten(archive, **{MANIFEST: '{"name": "something else"}'})
    refused(archive, tmp_path, "no backup")
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("train/anno.json", "{}")
    refused(archive, tmp_path, "osf backup")


def test_a_backup_that_lacks_something_or_is_newer_is_refused(place, archive, tmp_path):
    rewritten(archive, **{"goals/one/deep/file": None})
    refused(archive, tmp_path, "it should hold")
    back_up(place, archive)
    with_manifest(archive, schema_version=SCHEMA_VERSION + 1)
    refused(archive, tmp_path, "newer version")
    back_up(place, archive)
    with zipfile.ZipFile(archive) as file:
        size = file.getinfo(FILE).file_size
    rewritten(archive, **{FILE: b"x" * size})
    refused(archive, tmp_path, "database in it is damaged")


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("../evil", stat.S_IFREG, "leads out"),
        ("/tmp/evil", stat.S_IFREG, "leads out"),
        ("objects/../../evil", stat.S_IFREG, "leads out"),
        ("C:\\evil", stat.S_IFREG, "leads out"),
        ("objects/link", stat.S_IFLNK, "link or device"),
    ],
)
def test_names_and_links_that_lead_elsewhere_are_refused(archive, tmp_path, name, kind, words):
    info = zipfile.ZipInfo(name)
    info.filename = name
    info.external_attr = (kind | 0o644) << 16
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(info, "/etc/passwd")
    refused(archive, tmp_path, words)
    assert not (tmp_path / "evil").exists()


def test_objects_that_are_links_come_along_and_links_in_a_circle_do_no_harm(tmp_path):
    elsewhere, data = tmp_path / "elsewhere" / "mug", tmp_path / "data"
    elsewhere.mkdir(parents=True)
    (elsewhere / "object.json").write_text("{}")
    (data / "objects").mkdir(parents=True)
    (data / "objects" / "mug").symlink_to(elsewhere)
    (elsewhere / "circle").symlink_to(data / "objects")
    back_up(data, tmp_path / "b.zip")
    restore(tmp_path / "b.zip", tmp_path / "back")
    assert (tmp_path / "back" / "objects" / "mug" / "object.json").read_text() == "{}"


@pytest.mark.parametrize("name", [b"x" * 210, b"a\tb", b"\xff", b"a\\b"])
def test_a_name_that_could_not_be_restored_is_told_at_once(tmp_path, name):
    folder = tmp_path / "data" / "collections" / "job"
    folder.mkdir(parents=True)
    (folder / os.fsdecode(name)).write_text("x")
    with pytest.raises(InvalidInput):
        back_up(tmp_path / "data", tmp_path / "b.zip")
    assert not (tmp_path / "b.zip").exists()


def test_what_describes_a_folder_comes_after_what_is_in_it(tmp_path):
    goal = tmp_path / "data" / "goals" / "a"
    goal.mkdir(parents=True)
    for name in ("goal.json", "goal.png"):
        (goal / name).write_text("x")
    back_up(tmp_path / "data", tmp_path / "b.zip")
    with zipfile.ZipFile(tmp_path / "b.zip") as archive:
        assert archive.namelist()[:2] == ["goals/a/goal.png", "goals/a/goal.json"]


def test_a_link_to_an_empty_folder_is_as_good_as_the_folder(archive, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    restore(archive, tmp_path / "link")
    assert (tmp_path / "link" / FILE).is_file()
