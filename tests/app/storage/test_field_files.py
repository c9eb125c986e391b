from pathlib import Path

import pytest

from app.storage.field_files import (
    clear_workshop,
    install,
    open_workshop,
    remove_workshop,
    sweep,
    uninstall,
    workshop,
    workshops,
)
from osfcore.errors import CannotWrite
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE
from tests.support.errors import about


@pytest.fixture
def made(tmp_path):
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / FIELD_FILE).write_bytes(b"weights")
    (folder / METRICS_FILE).write_text("{}")
    (folder / "field.partial").write_bytes(b"not wanted")
    return folder


def test_what_a_kill_left_of_a_removed_workshop_goes_at_the_next_start(tmp_path):
    (open_workshop(tmp_path, "a", {}) / "checkpoint").write_bytes(b"12345")
    (tmp_path / "training" / ".b.0123").mkdir()
    (left,) = workshops(tmp_path)
    assert (left.name, left.bytes) == ("a", 5 + len("{}"))
    sweep(tmp_path / "training")
    assert [path.name for path in (tmp_path / "training").iterdir()] == ["a"]
    remove_workshop(tmp_path, "a")
    assert list((tmp_path / "training").iterdir()) == []
    with pytest.raises(CannotWrite, check=about("training/a")):
        remove_workshop(tmp_path, "a")


def test_the_same_order_finds_what_it_left_and_another_does_not(tmp_path):
    shop = open_workshop(tmp_path, "mug", {"minutes": 1, "seed": 0})
    (shop / "field.partial").write_bytes(b"x")
    assert (open_workshop(tmp_path, "mug", {"seed": 0, "minutes": 1}) / "field.partial").exists()
    assert not (open_workshop(tmp_path, "mug", {"seed": 1, "minutes": 1}) / "field.partial").exists()
    clear_workshop(tmp_path, "mug")
    clear_workshop(tmp_path, "mug")
    assert not workshop(tmp_path, "mug").exists()


def test_an_order_that_cannot_be_read_counts_as_another_one(tmp_path):
    shop = open_workshop(tmp_path, "mug", {"seed": 0})
    (shop / "field.partial").write_bytes(b"x")
    (shop / "order.json").write_bytes(b"\xff\xfe")
    assert not (open_workshop(tmp_path, "mug", {"seed": 0}) / "field.partial").exists()
    (shop / "field.partial").write_bytes(b"x")
    assert (open_workshop(tmp_path, "mug", {"seed": 0}) / "field.partial").exists()


def test_a_field_takes_its_place_and_the_older_ones_in_one_piece(tmp_path, made):
    place = tmp_path / "fields" / "mug"
    install(made, place)
    assert {path.name for path in place.iterdir()} == {FIELD_FILE, METRICS_FILE}
    (made / FIELD_FILE).write_bytes(b"better")
    install(made, place)
    assert (place / FIELD_FILE).read_bytes() == b"better"
    assert [path.name for path in place.parent.iterdir()] == ["mug"]
    assert place.stat().st_mode & 0o777 == 0o755


def test_half_a_field_changes_nothing(tmp_path, made):
    place = tmp_path / "fields" / "mug"
    install(made, place)
    (made / METRICS_FILE).unlink()
    (made / FIELD_FILE).write_bytes(b"half")
    with pytest.raises(CannotWrite, check=about("mug")):
        install(made, place)
    assert (place / FIELD_FILE).read_bytes() == b"weights"
    assert [path.name for path in place.parent.iterdir()] == ["mug"]


def test_deleting_leaves_nothing(tmp_path, made):
    place = tmp_path / "fields" / "mug"
    install(made, place)
    uninstall(place)
    assert list(place.parent.iterdir()) == []
    with pytest.raises(CannotWrite):
        uninstall(place)


def test_a_field_that_cannot_take_its_place_leaves_the_older_one(tmp_path, made, monkeypatch):
    place = tmp_path / "fields" / "mug"
    install(made, place)
    (made / FIELD_FILE).write_bytes(b"better")
    rename = Path.rename

    def fails(self, target):
        assert place.is_dir() or self.name == "new" or self.parent.name.startswith(".replaced-")
        if self.name == "new":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(CannotWrite):
        install(made, place)
    assert (place / FIELD_FILE).read_bytes() == b"weights"
    assert [path.name for path in place.parent.iterdir()] == ["mug"]


class Killed(BaseException):
    pass


@pytest.mark.parametrize("moment", ["before", "between", "after"])
def test_a_kill_while_a_field_is_replaced_costs_no_field(tmp_path, made, monkeypatch, moment):
    """As the file system would be left: nothing is tidied up after the kill."""
    place = tmp_path / "fields" / "mug"
    install(made, place)
    (made / FIELD_FILE).write_bytes(b"better")
    rename = Path.rename

    def killed(self, target):
        if moment == "before" or (moment == "between" and self.name == "new"):
            raise Killed
        rename(self, target)
        if moment == "after" and self.name == "new":
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        patch.setattr("shutil.rmtree", lambda *_args, **_more: None)
        with pytest.raises(Killed):
            install(made, place)
    sweep(place.parent)
    assert (place / FIELD_FILE).read_bytes() == (b"better" if moment == "after" else b"weights")
    assert [path.name for path in place.parent.iterdir()] == ["mug"]
    sweep(tmp_path / "nowhere")


def test_a_field_whose_deletion_was_interrupted_does_not_return(tmp_path, made, monkeypatch):
    place = tmp_path / "fields" / "mug"
    install(made, place)
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", lambda *_args, **_more: None)
        uninstall(place)
    sweep(place.parent)
    assert list(place.parent.iterdir()) == []
