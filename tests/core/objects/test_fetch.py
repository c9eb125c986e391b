"""Fetch: fetch, sources."""

import hashlib
import tarfile
import zipfile
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import CorruptFile, FetchFailed, InvalidInput, UnknownName
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.fetch import (
    FolderSource,
    MeshFiles,
    NewObject,
    UrlSource,
    WheelSource,
    add_object,
    convert,
    fetch,
    source_from,
)
from osfcore.objects.mesh import read_mesh

# Fetch


NAMES = ("003_cracker_box", "006_mustard_bottle", "009_gelatin_box")


@pytest.fixture
def source(tmp_path, make_object) -> FolderSource:
    for name in NAMES:
        make_object(tmp_path / "ycb", name)
    return FolderSource(tmp_path / "ycb")


@pytest.fixture
def shelf(tmp_path) -> AssetLibrary:
    return AssetLibrary(tmp_path / "data" / "objects")


def test_everything_that_the_source_offers(source, shelf):
    steps = list(fetch([], source, shelf))
    assert shelf.names() == NAMES
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert {step.total for step in steps} == {4}
    assert steps[-1].done == steps[-1].total
    assert "Converting mustard bottle (2 of 3)" in [step.note for step in steps]
    assert shelf.source(NAMES[0]) == source.label
    assert sorted(path.name for path in shelf.root.iterdir()) == list(NAMES)


def test_a_converted_object_is_complete(source, shelf):
    list(fetch(NAMES[:1], source, shelf))
    asset = shelf.load(NAMES[0])
    assert asset.info.label == "Cracker box"
    assert len(asset.parts) == 1
    np.testing.assert_allclose(np.ptp(asset.parts[0], axis=0), (0.1, 0.06, 0.04), atol=1e-6)
    assert len(asset.resting.quaternions) == 6
    assert asset.mesh.texture[10, 32, 0] > 150


def test_what_is_there_is_left_alone_unless_forced(source, shelf):
    list(fetch(NAMES[:2], source, shelf))
    before = {name: (shelf.root / name).stat().st_ino for name in shelf.names()}
    steps = list(fetch(NAMES[:2], source, shelf))
    assert len(steps) == 1
    assert "already" in steps[0].note
    list(fetch(NAMES, source, shelf))
    assert {name: (shelf.root / name).stat().st_ino for name in NAMES[:2]} == before
    list(fetch(NAMES[:1], source, shelf, force=True))
    assert (shelf.root / NAMES[0]).stat().st_ino != before[NAMES[0]]


def test_an_executor_gives_the_same_objects(source, shelf, tmp_path):
    other = AssetLibrary(tmp_path / "other")
    list(fetch(NAMES, source, shelf))
    with ThreadPoolExecutor(2) as executor:
        steps = list(fetch(NAMES, source, other, executor))
    assert steps[-1].done == steps[-1].total
    for name in NAMES:
        for file in ("arrays.npz", "texture.png"):
            assert (shelf.root / name / file).read_bytes() == (other.root / name / file).read_bytes()


def test_errors_find_their_way_out_of_a_worker_process(source, shelf, tmp_path):
    (tmp_path / "ycb" / NAMES[1] / "google_16k" / "textured.obj").write_text("broken")
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor,
        pytest.raises(CorruptFile, match="no tri"),
    ):
        list(fetch(NAMES, source, shelf, executor))
    assert NAMES[1] not in shelf.names()


def test_a_damaged_object_stops_the_fetch_and_keeps_the_others(source, shelf, tmp_path):
    (tmp_path / "ycb" / NAMES[1] / "google_16k" / "textured.obj").write_text("broken")
    with pytest.raises(CorruptFile, match=r"textured\.obj"):
        list(fetch(NAMES, source, shelf))
    assert shelf.names() == NAMES[:1]
    assert [path.name for path in shelf.root.iterdir()] == [NAMES[0]]


def test_a_missing_texture_is_told(source, shelf, tmp_path):
    (tmp_path / "ycb" / NAMES[0] / "google_16k" / "texture_map.jpg").unlink()
    with pytest.raises(CorruptFile, match="texture is missing"):
        list(fetch(NAMES[:1], source, shelf))


def test_stopping_leaves_no_half_object(source, shelf):
    steps = fetch(NAMES, source, shelf)
    for step in steps:
        if step.note.startswith("Converting mustard"):
            break
    steps.close()
    assert sorted(path.name for path in shelf.root.iterdir()) == [NAMES[0]]


def test_unknown_names_are_told_before_anything_happens(source, shelf):
    with pytest.raises(UnknownName, match="nonsense"):
        list(fetch([NAMES[0], "nonsense"], source, shelf))
    with pytest.raises(UnknownName, match="024_bowl"):
        list(fetch(["024_bowl"], source, shelf))
    assert shelf.names() == ()


def test_msh_files_convert(tmp_path, shelf):
    from osfcore.objects.catalogue import CATALOGUE

    box = trimesh.creation.box((0.1, 0.06, 0.04))
    uv = np.stack([np.linspace(0.1, 0.9, 8), np.where(box.vertices[:, 2] > 0, 0.1, 0.9)], axis=1)  # v downwards
    counts = np.array([8, 0, 8, 12], np.int32)
    arrays = (counts, box.vertices.astype(np.float32), uv.astype(np.float32), box.faces.astype(np.int32))
    (tmp_path / "a.msh").write_bytes(b"".join(a.tobytes() for a in arrays))
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :, 0] = image[32:, :, 1] = 200
    Image.fromarray(image).save(tmp_path / "a.png")
    convert(MeshFiles(tmp_path / "a.msh", tmp_path / "a.png"), CATALOGUE[NAMES[0]], shelf, "a test")
    mesh = shelf.load(NAMES[0]).mesh
    np.testing.assert_allclose(mesh.uv[mesh.vertices[:, 2] > 0, 1], 0.9, atol=1e-6)
    assert tuple(mesh.texture[10, 32]) == (200, 0, 0)  # red at the top, where v is 1
    (tmp_path / "a.png").unlink()
    with pytest.raises(CorruptFile, match="texture"):
        convert(MeshFiles(tmp_path / "a.msh", tmp_path / "a.png"), CATALOGUE[NAMES[0]], shelf, "a test")


@pytest.fixture
def glb(tmp_path):
    path = tmp_path / "my.glb"
    mesh = trimesh.creation.icosphere(2, 0.04)
    mesh.visual.vertex_colors = np.tile(np.array([[10, 200, 30, 255]], np.uint8), (len(mesh.vertices), 1))
    mesh.export(path)
    return path


def test_a_user_adds_an_object(glb, shelf):
    added = add_object(glb, NewObject("my-ball", 0.3, licence="CC0-1.0"), shelf)
    asset = shelf.load("my-ball")
    assert asset.info == added.info
    assert asset.info.label == "My ball"
    assert asset.info.mass_kg == 0.3
    assert shelf.info("my-ball").licence == "CC0-1.0"
    assert asset.radius_m == pytest.approx(0.04, rel=0.02)
    assert np.abs(asset.mesh.texture.reshape(-1, 3).max(axis=0).astype(int) - (10, 200, 30)).max() <= 1


@pytest.mark.parametrize("mass", [0.0, -1.0, 20.1, float("nan"), float("inf")])
def test_absurd_masses_are_refused(glb, shelf, mass):
    with pytest.raises(InvalidInput, match="mass"):
        add_object(glb, NewObject("ball", mass), shelf)


@pytest.mark.parametrize("text", ["\udcff", "two\nlines", "x" * 300])
def test_labels_that_cannot_be_shown_are_refused(glb, shelf, text):
    with pytest.raises(InvalidInput, match="label"):
        add_object(glb, NewObject("mine", 0.2, label=text), shelf)
    with pytest.raises(InvalidInput, match="licence"):
        add_object(glb, NewObject("mine", 0.2, licence=text), shelf)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), 1e9])
def test_absurd_scales_are_refused(glb, shelf, scale):
    with pytest.raises(InvalidInput, match=r"scale|size"):
        add_object(glb, NewObject("ball", 1.0, scale=scale), shelf)


def test_names_that_are_taken_or_malformed_are_refused(glb, shelf):
    with pytest.raises(InvalidInput, match="catalogue"):
        add_object(glb, NewObject("006_mustard_bottle", 1.0), shelf)
    with pytest.raises(InvalidInput, match="object name"):
        add_object(glb, NewObject("../x", 1.0), shelf)
    add_object(glb, NewObject("ball", 1.0), shelf)
    with pytest.raises(InvalidInput, match="not taken"):
        add_object(glb, NewObject("ball", 2.0), shelf)
    add_object(glb, NewObject("ball", 2.0), shelf, force=True)
    assert shelf.info("ball").mass_kg == 2.0


# Sources


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
