import contextlib
import shutil
import stat
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.io.archives import unpack_observation, unpack_set
from tests.support.errors import about


def packed(folder, path, below=""):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
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


@pytest.mark.parametrize(("name", "encoding"), [("m\u00e4t", "utf-8"), ("ma\u0308t", "utf-8"), ("m\u00e4t", "cp437")])
def test_names_are_read_without_the_flag_of_utf_8(tmp_path, name, encoding):
    path, coded = tmp_path / "set.zip", name.encode(encoding)
    add(path, "train/anno.json")
    add(path, "train/" + "?" * len(coded))
    path.write_bytes(path.read_bytes().replace(b"?" * len(coded), coded))
    assert left_in(unpack_set(path, tmp_path / "out") / "train") == ["anno.json", name]


def left_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("below", ["", "a/b/"])
def test_a_zipped_set_is_unpacked_wherever_it_lies_inside(pristine_set, tmp_path, below):
    archive = packed(pristine_set, tmp_path / "set.zip", below)
    add(archive, "__MACOSX/train/._anno.json")
    add(archive, f"{below}README.txt")
    out = unpack_set(archive, tmp_path / "deep" / "out")
    assert out == tmp_path / "deep" / "out"
    assert left_in(out) == ["test", "train"]
    assert left_in(out.parent) == ["out"]
    assert stat.S_IMODE(out.stat().st_mode) == 0o755
    assert (out / "test/anno.json").read_bytes() == (pristine_set / "test/anno.json").read_bytes()
    assert left_in(out / "train") == left_in(pristine_set / "train")


def test_backslashes_of_windows_tools_are_folders(tmp_path):
    for name in ("train\\anno.json", "test\\anno.json"):
        add(tmp_path / "set.zip", name)
    assert left_in(unpack_set(tmp_path / "set.zip", tmp_path / "out")) == ["test", "train"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *[(name, stat.S_IFREG) for name in ("../evil.png", "train/../../evil.png", "train\\..\\..\\evil.png")],
        *[(name, stat.S_IFREG) for name in ("/tmp/evil.png", "C:\\evil.png", "train/\x1b[2J.png")],
        *[("train/link.png", stat.S_IFLNK), ("train/pipe", stat.S_IFIFO)],
        *[(name, stat.S_IFREG) for name in ("train/" + "x" * 300, "a/" * 20 + "b")],
        *[(name, stat.S_IFREG) for name in ("train", "train/anno.json")],  # those are there already
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_tricks_are_refused_before_anything_is_written(archive, tmp_path, name, kind):
    add(archive, name, b"/etc/passwd", kind)
    with pytest.raises(CorruptFile):
        unpack_set(archive, tmp_path / "out")
    assert left_in(tmp_path) == ["set.zip"]


def test_bombs_and_archives_that_lie_about_their_sizes_are_refused(archive, tmp_path):
    for limit in ({"max_bytes": 1000}, {"max_files": 5}):
        with pytest.raises(CorruptFile):
            unpack_set(archive, tmp_path / "out", **limit)
    sound = archive.read_bytes()
    add(archive, "train/zeros.png", bytes(30_000_000))
    with pytest.raises(CorruptFile, check=about("30 MB")):
        unpack_set(archive, tmp_path / "out")
    archive.write_bytes(sound)
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
    for share in (0, 0.3, 0.99):
        archive.write_bytes(sound[: int(share * len(sound))])
        with pytest.raises(CorruptFile):
            unpack_set(archive, tmp_path / "out")
    rng = np.random.default_rng(0)
    for _ in range(20):
        data = bytearray(sound)
        for place in rng.integers(0, len(data), 20):
            data[place] = rng.integers(256)
        archive.write_bytes(data)
        with contextlib.suppress(CorruptFile):
            shutil.rmtree(unpack_set(archive, tmp_path / "out"))
        assert left_in(tmp_path) == ["set.zip"]
    data = bytearray(sound)
    data[data.find(b"PK\x01\x02") + 8] |= 1  # locked with a password
    archive.write_bytes(data)
    with pytest.raises(CorruptFile, check=about("password")):
        unpack_set(archive, tmp_path / "out")


def test_archives_without_a_set_or_with_two_are_refused(archive, tmp_path):
    two = shutil.copy(archive, tmp_path / "two.zip")
    for name in ("a/train/anno.json", "b/train/anno.json"):
        add(tmp_path / "several.zip", name)
    add(tmp_path / "none.zip", "photo.png")
    (tmp_path / "notes.zip").write_text("hello")
    for name in ("several", "none", "notes", "gone"):
        with pytest.raises(CorruptFile, check=about(f"{name}.zip")):
            unpack_set(tmp_path / f"{name}.zip", tmp_path / "out")
    add(tmp_path / "nerf.zip", "scene/transforms_train.json")
    with pytest.raises(CorruptFile, check=about("nerfstudio")):
        unpack_set(tmp_path / "nerf.zip", tmp_path / "out")
    add(two, "deeper/train/anno.json")  # the one nearer the top counts
    unpack_set(two, tmp_path / "out")
    with pytest.raises(InvalidInput):
        unpack_set(archive, tmp_path / "out")  # nothing is overwritten


@pytest.mark.parametrize("below", ["", "seen/"])
def test_a_zipped_observation_is_unpacked_with_all_that_lies_beside_it(tmp_path, below):
    archive = tmp_path / "seen.zip"
    for name in ("observation.json", "images/0.png", "prior.json"):
        add(archive, below + name, name.encode())
    add(archive, "__MACOSX/._seen")
    out = unpack_observation(archive, tmp_path / "out")
    assert (out / "images" / "0.png").read_text() == "images/0.png"
    assert {"images", "observation.json", "prior.json"} <= set(left_in(out))
    with pytest.raises(CorruptFile):
        unpack_set(archive, tmp_path / "set")


def many(path, count, comment=b"", before=b"", extra=0):
    """An archive whose list names `count` files, of which it holds none."""
    entries = b"".join(
        struct.pack("<4s24xHHH12x", b"PK\1\2", len(name), extra, 0) + name + bytes(extra)
        for name in (f"train/{number}.png".encode() for number in range(count))
    )
    end = struct.pack("<4s4xHHLLH", b"PK\5\6", count % 65536, count % 65536, len(entries), len(before), len(comment))
    path.write_bytes(before + entries + end + comment)
    return path


def large_form(archive, size=None, claimed=None, comment=b""):
    """The same archive with the records for large archives, and an end record that says nothing."""
    data = archive.read_bytes()
    body, end = data[:-22], data[-22:]
    size = struct.unpack_from("<12xL", end)[0] if size is None else size
    record = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, size, max(len(body) - size, 0))
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(body) if claimed is None else claimed, 1)
    nothing = struct.pack("<4s4xHHLLH", b"PK\5\6", 1, 1, 0, 0, len(comment))
    archive.write_bytes(body + record + locator + nothing + comment)
    return archive


def test_files_are_counted_before_their_list_is_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile, "ZipFile", lambda *_: pytest.fail("the list was parsed"))
    path = tmp_path / "many.zip"
    forms = (
        lambda: many(path, 31),
        lambda: many(path, 31, comment=b"made by a tool" * 1000),
        lambda: many(path, 31, before=b"#!/bin/sh\n" * 1000),
        lambda: many(path, 31 + 65536),  # the end record says 31
        lambda: many(path, 20, extra=40_000),  # a list that is large for what it may hold
        lambda: large_form(many(path, 31)),
        lambda: large_form(many(path, 31, before=b"x" * 50), comment=b"by a tool"),
    )
    for form in forms:
        form()
        with pytest.raises(CorruptFile):
            unpack_set(path, tmp_path / "out", max_files=30)


def test_records_of_large_archives_are_understood_or_refused(archive, tmp_path):
    sound = archive.read_bytes()
    shutil.rmtree(unpack_set(large_form(archive), tmp_path / "out"))
    archive.write_bytes(sound)
    unpack_set(large_form(archive, comment=b"by a tool"), tmp_path / "out")
    archive.write_bytes(sound)
    with pytest.raises(CorruptFile):
        unpack_set(large_form(archive, size=2**63), tmp_path / "set")
    archive.write_bytes(b"PK\6\6" + sound)
    with pytest.raises(CorruptFile, check=about("two lists")):
        unpack_set(large_form(archive, claimed=0), tmp_path / "set")


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
