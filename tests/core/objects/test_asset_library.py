import json
import resource
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import CorruptFile, FetchFailed, MissingAssets, UnknownName
from osfcore.objects.asset import ObjectAsset, ObjectGeometry, ObjectInfo, RestingPoses, Symmetry, TexturedMesh
from osfcore.objects.asset_library import AssetLibrary
from tests.support.errors import about
from tests.support.same import assert_same

SYMMETRY = Symmetry("discrete", ((0.0, 0.0, 0.0, 1.0),), (0.0, 0.0, 1.0), "made up")
INFO = ObjectInfo("toy", "Toy", 0.25, SYMMETRY, "CC0-1.0", "nobody")
FILES = ("object.json", "arrays.npz", "texture.png", "viewer.glb")


@pytest.fixture
def asset() -> ObjectAsset:
    rng = np.random.default_rng(0)
    vertices = rng.random((30, 3)) * 0.1 - 0.05
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    texture = rng.integers(0, 256, (64, 32, 3), dtype=np.uint8)
    mesh = TexturedMesh(vertices, normals, rng.integers(0, 30, (40, 3)), rng.random((30, 2)), texture)
    parts = tuple(rng.random((n, 3)).astype(np.float32) for n in (4, 9, 17))
    resting = RestingPoses(np.eye(4)[:2], np.array([0.75, 0.25]))
    return ObjectAsset(INFO, mesh, parts, resting)


@pytest.fixture
def shelf(tmp_path, asset) -> AssetLibrary:
    shelf = AssetLibrary(tmp_path / "objects")
    shelf.write(asset, "a test")
    return shelf


def test_what_is_written_comes_back(shelf, asset):
    back = shelf.load("toy")
    assert_same(back, asset, atol=1e-7)  # of single precision
    assert (back.mesh.vertices.dtype, back.mesh.faces.dtype) == (np.float32, np.int32)
    np.testing.assert_allclose(shelf.size_m("toy"), asset.size_m, atol=1e-6)
    assert (shelf.source("toy"), shelf.names()) == ("a test", ("toy",))
    assert AssetLibrary(str(shelf.root)) == shelf  # a string will do
    (shelf.root / "toy" / "texture.png").unlink()  # the shape alone does without
    assert_same(shelf.load_geometry("toy"), ObjectGeometry(back.mesh.vertices, back.mesh.faces, back.parts))


def test_missing_and_unknown_are_told_apart(shelf):
    for method in (shelf.load, shelf.load_geometry, shelf.size_m, shelf.viewer_glb, shelf.source, shelf.digest):
        with pytest.raises(MissingAssets, check=about("024_bowl")):
            method("024_bowl")
        with pytest.raises(UnknownName, check=about("nothing")):
            method("nothing")
    with pytest.raises(UnknownName):
        shelf.info("nothing")
    assert shelf.info("024_bowl").label == "Bowl"
    sentence = "006_mustard_bottle and toy overlap by 4 mm, 0.5 cm from no_such_thing."
    assert shelf.in_words(sentence) == "Mustard bottle and toy overlap by 4 mm, 0.5 cm from no_such_thing."
    assert (shelf.label("toy"), shelf.label("gone")) == ("Toy", "gone")


@pytest.mark.parametrize("name", ["", ".", "..", "../objects/toy", "toy/", ".writing-x", "a\0b", "x" * 300])
def test_names_cannot_leave_the_folder(shelf, name):
    assert not shelf.has(name)
    with pytest.raises(UnknownName):
        shelf.load(name)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("damage", ["gone", "empty", "truncated", "flipped"])
def test_damage_is_told(shelf, file, damage):
    path = shelf.root / "toy" / file
    data = path.read_bytes()
    flipped = data[:20] + bytes([data[20] ^ 255]) + data[21:]
    path.write_bytes({"empty": b"", "truncated": data[: len(data) // 2]}.get(damage, flipped))
    if damage == "gone":
        path.unlink()
    is_absent = file == "object.json" and damage == "gone"
    with pytest.raises(UnknownName if is_absent else CorruptFile, check=about("toy")):
        shelf.viewer_glb("toy") if file == "viewer.glb" else shelf.load("toy")
    assert (shelf.names(), shelf.has("toy"), list(shelf.damaged())) == ((), False, ["toy"])
    with pytest.raises(UnknownName if is_absent else CorruptFile):
        shelf.check("toy")
    shelf.remove("toy")
    assert shelf.damaged() == {}


def test_an_object_that_is_damaged_while_it_is_known_is_offered_no_more_until_it_is_whole(shelf, asset):
    assert (shelf.names(), shelf.damaged()) == (("toy",), {})
    path = shelf.root / "toy" / "arrays.npz"
    path.write_bytes(path.read_bytes()[:-1])
    assert shelf.names() == ()
    shelf.write(asset, "again")
    assert (shelf.names(), shelf.damaged()) == (("toy",), {})


@pytest.mark.parametrize(
    "facts", [[], {}, {"format_version": 0}, {"format_version": 1}, {"format_version": 1, "info": {}, "crc32": 3}]
)
def test_facts_of_another_shape_are_told(shelf, facts):
    (shelf.root / "toy" / "object.json").write_text(json.dumps(facts))
    for method in (shelf.load, shelf.load_geometry, shelf.info, shelf.size_m, shelf.digest):
        with pytest.raises(CorruptFile):
            method("toy")
    assert (shelf.has("toy"), list(shelf.damaged())) == (False, ["toy"])


def test_writing_again_replaces_and_leaves_nothing_behind(shelf, asset):
    shelf.write(replace(asset, info=replace(INFO, mass_kg=0.5)), "again")
    assert shelf.load("toy").info.mass_kg == 0.5
    assert [path.name for path in shelf.root.iterdir()] == ["toy"]
    assert sorted(path.name for path in (shelf.root / "toy").iterdir()) == sorted(FILES)
    shelf.remove("toy")
    assert list(shelf.root.iterdir()) == []


def test_digests_tell_what_was_written_from_what_was_there_before(shelf, asset):
    before = shelf.digest("toy")
    shelf.write(asset, "another place")
    assert shelf.digest("toy") == before
    digests, mesh = {before}, asset.mesh
    for change in (
        {"mesh": replace(mesh, vertices=mesh.vertices * 1.01)},
        {"mesh": replace(mesh, texture=mesh.texture // 2)},
        {"info": replace(INFO, mass_kg=0.3)},
    ):
        shelf.write(replace(asset, **change), "a test")
        digests.add(shelf.digest("toy"))
    assert len(digests) == 4


def test_many_may_write_the_same_object_at_once(tmp_path, asset):
    shelf = AssetLibrary(tmp_path / "objects")
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda n: shelf.write(asset, f"writer {n}"), range(24)))
    assert shelf.load("toy").info == asset.info
    assert [path.name for path in shelf.root.iterdir()] == ["toy"]


@pytest.mark.parametrize("limit", [100, 2000, 5000])
def test_a_full_disk_keeps_the_old_object_whole(shelf, asset, limit):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))  # files can grow to a few kilobytes only
    try:
        with pytest.raises(FetchFailed):
            shelf.write(asset, "on a full disk")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert shelf.source("toy") == "a test"
    shelf.load("toy")
    assert [path.name for path in shelf.root.iterdir()] == ["toy"]
