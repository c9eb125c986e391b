import contextlib
import shutil
import stat
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import osfcore.io.archives as module
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.io.archives import unpack_observation, unpack_set
from osfcore.io.image_set import read_splits


def packed(folder, path, below="", compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as file:
        for source in sorted(folder.rglob("*")):
            if source.is_file():
                file.write(source, f"{below}{source.relative_to(folder).as_posix()}")
    return path


@pytest.fixture
def archive(pristine_set, tmp_path):
    return packed(pristine_set, tmp_path / "set.zip")


def add(archive, name, data=b"x", kind=stat.S_IFREG):
    info = zipfile.ZipInfo(name)
    info.filename = name  # as an attacker writes it, without what Python makes of it
    info.compress_type = zipfile.ZIP_DEFLATED
    info.external_attr = (kind | 0o644) << 16
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(info, data)


def left_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("below", ["", "my set/", "a/b/"])
def test_a_zipped_set_is_unpacked_wherever_it_lies_inside(pristine_set, tmp_path, below):
    archive = packed(pristine_set, tmp_path / "set.zip", below)
    add(archive, "__MACOSX/train/._anno.json")
    add(archive, f"{below}README.txt")
    out = unpack_set(archive, tmp_path / "deep" / "out")
    assert out == tmp_path / "deep" / "out"
    assert left_in(out) == ["test", "train"]
    assert left_in(out.parent) == ["out"]
    assert stat.S_IMODE(out.stat().st_mode) == 0o755
    for mine, its in zip(read_splits(out), read_splits(pristine_set), strict=True):
        np.testing.assert_array_equal(mine.rgba, its.rgba)


def test_backslashes_of_windows_tools_are_folders(pristine_set, tmp_path):
    archive = tmp_path / "set.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for source in pristine_set.rglob("*.*"):
            info = zipfile.ZipInfo("x")
            info.filename = str(source.relative_to(pristine_set)).replace("/", "\\")
            file.writestr(info, source.read_bytes())
    read_splits(unpack_set(archive, tmp_path / "out"))


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("../evil.png", stat.S_IFREG, "'../evil.png', a name that leads out"),
        ("train/../../evil.png", stat.S_IFREG, "leads out"),
        ("train\\..\\..\\evil.png", stat.S_IFREG, "leads out"),
        ("/tmp/evil.png", stat.S_IFREG, "leads out"),
        ("C:\\evil.png", stat.S_IFREG, "leads out"),
        ("train/link.png", stat.S_IFLNK, "'train/link.png', a link or device"),
        ("train/pipe", stat.S_IFIFO, "a link or device"),
        ("train/" + "x" * 300, stat.S_IFREG, "too long"),
        ("a/" * 20 + "b", stat.S_IFREG, "too deep"),
        ("train/\x1b[2J.png", stat.S_IFREG, "not printable"),
        ("train", stat.S_IFREG, "a file and a folder of the same name"),
        ("train/anno.json", stat.S_IFREG, "'train/anno.json' twice"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_tricks_are_refused_before_anything_is_written(archive, tmp_path, name, kind, words):
    add(archive, name, b"/etc/passwd", kind)
    with pytest.raises(CorruptFile, match=words):
        unpack_set(archive, tmp_path / "out")
    assert left_in(tmp_path) == ["set.zip"]


def test_bombs_are_refused(archive, tmp_path):
    with pytest.raises(CorruptFile, match="at most 0 MB are unpacked"):
        unpack_set(archive, tmp_path / "out", max_bytes=1000)
    with pytest.raises(CorruptFile, match=r"it holds \d+ files; at most 5"):
        unpack_set(archive, tmp_path / "out", max_files=5)
    add(archive, "train/zeros.png", bytes(30_000_000))
    with pytest.raises(CorruptFile, match="unpack to 30 MB, more than 100 times its size"):
        unpack_set(archive, tmp_path / "out")
    assert left_in(tmp_path) == ["set.zip"]


def test_archives_that_lie_about_their_sizes_are_refused(archive, tmp_path):
    add(archive, "train/big.png", bytes(5000))
    data = archive.read_bytes()
    true, false = (5000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    assert data.count(true) == 2  # once before the file, once in the directory at the end
    archive.write_bytes(data.replace(true, false))
    with pytest.raises(CorruptFile):
        unpack_set(archive, tmp_path / "out")
    assert left_in(tmp_path) == ["set.zip"]


def test_truncated_and_damaged_archives_are_refused_and_leave_nothing(archive, tmp_path):
    sound = archive.read_bytes()
    for share in (0, 0.3, 0.7, 0.99):
        archive.write_bytes(sound[: int(share * len(sound))])
        with pytest.raises(CorruptFile, match="no zip archive or a damaged one"):
            unpack_set(archive, tmp_path / "out")
    rng = np.random.default_rng(0)
    told = 0
    for _ in range(100):
        data = bytearray(sound)
        for place in rng.integers(0, len(data), 20):
            data[place] = rng.integers(256)
        archive.write_bytes(data)
        try:
            shutil.rmtree(unpack_set(archive, tmp_path / "out"))
        except CorruptFile:
            told += 1
        assert left_in(tmp_path) == ["set.zip"]
    assert told > 50


def test_locked_archives_are_told(archive, tmp_path):
    data = bytearray(archive.read_bytes())
    place = data.find(b"PK\x01\x02")
    data[place + 8] |= 1
    archive.write_bytes(data)
    with pytest.raises(CorruptFile, match="locked with a password"):
        unpack_set(archive, tmp_path / "out")


def test_archives_without_a_set_or_with_two_are_told(pristine_set, tmp_path):
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as file:
        file.writestr("photo.png", b"x")
    with pytest.raises(CorruptFile, match="holds no train/anno.json"):
        unpack_set(tmp_path / "empty.zip", tmp_path / "out")
    two = packed(pristine_set, tmp_path / "two.zip", "a/")
    add(two, "b/train/anno.json")
    with pytest.raises(CorruptFile, match="several image sets, a and b"):
        unpack_set(two, tmp_path / "out")
    (tmp_path / "notes.zip").write_text("hello")
    with pytest.raises(CorruptFile, match="no zip archive"):
        unpack_set(tmp_path / "notes.zip", tmp_path / "out")
    with pytest.raises(CorruptFile, match="there is no such file"):
        unpack_set(tmp_path / "gone.zip", tmp_path / "out")


def test_nothing_is_overwritten(archive, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    unpack_set(archive, out)  # an empty folder may be there
    with pytest.raises(InvalidInput, match="new or empty"):
        unpack_set(archive, out)


def test_a_full_disk_is_told_and_leaves_nothing(archive, tmp_path, monkeypatch):
    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.Path, "replace", full)
    with pytest.raises(CannotWrite, match="No space left"):
        unpack_set(archive, tmp_path / "out")
    assert left_in(tmp_path) == ["set.zip"]


@pytest.mark.parametrize("below", ["", "seen/"])
def test_a_zipped_observation_is_unpacked_with_all_that_lies_beside_it(tmp_path, below):
    with zipfile.ZipFile(tmp_path / "seen.zip", "w") as file:
        for name in ("observation.json", "images/0.png", "prior.json"):
            file.writestr(below + name, name)
        file.writestr("__MACOSX/._seen", "x")
    out = unpack_observation(tmp_path / "seen.zip", tmp_path / "out")
    assert (out / "images" / "0.png").read_text() == "images/0.png"
    assert (out / "observation.json").read_text() == "observation.json"
    with pytest.raises(CorruptFile, match="holds no train/anno.json"):
        unpack_set(tmp_path / "seen.zip", tmp_path / "set")


def test_an_archive_without_an_observation_is_told(archive, tmp_path):
    with pytest.raises(CorruptFile, match=r"holds no observation.json; a zipped observation folder"):
        unpack_observation(archive, tmp_path / "out")
    add(archive, "../observation.json")
    with pytest.raises(CorruptFile, match="leads out"):
        unpack_observation(archive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def many(path, count, comment=b"", before=b""):
    """An archive whose list names `count` files, of which it holds none."""
    entries = b"".join(
        struct.pack("<4s24xHHH12x", b"PK\1\2", len(name), 0, 0) + name
        for name in (f"train/{number}.png".encode() for number in range(count))
    )
    end = struct.pack("<4s4xHHLLH", b"PK\5\6", count % 65536, count % 65536, len(entries), len(before), len(comment))
    path.write_bytes(before + entries + end + comment)
    return path


def large_form(archive, size=None, told=None, comment=b""):
    """The same archive with the records for large archives, and an end record that says nothing."""
    data = archive.read_bytes()
    body, end = data[:-22], data[-22:]
    size = struct.unpack_from("<12xL", end)[0] if size is None else size
    record = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, size, max(len(body) - size, 0))
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(body) if told is None else told, 1)
    nothing = struct.pack("<4s4xHHLLH", b"PK\5\6", 1, 1, 0, 0, len(comment))
    archive.write_bytes(body + record + locator + nothing + comment)
    return archive


@pytest.fixture
def unparsed(monkeypatch):
    """Fails a test in which a list of files is parsed."""
    monkeypatch.setattr(zipfile, "ZipFile", lambda *_: pytest.fail("the list was parsed"))


@pytest.mark.usefixtures("unparsed")
def test_files_are_counted_before_their_list_is_parsed(tmp_path):
    path = tmp_path / "many.zip"
    forms = (
        lambda: many(path, 31),
        lambda: many(path, 31, comment=b"made by a tool" * 1000),
        lambda: many(path, 31, before=b"#!/bin/sh\n" * 1000),
        lambda: many(path, 31 + 65536),  # the end record says 31
        lambda: large_form(many(path, 31)),
        lambda: large_form(many(path, 31, before=b"x" * 50), comment=b"by a tool"),
    )
    for form in forms:
        form()
        with pytest.raises(CorruptFile, match=r"many.zip cannot be used: it(s list)? (holds|of files has) \d+"):
            unpack_set(path, tmp_path / "out", max_files=30)


@pytest.mark.usefixtures("unparsed")
def test_a_list_that_is_large_for_what_it_may_hold_is_refused(tmp_path):
    names = b"".join(struct.pack("<4s24xHHH12x", b"PK\1\2", 1, 40_000, 0) + b"x" + bytes(40_000) for _ in range(20))
    (tmp_path / "fat.zip").write_bytes(names + struct.pack("<4s4xHHLLH", b"PK\5\6", 20, 20, len(names), 0, 0))
    with pytest.raises(CorruptFile, match="its list of files has 800940 bytes; at most 65536 are read"):
        unpack_set(tmp_path / "fat.zip", tmp_path / "out", max_files=30)


def test_records_of_large_archives_are_understood_or_refused(archive, tmp_path):
    sound = archive.read_bytes()
    shutil.rmtree(unpack_set(large_form(archive), tmp_path / "out"))
    archive.write_bytes(sound)
    unpack_set(large_form(archive, comment=b"by a tool"), tmp_path / "out")
    archive.write_bytes(sound)
    with pytest.raises(CorruptFile, match="damaged"):
        unpack_set(large_form(archive, size=2**63), tmp_path / "set")
    archive.write_bytes(b"PK\6\6" + sound)
    with pytest.raises(CorruptFile, match="two lists of its files"):
        unpack_set(large_form(archive, told=0), tmp_path / "set")


@given(data=st.data())
def test_no_damage_to_an_archive_brings_another_error(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    path = folder / "few.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("train/anno.json", "{}")
        file.writestr("test/0.png", b"\0" * 300)
    if data.draw(st.booleans(), "large form"):
        large_form(path)
    sound = path.read_bytes()
    tail = len(sound) - sound.index(b"PK\1\2")
    damaged = bytearray(sound)
    for place in data.draw(st.lists(st.integers(-tail, -1), min_size=1, max_size=8), "places"):
        damaged[place] = data.draw(st.sampled_from([0, 1, 2, 0x4B, 0x50, 0x7F, 0x80, 0xFF]) | st.integers(0, 255))
    path.write_bytes(bytes(damaged) + data.draw(st.sampled_from([b"", b"x", b"PK\5\6", sound[-22:]]), "more"))
    with contextlib.suppress(CorruptFile):
        unpack_set(path, folder / "out", max_files=2)
