import io
import itertools
import json
import shutil
import struct
import zipfile

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.objects.catalogue import CATALOGUE
from tests.app.api.test_problems import is_problem
from tests.app.conftest import running, until


def test_the_list_holds_what_can_be_fetched_and_what_is_here(service, library):
    objects = {o["name"]: o for o in service.get("/api/objects").json()["objects"]}
    assert set(objects) >= set(CATALOGUE)
    assert {name for name, o in objects.items() if o["available"]} == set(library.names())
    assert all((o["size_m"] is None) != o["available"] for o in objects.values())


def test_one_object_has_its_size(service, library):
    found = service.get("/api/objects/006_mustard_bottle").json()
    assert np.allclose(found["size_m"], library.size_m("006_mustard_bottle"))
    assert found["mass_kg"] == CATALOGUE["006_mustard_bottle"].mass_kg
    assert found["licence"] == "CC-BY-4.0"


def test_a_damaged_object_does_not_hide_the_others_and_can_be_deleted(service, services, library):
    damaged = services.runner.library.root / "zz"
    damaged.mkdir()
    (damaged / "object.json").write_text('{"format_version": 1}')
    services.objects.outdate()  # else it is looked for within a second
    try:
        listed = service.get("/api/objects").json()
        assert {o["name"] for o in listed["objects"]} >= set(library.names())
        assert [each["id"] for each in listed["damaged"]] == ["zz"]
        assert service.delete("/api/objects/zz").status_code == 204
        assert service.get("/api/objects").json()["damaged"] == []
    finally:
        shutil.rmtree(damaged, ignore_errors=True)


@pytest.mark.slow
def test_a_damaged_object_is_fetched_again_and_drawn_for_no_table(library, tmp_path):
    with running(library, tmp_path) as client:
        broken, *whole = library.names()
        path = tmp_path / "objects" / broken / "arrays.npz"
        data = path.read_bytes()
        path.unlink()  # it is a link to what other tests use
        path.write_bytes(data[: len(data) // 2])
        listed = client.get("/api/objects").json()
        assert [each["id"] for each in listed["damaged"]] == [broken]
        assert {o["name"] for o in listed["objects"] if o["available"]} == set(whole)
        for seed in range(3):
            made = client.post("/api/scenes", json={"count": len(whole), "seed": seed})
            assert {entry["name"] for entry in made.json()["objects"]} == set(whole)
        assert broken in is_problem(client.post("/api/scenes", json={"objects": [broken]}), 409)["detail"]


def test_unknown_objects_are_not_found(service):
    for name in ("teapot", ".hidden", "%2e%2e%2fservice.sqlite3", "a" * 300, "\N{SNOWMAN}"):
        is_problem(service.get(f"/api/objects/{name}"), 404)
    assert "teapot" in service.get("/api/objects/teapot").json()["detail"]


GLB, ZIP = "model/gltf-binary", "application/zip"
OBJ_SIDES_M = (0.06, 0.08, 0.1)


@pytest.fixture(scope="module")
def own(library, tmp_path_factory):
    """A service whose objects may come and go."""
    with running(library, tmp_path_factory.mktemp("own")) as client:
        yield client


def textured_box(sides=OBJ_SIDES_M):
    """A box with a picture on it."""
    mesh = trimesh.creation.box(sides)
    pixels = np.random.default_rng(0).integers(0, 255, (32, 32, 3)).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=mesh.vertices[:, :2] / np.ptp(mesh.vertices[:, :2]) + 0.5, material=material
    )
    return mesh


def glb(sides=OBJ_SIDES_M):
    return textured_box(sides).export(file_type="glb")


def zipped(files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


def obj_files(texture="paint.png"):
    corners = "".join(f"v {x} {y} {z}\n" for x in (0, 60) for y in (0, 80) for z in (0, 100))
    sides = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    faces = "".join("f " + " ".join(f"{c}/{i + 1}" for i, c in enumerate(side)) + "\n" for side in sides)
    paint = io.BytesIO()
    Image.fromarray(np.full((16, 16, 3), (200, 30, 30), np.uint8)).save(paint, "PNG")
    return {
        "model/box.obj": f"mtllib box.mtl\n{corners}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl paint\n{faces}",
        "model/box.mtl": f"newmtl paint\nmap_Kd {texture}\n",
        "textures/paint.png": paint.getvalue(),
    }


def send(client, content, kind=GLB, **query):
    query = {"name": "box", "mass_kg": 0.2, **query}
    return client.post("/api/objects", params=query, content=content, headers={"Content-Type": kind})


def added(client, content, kind=GLB, **query):
    """The finished job of an upload."""
    answer = send(client, content, kind, **query)
    assert answer.status_code == 202, answer.text
    where = answer.headers["Location"]
    until(lambda: client.get(where).json()["state"] in ("done", "failed"), 90)
    return client.get(where).json()


def refused(client, content, kind=GLB, **query):
    """The sentence about a mesh that only its job could judge."""
    job = added(client, content, kind, **query)
    assert job["state"] == "failed"
    assert str(client.app.state.settings.data_dir) not in job["error"]
    assert "inputs" not in job["error"]
    return job["error"]


def test_a_glb_becomes_an_object_that_scenes_hold_and_that_stays_while_they_do(own):
    job = added(own, glb(), label="My box", mass_kg=0.25)
    assert job["state"] == "done", job["error"]
    assert sorted(job["result"]["size_m"]) == pytest.approx(sorted(OBJ_SIDES_M), abs=1e-5)
    found = own.get("/api/objects/box").json()
    assert (found["label"], found["mass_kg"], found["own"], found["available"]) == ("My box", 0.25, True, True)
    is_problem(send(own, glb()), 409)
    scene = own.post("/api/scenes", json={"objects": ["box", "003_cracker_box"], "seed": 1})
    assert scene.status_code == 201, scene.text
    is_problem(own.delete("/api/objects/box"), 409)
    assert "scene" in own.delete("/api/objects/box").json()["detail"]
    own.delete(f"/api/scenes/{scene.json()['id']}")
    assert own.delete("/api/objects/box").status_code == 204
    is_problem(own.get("/api/objects/box"), 404)


@pytest.mark.slow
def test_a_zipped_obj_in_millimetres_keeps_the_texture_that_lies_in_another_folder(own):
    files = obj_files("C:\\made\\P\u00c4INT.png")
    files["textures/pa\u0308int.png"] = files.pop("textures/paint.png")  # as macOS decomposes letters
    job = added(own, zipped(files), ZIP, name="red", scale=0.001)
    assert job["state"] == "done", job["error"]
    assert job["result"]["size_m"] == pytest.approx(OBJ_SIDES_M, abs=1e-5)
    colours = views(own, "red")
    solid = colours[colours[..., 3] == 255]
    assert np.all(solid[:, 2] > 2 * solid[:, 1])  # BGRA: red from all around
    own.delete("/api/objects/red")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["PLY", "stl"])
def test_a_bare_file_of_another_format_is_known_by_the_end_of_its_name(own, ending):
    content = textured_box().export(file_type=ending.lower())
    job = added(own, content, "application/octet-stream", name="bare", file_name=f"scan.{ending}")
    assert job["state"] == "done", job["error"]
    assert job["result"]["size_m"] == pytest.approx(OBJ_SIDES_M, abs=1e-5)
    own.delete("/api/objects/bare")


def views(client, name):
    png = client.get(f"/api/objects/{name}/thumbnail.png")
    assert png.status_code == 200, png.text
    return cv2.imdecode(np.frombuffer(png.content, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.slow
def test_a_thumbnail_holds_the_whole_object_from_all_around_and_is_drawn_once(own):
    sheet = views(own, "003_cracker_box")
    side = sheet.shape[0]
    assert sheet.shape == (side, 24 * side, 4)
    tiles = np.split(sheet, 24, axis=1)
    for tile in tiles:
        alpha = tile[..., 3]
        assert alpha.max() == 255
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0  # nothing is cut off
    assert all(np.any(a != b) for a, b in itertools.pairwise(tiles))
    first = own.get("/api/objects/003_cracker_box/thumbnail.png").content
    assert own.get("/api/objects/003_cracker_box/thumbnail.png").content == first
    is_problem(own.get("/api/objects/teapot/thumbnail.png"), 404)


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ({"name": "Bad name"}, "lower-case"),
        ({"mass_kg": 50}, "mass_kg"),
        ({"mass_kg": 0}, "mass_kg"),
        ({"scale": 0}, "scale"),
    ],
)
def test_what_no_object_may_be_is_refused_before_anything_is_kept(own, query, word):
    answer = send(own, glb(), **query)
    is_problem(answer, 422)
    assert word in answer.text
    assert own.get("/api/jobs?limit=1").status_code == 200


def test_names_of_the_catalogue_and_objects_of_it_stay(own):
    is_problem(send(own, glb(), name="006_mustard_bottle"), 422)
    is_problem(own.delete("/api/objects/006_mustard_bottle"), 409)
    is_problem(own.delete("/api/objects/teapot"), 404)


def test_what_is_no_mesh_is_refused_at_once(own):
    for content in (b"", b"hello", b"\x89PNG\r\n\x1a\n", b"PK\x03\x04 and nothing"):
        answer = send(own, content)
        is_problem(answer, 422)
        assert answer.json()["detail"].startswith("The uploaded file")
    is_problem(send(own, b"hello", file_name="photo.jpg"), 422)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "kind", "words"),
    [
        (lambda: glb((60.0, 84.0, 10.0)), GLB, ("84 m", "millimetres")),
        (lambda: glb((6.0, 8.4, 10.0)), GLB, ("10 m", "centimetres")),
        (lambda: glb((0.001, 0.001, 0.002)), GLB, ("2 mm",)),
        (lambda: glb()[:400], GLB, ("uploaded mesh", "damaged")),
        (lambda: zipped({"readme.txt": "no mesh"}), ZIP, ("holds no mesh", "GLB")),
        (lambda: zipped({**obj_files(), "other.obj": ""}), ZIP, ("2 meshes", "other.obj")),
        (lambda: zipped(obj_files("lost.png")), ZIP, ("lost.png",)),
        (lambda: zipped(obj_files("../../../../../../etc/passwd")), ZIP, ("passwd", "did not come")),
        (lambda: zipped({"../box.obj": "", **obj_files()}), ZIP, ("meshes",)),
        (lambda: zipped({"../evil.png": "", **obj_files()}), ZIP, ("leads out",)),
        (lambda: zipped({**obj_files(), "bomb.bin": bytes(200_000_000)}), ZIP, ("unpack to", "times")),
        (lambda: zipped({"flat.obj": "v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 3\n"}), ZIP, ("flat",)),
        (lambda: zipped({"none.obj": "v 0 0 0\n"}), ZIP, ("triangle",)),
    ],
)
def test_a_mesh_that_cannot_be_used_is_told_in_one_sentence(own, content, kind, words):
    sentence = refused(own, content(), kind, name="hostile")
    assert all(word in sentence for word in words), sentence
    assert sentence.endswith(".")
    is_problem(own.get("/api/objects/hostile"), 404)
    assert own.get("/api/health").json()["status"] == "ok"


@pytest.mark.slow
def test_a_glb_that_points_to_files_of_the_server_reads_none_of_them(own, tmp_path):
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(36))
    description = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": str(secret)}],
    }
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    content = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text
    refused(own, content, name="thief")
