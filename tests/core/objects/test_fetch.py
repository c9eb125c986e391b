from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.fetch import FolderSource, MeshFiles, NewObject, add_object, convert, fetch

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
