import hashlib
import tarfile
import zipfile

import numpy as np
import pytest

from osfcore.errors import CorruptFile, FetchFailed, InvalidInput, UnknownName
from osfcore.objects.fetch import FolderSource, UrlSource, WheelSource, source_from
from osfcore.objects.mesh import read_mesh

NAME, OTHER = "006_mustard_bottle", "003_cracker_box"


def finish(steps):
    return list(steps)[-1]


def pack(folder, name, path):
    with tarfile.open(path, "w:gz") as tar:
        tar.add(folder / name, arcname=name)


def test_source_from_text(tmp_path):
    assert isinstance(source_from("pypi", tmp_path), WheelSource)
    assert isinstance(source_from("https://example.org/ycb", tmp_path), UrlSource)
    assert isinstance(source_from(str(tmp_path), tmp_path), FolderSource)
    for text in (str(tmp_path / "none"), "ftp://example.org", "http://", ""):
        if text:
            with pytest.raises(InvalidInput, match="source"):
                source_from(text, tmp_path)


@pytest.mark.parametrize("is_flat", [False, True])
def test_folder_in_both_layouts(tmp_path, make_object, is_flat):
    made = make_object(tmp_path, NAME)
    if is_flat:
        for path in list(made.iterdir()):
            path.rename(made.parent / path.name)
    source = FolderSource(tmp_path)
    assert source.names() == (NAME,)
    step = finish(source.prepare())
    assert step.done == step.total
    mesh = read_mesh(source.files(NAME, tmp_path / "unused").mesh)
    assert mesh.texture.shape == (64, 64, 3)
    top = mesh.texture[:20].reshape(-1, 3).mean(axis=0)
    assert top[0] > 150 > 60 > top[1]  # red, and so v runs upwards
    with pytest.raises(UnknownName, match=NAME):
        source.files(OTHER, tmp_path)


def test_an_empty_folder_is_told(tmp_path):
    with pytest.raises(InvalidInput, match="google_16k"):
        FolderSource(tmp_path).names()


@pytest.mark.parametrize("place", ["{name}_google_16k.tgz", "{name}/{name}_google_16k.tgz"])
def test_official_archives_over_http_are_kept(served, tmp_path, make_object, place):
    root, address, server = served
    make_object(tmp_path / "ycb", NAME)
    target = root / place.format(name=NAME)
    target.parent.mkdir(exist_ok=True)
    pack(tmp_path / "ycb", NAME, target)
    for i, requests in enumerate((True, False)):
        server.seen.clear()
        folder = tmp_path / f"out{i}"
        folder.mkdir()
        files = UrlSource(f"{address}/", tmp_path / "cache").files(NAME, folder)
        assert read_mesh(files.mesh).texture.shape == (64, 64, 3)
        assert bool(server.seen) == requests  # the second time the cache has it


def test_folder_layout_over_http(served, tmp_path, make_object):
    root, address, _ = served
    make_object(root, NAME)
    files = UrlSource(address, tmp_path / "cache").files(NAME, tmp_path)
    mesh = read_mesh(files.mesh)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.1, 0.06, 0.04), atol=1e-6)
    assert mesh.texture.shape == (64, 64, 3)


def test_material_files_cannot_be_written_elsewhere(served, tmp_path, make_object):
    root, address, _ = served
    made = make_object(root, NAME)
    text = (made / "textured.obj").read_text()
    (made / "textured.obj").write_text("mtllib ../../evil.mtl\n" + text)
    (root / "evil.mtl").write_text("newmtl evil\n")
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    UrlSource(address, tmp_path / "cache").files(NAME, folder)
    assert not list((tmp_path / "a").glob("evil*"))
    assert not (tmp_path / "evil.mtl").exists()


def test_a_server_without_the_object_is_told(served, tmp_path):
    with pytest.raises(FetchFailed, match="neither"):
        UrlSource(served[1], tmp_path / "cache").files(NAME, tmp_path)


def test_an_archive_without_the_object_is_told_and_not_kept(served, tmp_path, make_object):
    root, address, _ = served
    make_object(tmp_path / "ycb", OTHER)
    pack(tmp_path / "ycb", OTHER, root / f"{NAME}_google_16k.tgz")
    source = UrlSource(address, tmp_path / "cache")
    with pytest.raises(CorruptFile, match="holds no"):
        source.files(NAME, tmp_path / "out")
    assert not list((tmp_path / "cache").rglob("*.tgz"))


def test_a_damaged_archive_is_asked_for_again(served, tmp_path, make_object):
    root, address, _ = served
    (root / f"{NAME}_google_16k.tgz").write_bytes(b"<html>not an archive</html>")
    source = UrlSource(address, tmp_path / "cache")
    with pytest.raises(CorruptFile):
        source.files(NAME, tmp_path / "out")
    make_object(tmp_path / "ycb", NAME)
    pack(tmp_path / "ycb", NAME, root / f"{NAME}_google_16k.tgz")
    assert source.files(NAME, tmp_path / "again").mesh.is_file()


@pytest.mark.parametrize("address", ["http://[::1", "http://127.0.0.1:9/\N{SNOWMAN}/", "ftp://example", "http://"])
def test_addresses_that_are_none_are_refused(tmp_path, address):
    with pytest.raises(InvalidInput, match="source"):
        UrlSource(address, tmp_path)


def test_a_wheel_with_another_checksum_is_refused(tmp_path):
    downloaded = tmp_path / WheelSource.FILE
    downloaded.write_bytes(b"not the wheel")
    source = WheelSource(tmp_path / "cache")
    with pytest.raises(FetchFailed, match=hashlib.sha256(b"not the wheel").hexdigest()):
        source.adopt(downloaded)
    assert not source.wheel.exists()
    with pytest.raises(FetchFailed, match="did not deliver"):
        source.adopt(tmp_path / "none")


def test_without_network_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "")
    source = WheelSource(tmp_path / "cache")
    with pytest.raises(FetchFailed, match="MyoSuite"):
        finish(source.prepare())
    assert list((tmp_path / "cache").iterdir()) == []


def test_objects_come_out_of_a_wheel(tmp_path, monkeypatch):
    source = WheelSource(tmp_path)
    with zipfile.ZipFile(source.wheel, "w") as wheel:
        wheel.writestr(f"{source.FOLDER}/meshes/{NAME}.msh", b"mesh")
        wheel.writestr(f"{source.FOLDER}/textures/{NAME}.png", b"texture")
    monkeypatch.setattr(WheelSource, "SHA256", hashlib.sha256(source.wheel.read_bytes()).hexdigest())
    assert finish(source.prepare()).done == 1  # it lies in the cache: no download
    files = source.files(NAME, tmp_path)
    assert files.mesh.read_bytes() == b"mesh"
    assert files.texture is not None
    assert files.texture.read_bytes() == b"texture"
    with pytest.raises(CorruptFile, match=OTHER):
        source.files(OTHER, tmp_path)
    with pytest.raises(UnknownName):
        source.files("024_bowl", tmp_path)
