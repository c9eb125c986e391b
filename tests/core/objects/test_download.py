import io
import os
import tarfile
import zipfile

import pytest

from osfcore.errors import CorruptFile, FetchFailed
from osfcore.objects.download import TRIES, download, pip_download, temporary_folder, unpack
from tests.support.errors import about


def archive(path, members, mode="w:gz"):
    with tarfile.open(path, mode) as tar:
        for info, data in members:
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def test_downloads_are_whole_or_not_there(served, tmp_path):
    root, address, server = served
    (root / "a.bin").write_bytes(os.urandom(3_000_000))
    assert download(f"{address}/a.bin", tmp_path / "b.bin")
    assert (tmp_path / "b.bin").read_bytes() == (root / "a.bin").read_bytes()
    assert not download(f"{address}/none", tmp_path / "c")
    with pytest.raises(FetchFailed):
        download(f"{address}/a.bin", tmp_path / "c", max_bytes=1000)
    server.modes["a.bin"] = "short"
    with pytest.raises(FetchFailed):
        download(f"{address}/a.bin", tmp_path / "c")
    assert not list(tmp_path.glob("c*"))


@pytest.mark.slow  # it waits between the tries
def test_a_failing_server_is_asked_a_few_times(served, tmp_path):
    _, address, server = served
    server.modes["a"] = "error"
    with pytest.raises(FetchFailed, check=about("503")):
        download(f"{address}/a", tmp_path / "b")
    assert len(server.seen) >= TRIES
    with pytest.raises(FetchFailed):
        download("http://127.0.0.1:9/a", tmp_path / "b")


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


def test_archives_unpack_unless_to_too_much(tmp_path):
    path = archive(tmp_path / "a.tgz", [(tarfile.TarInfo(f"x/{i}"), bytes(400_000)) for i in range(3)])
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out/x/2").read_bytes() == bytes(400_000)
    with pytest.raises(CorruptFile):
        unpack(path, tmp_path / "again", max_bytes=1_000_000)


def test_damaged_archives_are_refused(tmp_path):
    path = archive(tmp_path / "a.tgz", [(tarfile.TarInfo("x"), os.urandom(5000))])
    data = path.read_bytes()
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]
    for damaged in (b"", b"no archive" * 100, data[:middle], flipped):
        path.write_bytes(damaged)
        with pytest.raises(CorruptFile, check=about("a.tgz")):
            unpack(path, tmp_path / "out")


def test_temporary_folders_vanish_and_take_old_ones_along(tmp_path):
    old = tmp_path / ".fetching-old"
    old.mkdir()
    os.utime(old, (0, 0))
    with temporary_folder(tmp_path, "x") as folder:
        (folder / "half").write_text("half")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_pip_takes_a_wheel_from_a_folder(tmp_path, monkeypatch):
    wheels, out = tmp_path / "wheels", tmp_path / "out"
    wheels.mkdir()
    out.mkdir()
    metadata = {"METADATA": "Metadata-Version: 2.1\nName: tiny-osf-toy\nVersion: 1.0\n", "RECORD": ""}
    metadata["WHEEL"] = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    with zipfile.ZipFile(wheels / "tiny_osf_toy-1.0-py3-none-any.whl", "w") as wheel:
        for name, content in metadata.items():
            wheel.writestr(f"tiny_osf_toy-1.0.dist-info/{name}", content)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheels))
    assert all(count >= 0 for count in pip_download("tiny-osf-toy==1.0", out))
    assert (out / "tiny_osf_toy-1.0-py3-none-any.whl").is_file()
    with pytest.raises(FetchFailed, check=about("No matching distribution")):
        list(pip_download("tiny-osf-toy==2.0", tmp_path))
