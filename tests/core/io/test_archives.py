import shutil
import stat
import zipfile

import numpy as np
import pytest

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

    monkeypatch.setattr(module.Path, "rename", full)
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
