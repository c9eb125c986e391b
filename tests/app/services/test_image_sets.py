import asyncio
import dataclasses
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from starlette.requests import ClientDisconnect

from app.services.image_sets import Examined, ImageSets, TooManySets, examine
from app.storage.uploads import Examiner, UploadRefused
from osfcore.errors import CorruptFile, UnknownName
from osfcore.io.image_file import write_png
from tests.support.ellipsoid_sets import edit, write_set


def zipped(folder: Path) -> bytes:
    return Path(shutil.make_archive(str(folder), "zip", folder)).read_bytes()


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> bytes:
    """A sound set, zipped."""
    return zipped(write_set(tmp_path_factory.mktemp("set") / "mug"))


@pytest.fixture
def sets(tmp_path):
    sets = ImageSets(tmp_path / "sets", max_sets=2)
    sets.start()
    yield sets
    sets.stop()


def receive(sets, data: bytes, name: str = "mug.zip"):
    async def chunks():
        for start in range(0, len(data), 1000):
            yield data[start : start + 1000]

    return asyncio.run(sets.receive(chunks(), name))


def test_a_sound_set_is_kept_with_a_picture_of_how_it_was_understood(sets, archive, tmp_path):
    record = receive(sets, archive)
    assert (record.train, record.test, record.file_name) == (12, 4, "mug.zip")
    assert "12 train and 4 test images" in record.summary
    assert sets.all() == (record,) == (sets.get(record.id),)
    assert (sets.folder(record.id) / "train" / "anno.json").is_file()
    assert sets.overlay(record.id).read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in (tmp_path / "sets").iterdir()] == [record.id]
    sets.remove(record.id)
    assert list((tmp_path / "sets").iterdir()) == []
    with pytest.raises(UnknownName):
        sets.remove(record.id)


def broken(tmp_path: Path, damage) -> bytes:
    folder = write_set(tmp_path / "broken")
    damage(folder)
    return zipped(folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "train" / "r_3.png").unlink(), "r_3.png"),
        (lambda folder: (folder / "train" / "r_3.png").write_bytes(b"\x89PNG"), "r_3.png"),
        (lambda folder: (folder / "test" / "anno.json").write_text("[]"), "test/anno.json"),
        (lambda folder: (folder / "train" / "anno.json").unlink(), "no train/anno.json"),
        (lambda folder: edit(folder, lambda e: e.update(filename="\ud800.png")), "lacks or garbles filename"),
    ],
)
def test_an_unsound_set_is_refused_in_words_that_know_only_the_uploaders_names(sets, tmp_path, damage, words):
    with pytest.raises(UploadRefused) as refusal:
        receive(sets, broken(tmp_path, damage))
    assert words in str(refusal.value)
    assert str(tmp_path) not in str(refusal.value)
    assert list((tmp_path / "sets").iterdir()) == []


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 no zip", b"x" * 3_000_000])
def test_what_is_no_zip_is_refused(sets, tmp_path, data):
    with pytest.raises(UploadRefused):
        receive(sets, data)
    assert list((tmp_path / "sets").iterdir()) == []


@pytest.mark.slow
def test_a_zip_that_leads_elsewhere_writes_nothing_there(sets, tmp_path):
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as file:
        file.writestr("train/anno.json", "[]")
        file.writestr("../../evil.txt", "x")
    with pytest.raises(UploadRefused, match="leads out"):
        receive(sets, (tmp_path / "evil.zip").read_bytes())
    assert not any(tmp_path.rglob("evil.txt"))


@pytest.mark.slow
def test_a_zip_bomb_is_refused(sets, tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("train/anno.json", b"0" * 50_000_000)
    with pytest.raises(UploadRefused, match="which no images do"):
        receive(sets, (tmp_path / "bomb.zip").read_bytes())


def test_images_of_the_table_are_told_apart(tmp_path):
    from osfcore.world.collect_images import CollectTable, collect_table

    for _ in collect_table(CollectTable(tmp_path / "table", images=60, size=16)):
        pass
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "set.zip").write_bytes(zipped(tmp_path / "table"))
    with pytest.raises(CorruptFile):
        examine(tmp_path / "new")


@pytest.mark.slow
def test_there_is_an_end_to_what_is_kept(sets, archive):
    receive(sets, archive)
    receive(sets, archive)
    with pytest.raises(TooManySets):
        receive(sets, archive)


def test_uploads_at_the_same_time_do_not_overrun_the_limit(sets, archive, tmp_path, monkeypatch):
    async def examine_at_once(_examiner, folder):
        (folder / "set.zip").unlink()
        write_png(folder / "overlay.png", np.zeros((4, 4, 3), np.uint8))
        return Examined(1, 1, "a set")

    monkeypatch.setattr(Examiner, "examine", examine_at_once)

    async def chunks():
        yield archive
        await asyncio.sleep(0.2)  # all have begun before the first is kept

    async def together():
        uploads = [sets.receive(chunks(), f"{i}.zip") for i in range(5)]
        return await asyncio.gather(*uploads, return_exceptions=True)

    outcomes = asyncio.run(together())
    assert sum(isinstance(outcome, TooManySets) for outcome in outcomes) == 3
    assert len(sets.all()) == len(list((tmp_path / "sets").iterdir())) == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"train": "many"},
        {"train": True},
        {"test": -1},
        {"test": 10**30},
        {"created_at": 5},
        {"summary": None},
        {"summary": "\ud800"},
        {"file_name": ["a"]},
        {"id": "other"},
        {"id": ["a"]},
    ],
)
def test_a_set_whose_facts_are_damaged_does_not_hide_the_others(sets, archive, tmp_path, change):
    record = receive(sets, archive, "")
    for name, facts in (("odd", {**dataclasses.asdict(record), "id": "odd", **change}), ("deep", None)):
        folder = tmp_path / "sets" / name
        folder.mkdir()
        (folder / "set.json").write_text('{"a":' * 100_000 if facts is None else json.dumps(facts))
    assert sets.all() == (record,)
    assert {damaged.id for damaged in sets.damaged()} == {"odd", "deep"}
    with pytest.raises(CorruptFile):
        sets.get("odd")
    sets.remove("odd")
    assert {damaged.id for damaged in sets.damaged()} == {"deep"}


def test_an_upload_that_breaks_off_leaves_nothing(sets, archive, tmp_path):
    async def broken_off():
        yield archive[:1000]
        raise ClientDisconnect

    with pytest.raises(ClientDisconnect):
        asyncio.run(sets.receive(broken_off(), "mug.zip"))
    assert list((tmp_path / "sets").iterdir()) == []


@pytest.mark.slow
def test_what_a_killed_service_left_half_done_goes_at_the_next_start(tmp_path, archive):
    sets = ImageSets(tmp_path / "sets")
    record = receive(sets, archive)
    (tmp_path / "sets" / ".new-abc").mkdir()
    (tmp_path / "sets" / "damaged").mkdir()
    (tmp_path / "sets" / "damaged" / "set.json").write_text("{")
    again = ImageSets(tmp_path / "sets")
    again.start()
    assert not (tmp_path / "sets" / ".new-abc").exists()
    assert again.all() == (record,)
