import io
import os
import tarfile

import pytest

from osfcore.errors import CorruptFile, FetchFailed
from osfcore.objects import download as module
from osfcore.objects.download import download, pip_download, temporary_folder, unpack


def archive(path, members, mode="w:gz"):
    with tarfile.open(path, mode) as tar:
        for info, data in members:
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def test_download_brings_the_bytes(served, tmp_path):
    root, address, _ = served
    (root / "a.bin").write_bytes(os.urandom(3_000_000))
    assert download(f"{address}/a.bin", tmp_path / "b.bin")
    assert (tmp_path / "b.bin").read_bytes() == (root / "a.bin").read_bytes()


def test_a_file_that_is_not_there_is_no_error(served, tmp_path):
    assert not download(f"{served[1]}/none", tmp_path / "b")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(("mode", "reason"), [("error", "503"), ("short", "connection")])
def test_a_failing_server_is_told_after_a_few_tries(served, tmp_path, monkeypatch, mode, reason):
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)
    root, address, server = served
    (root / "a").write_text("x")
    server.modes["a"] = mode
    with pytest.raises(FetchFailed, match=reason):
        download(f"{address}/a", tmp_path / "b")
    assert list(tmp_path.glob("b*")) == []
    if mode == "error":
        assert len(server.seen) >= module.TRIES


def test_no_server_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)
    with pytest.raises(FetchFailed, match="no connection"):
        download("http://127.0.0.1:9/a", tmp_path / "b")


def test_too_large_is_refused(served, tmp_path):
    root, address, _ = served
    (root / "a").write_bytes(bytes(2000))
    with pytest.raises(FetchFailed, match="larger"):
        download(f"{address}/a", tmp_path / "b", max_bytes=1000)
    assert list(tmp_path.glob("b*")) == []


def test_unpack(tmp_path):
    path = archive(tmp_path / "a.tgz", [(tarfile.TarInfo("x/y.txt"), b"hello")])
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out/x/y.txt").read_bytes() == b"hello"


def hostile(name="x", kind=tarfile.REGTYPE, target=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


@pytest.mark.parametrize(
    "member",
    [
        hostile("../evil"),
        hostile("/tmp/osf-evil"),
        hostile("x/../../evil"),
        hostile("link", tarfile.SYMTYPE, "/etc/passwd"),
        hostile("link", tarfile.LNKTYPE, "../evil"),
        hostile("pipe", tarfile.FIFOTYPE),
        hostile("device", tarfile.CHRTYPE),
    ],
    ids=lambda m: f"{m.name}-{m.type!r}",
)
def test_hostile_archives_write_nothing_outside(tmp_path, member):
    path = archive(tmp_path / "a.tgz", [(member, b"")])
    inside = tmp_path / "deep" / "out"
    if member.name == "/tmp/osf-evil":  # tarfile's data filter strips the slash: it lands inside
        unpack(path, inside)
    else:
        with pytest.raises(CorruptFile):
            unpack(path, inside)
    outside = [p for p in tmp_path.rglob("*") if p.is_file() and inside not in p.parents]
    assert outside == [path]


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path):
    path = archive(tmp_path / "bomb.tgz", [(tarfile.TarInfo(f"{i}"), bytes(400_000)) for i in range(3)])
    with pytest.raises(CorruptFile, match="more than 1 MB"):
        unpack(path, tmp_path / "out", max_bytes=1_000_000)


@pytest.mark.parametrize("damage", ["empty", "garbage", "truncated", "flipped"])
def test_damaged_archives_are_told(tmp_path, damage):
    path = archive(tmp_path / "a.tgz", [(tarfile.TarInfo("x"), os.urandom(5000))])
    data = path.read_bytes()
    middle = len(data) // 2
    path.write_bytes(
        {
            "empty": b"",
            "garbage": b"no archive" * 100,
            "truncated": data[:middle],
            "flipped": data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :],
        }[damage]
    )
    with pytest.raises(CorruptFile, match=r"a\.tgz"):
        unpack(path, tmp_path / "out")


def test_temporary_folders_vanish_and_take_old_ones_along(tmp_path):
    old = tmp_path / ".fetching-old"
    old.mkdir()
    os.utime(old, (0, 0))
    with temporary_folder(tmp_path, "x") as folder:
        (folder / "half").write_text("half")
    assert list(tmp_path.iterdir()) == []


def test_pip_without_an_index_is_told_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "")
    monkeypatch.setenv("PIP_RETRIES", "0")
    with pytest.raises(FetchFailed, match=r"index cannot be reached|No matching distribution") as caught:
        list(pip_download("MyoSuite==2.8.0", tmp_path))
    assert "\n" not in str(caught.value)


def test_pip_takes_a_wheel_from_a_folder(tmp_path, monkeypatch):
    import zipfile

    wheels, out = tmp_path / "wheels", tmp_path / "out"
    wheels.mkdir()
    out.mkdir()
    with zipfile.ZipFile(wheels / "tiny_osf_toy-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr(
            "tiny_osf_toy-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: tiny-osf-toy\nVersion: 1.0\n"
        )
        wheel.writestr(
            "tiny_osf_toy-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr("tiny_osf_toy-1.0.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheels))
    assert all(count >= 0 for count in pip_download("tiny-osf-toy==1.0", out))
    assert (out / "tiny_osf_toy-1.0-py3-none-any.whl").is_file()
    with pytest.raises(FetchFailed, match="No matching distribution"):
        list(pip_download("tiny-osf-toy==2.0", tmp_path))
