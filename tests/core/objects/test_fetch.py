import hashlib
import io
import tarfile
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import CorruptFile, FetchFailed, InvalidInput, UnknownName
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.fetch import FolderSource, NewObject, UrlSource, WheelSource, add_object, fetch, source_from
from osfcore.objects.mesh import read_mesh
from tests.core.objects.meshes import msh_bytes
from tests.support.errors import about

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
    assert shelf.source(NAMES[0]) == source.label
    assert sorted(path.name for path in shelf.root.iterdir()) == list(NAMES)
    asset = shelf.load(NAMES[0])
    assert asset.info == CATALOGUE[NAMES[0]]
    assert len(asset.parts) == 1
    np.testing.assert_allclose(np.ptp(asset.parts[0], axis=0), (0.1, 0.06, 0.04), atol=1e-6)
    assert len(asset.resting.quaternions) == 6
    assert asset.mesh.texture[10, 32, 0] > 150


def test_what_is_there_is_left_alone_unless_forced(source, shelf):
    list(fetch(NAMES[:2], source, shelf))
    before = {name: (shelf.root / name).stat().st_ino for name in shelf.names()}
    assert len(list(fetch(NAMES[:2], source, shelf))) == 1
    list(fetch(NAMES, source, shelf))
    assert {name: (shelf.root / name).stat().st_ino for name in NAMES[:2]} == before
    list(fetch(NAMES[:1], source, shelf, force=True))
    assert (shelf.root / NAMES[0]).stat().st_ino != before[NAMES[0]]


def test_an_executor_gives_the_same_objects_and_errors(source, shelf, tmp_path):
    other = AssetLibrary(tmp_path / "other")
    list(fetch(NAMES[:2], source, shelf))
    (tmp_path / "ycb" / NAMES[2] / "google_16k" / "textured.obj").write_text("broken")
    with ThreadPoolExecutor(2) as executor:
        steps = list(fetch(NAMES[:2], source, other, executor))
        with pytest.raises(CorruptFile):
            list(fetch(NAMES, source, other, executor))
    assert steps[-1].done == steps[-1].total
    assert other.names() == NAMES[:2]
    for name in NAMES[:2]:
        for file in ("arrays.npz", "texture.png"):
            assert (shelf.root / name / file).read_bytes() == (other.root / name / file).read_bytes()


def test_a_damaged_object_stops_the_fetch_and_keeps_the_others(source, shelf, tmp_path):
    (tmp_path / "ycb" / NAMES[1] / "google_16k" / "textured.obj").write_text("broken")
    with pytest.raises(CorruptFile, check=about("textured.obj")):
        list(fetch(NAMES, source, shelf))
    assert [path.name for path in shelf.root.iterdir()] == [NAMES[0]]
    (tmp_path / "ycb" / NAMES[2] / "google_16k" / "texture_map.jpg").unlink()
    with pytest.raises(CorruptFile, check=about("texture")):
        list(fetch(NAMES[2:], source, shelf))


def test_stopping_leaves_no_half_object(source, shelf):
    steps = fetch(NAMES, source, shelf)
    for step in steps:
        if step.note.startswith("Converting mustard"):
            break
    steps.close()
    assert sorted(path.name for path in shelf.root.iterdir()) == [NAMES[0]]


def test_unknown_names_are_told_before_anything_happens(source, shelf):
    with pytest.raises(UnknownName, check=about("nonsense")):
        list(fetch([NAMES[0], "nonsense"], source, shelf))
    with pytest.raises(UnknownName, check=about("024_bowl")):
        list(fetch(["024_bowl"], source, shelf))
    assert shelf.names() == ()


@pytest.fixture
def glb(tmp_path):
    path = tmp_path / "my.glb"
    mesh = trimesh.creation.icosphere(2, 0.04)
    mesh.visual.vertex_colors = np.tile(np.array([[10, 200, 30, 255]], np.uint8), (len(mesh.vertices), 1))
    mesh.export(path)
    return path


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("mass", [{"mass_kg": mass} for mass in (0.0, -1.0, 20.1, float("nan"), float("inf"))]),
        ("scale", [{"scale": scale} for scale in (0.0, -1.0, float("nan"))]),
        ("size", [{"scale": 1e9}]),
        ("label", [{"label": text} for text in ("\udcff", "two\nlines", "x" * 300)]),
        ("licence", [{"licence": "x" * 300}]),
        ("object name", [{"name": name} for name in ("006_mustard_bottle", "taken", "../x", "", "A", "_a", "mug\n")]),
        ("object name", [{"name": "a" * 65}]),
    ],
)
def test_what_no_object_may_be_is_refused(glb, shelf, what, values):
    (shelf.root / "taken").mkdir(parents=True)
    for value in values:
        with pytest.raises(InvalidInput, check=about(what)):
            add_object(glb, NewObject(**{"name": "mine", "mass_kg": 0.2} | value), shelf)
    assert shelf.names() == ()


def test_a_user_adds_an_object_and_may_replace_it(glb, shelf):
    added = add_object(glb, NewObject("my-ball", 0.3, licence="CC0-1.0"), shelf)
    asset = shelf.load("my-ball")
    assert asset.info == added.info
    assert asset.info.label == "My ball"
    assert asset.info.mass_kg == 0.3
    assert shelf.info("my-ball").licence == "CC0-1.0"
    assert asset.radius_m == pytest.approx(0.04, rel=0.02)
    shown = (56, 229, 96)  # on a screen, of 10, 200 and 30 in linear light, as glTF has vertex colours
    assert np.abs(asset.mesh.texture.reshape(-1, 3).max(axis=0).astype(int) - shown).max() <= 1
    with pytest.raises(InvalidInput):
        add_object(glb, NewObject("my-ball", 2.0), shelf)
    add_object(glb, NewObject("my-ball", 2.0), shelf, force=True)
    assert shelf.info("my-ball").mass_kg == 2.0


def test_a_mass_that_nobody_states_is_guessed_from_the_volume(glb, shelf):
    added = add_object(glb, NewObject("light-ball", None), shelf)
    half_of_water = 500 * 4 / 3 * np.pi * added.radius_m**3
    assert shelf.info("light-ball").mass_kg == pytest.approx(half_of_water, rel=0.05)


NAME, OTHER = "006_mustard_bottle", "003_cracker_box"


def finish(steps):
    return list(steps)[-1]


def pack(folder, name, path):
    with tarfile.open(path, "w:gz") as tar:
        tar.add(folder / name, arcname=name)


@pytest.mark.parametrize(
    "text", ["none", "ftp://example.org", "http://", "http://[::1", "http://127.0.0.1:9/\N{SNOWMAN}/"]
)
def test_what_is_no_source_is_refused(tmp_path, text):
    with pytest.raises(InvalidInput, check=about("source")):
        source_from(text if ":" in text else str(tmp_path / text), tmp_path)
    with pytest.raises(InvalidInput, check=about("source")):
        source_from(str(tmp_path), tmp_path).names()  # an empty folder


@pytest.mark.parametrize("is_flat", [False, True])
def test_folder_in_both_layouts(tmp_path, make_object, is_flat):
    made = make_object(tmp_path, NAME)
    if is_flat:
        for path in list(made.iterdir()):
            path.rename(made.parent / path.name)
    source = source_from(str(tmp_path), tmp_path)
    assert source.names() == (NAME,)
    step = finish(source.prepare())
    assert step.done == step.total
    mesh = read_mesh(source.mesh(NAME, tmp_path / "unused"))
    assert mesh.texture.shape == (64, 64, 3)
    top = mesh.texture[:20].reshape(-1, 3).mean(axis=0)
    assert top[0] > 150 > 60 > top[1]  # red, and so v runs upwards
    with pytest.raises(UnknownName, check=about(OTHER)):
        source.mesh(OTHER, tmp_path)


def test_single_files_over_http_come_with_their_textures_and_never_elsewhere(served, tmp_path, make_object):
    root, address, _ = served
    made = make_object(root, NAME)
    (made / "textured.obj").write_text("mtllib ../../evil.mtl\n" + (made / "textured.obj").read_text())
    (root / "evil.mtl").write_text("newmtl evil\n")
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    source = source_from(address, tmp_path / "cache")
    assert source.mesh(NAME, folder) == folder / "textured.obj"
    for name in ("texture_map.jpg", "textured.mtl", "textured.obj"):
        assert (folder / name).read_bytes() == (made / name).read_bytes()
    assert not list(tmp_path.glob("a/evil*")) + list(tmp_path.glob("evil*"))
    with pytest.raises(FetchFailed):
        source.mesh(OTHER, folder)


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
        path = UrlSource(f"{address}/", tmp_path / "cache").mesh(NAME, folder)
        assert read_mesh(path).texture.shape == (64, 64, 3)
        assert bool(server.seen) == requests  # the second time the cache has it


def test_a_damaged_archive_or_one_without_the_object_is_asked_for_again(served, tmp_path, make_object):
    root, address, _ = served
    source = UrlSource(address, tmp_path / "cache")
    (root / f"{NAME}_google_16k.tgz").write_bytes(b"<html>not an archive</html>")
    for packed in (OTHER, NAME):
        with pytest.raises(CorruptFile):
            source.mesh(NAME, tmp_path / "out")
        make_object(tmp_path / "ycb", packed)
        pack(tmp_path / "ycb", packed, root / f"{NAME}_google_16k.tgz")
    assert source.mesh(NAME, tmp_path / "again").is_file()


def test_objects_come_out_of_a_wheel_of_the_right_checksum_alone(tmp_path):
    source, shelf = WheelSource(tmp_path / "cache"), AssetLibrary(tmp_path / "objects")
    wheel, texture = tmp_path / "downloaded", io.BytesIO()
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :, 0] = image[32:, :, 1] = 200
    Image.fromarray(image).save(texture, "PNG")
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    uv = np.stack([np.linspace(0.1, 0.9, 8), np.where(box.vertices[:, 2] > 0, 0.1, 0.9)], axis=1)  # v downwards
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr(f"{source.FOLDER}/meshes/{NAME}.msh", msh_bytes(box.vertices, uv, box.faces))
        file.writestr(f"{source.FOLDER}/textures/{NAME}.png", texture.getvalue())
    for path in (wheel, tmp_path / "none"):
        with pytest.raises(FetchFailed):
            source.adopt(path)
    assert not source.wheel.exists()
    source.SHA256 = hashlib.sha256(wheel.read_bytes()).hexdigest()
    source.adopt(wheel)
    assert finish(source.prepare()).done == 1  # it lies in the cache: no download
    list(fetch([NAME], source, shelf))
    mesh = shelf.load(NAME).mesh
    np.testing.assert_allclose(mesh.uv[mesh.vertices[:, 2] > 0, 1], 0.9, atol=1e-6)
    assert tuple(mesh.texture[10, 32]) == (200, 0, 0)  # red at the top, where v is 1
    with pytest.raises(CorruptFile, check=about(OTHER)):
        source.mesh(OTHER, tmp_path)
    with pytest.raises(UnknownName):
        source.mesh("024_bowl", tmp_path)
