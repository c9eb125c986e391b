import base64
import json
import zipfile
from urllib.parse import quote

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.poses import quaternion_conjugate, rotate
from osfcore.objects.mesh import WrongMeshSize, clean_texture, read_mesh, read_msh, resting_poses, textured_mesh
from tests.core.objects.meshes import (
    BOX,
    COLOURS,
    CORNERS,
    PALETTE,
    SIDE,
    STRIP,
    UV,
    encoded,
    glb,
    gltf,
    msh_bytes,
    obj,
    ply,
    ply_of_quads,
)
from tests.support.errors import about

TEXTURE = np.full((8, 8, 3), 100, np.uint8)


def as_textured(mesh: trimesh.Trimesh):
    uv = np.random.default_rng(0).random((len(mesh.vertices), 2))
    return textured_mesh(mesh.vertices, mesh.faces, uv, TEXTURE, "mesh")


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_the_frame_is_the_centre_of_the_bounding_box_of_the_triangles_that_have_an_area():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    vertices = np.vstack([box.vertices, [[5.0, 5, 5]]]) + (1, -2, 3)  # no face names the last one
    faces = np.vstack([box.faces, [[0, 0, 1], [2, 2, 2]]])
    mesh = textured_mesh(vertices, faces, np.zeros((9, 2)), TEXTURE, "mesh")
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (0.05, 0.03, 0.02), atol=1e-7)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), (-0.05, -0.03, -0.02), atol=1e-7)
    assert len(mesh.faces) == 12
    assert len(mesh.vertices) == 24  # three for each corner: flat faces and sharp edges
    np.testing.assert_allclose(np.abs(mesh.normals).max(axis=1), 1)
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices) > 0).all()


def test_normals_of_a_sphere_point_away_from_its_centre_across_seams():
    corners = trimesh.creation.icosphere(3, 0.05).triangles.reshape(-1, 3)
    mesh = as_textured(trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False))
    cosine = np.einsum("ij,ij->i", mesh.normals, mesh.vertices) / 0.05
    assert cosine.min() > 0.999


@pytest.mark.parametrize("broken", ["inverted", "some faces", "two bodies"])
def test_winding_becomes_outward(broken):
    ball = trimesh.creation.icosphere(2, 0.04)
    other = trimesh.creation.icosphere(2, 0.02)
    other.apply_translation((0.1, 0, 0))
    expected = ball.volume
    faces = ball.faces.copy()
    if broken == "inverted":
        faces = faces[:, ::-1]
    elif broken == "some faces":
        faces[::3] = faces[::3, ::-1]
    body = trimesh.Trimesh(ball.vertices, faces, process=False)
    if broken == "two bodies":
        expected += other.volume
        other.invert()
        body = trimesh.util.concatenate([body, other])
    mesh = as_textured(body)
    assert volume(mesh) == pytest.approx(expected, rel=1e-4)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normals, mesh.normals[mesh.faces[:, 0]]) > 0).all()


@pytest.mark.parametrize("size", [100.0, 1e-3])
def test_absurd_sizes_are_refused(size):
    with pytest.raises(WrongMeshSize) as caught:
        as_textured(trimesh.creation.box((size, size, size)))
    assert caught.value.longest_m == pytest.approx(size)


def test_unusable_geometry_is_refused():
    ball = trimesh.creation.icosphere(1, 0.05)
    flat, endless = ball.vertices * [1, 1, 0], np.where(ball.vertices > 0.04, np.nan, ball.vertices)
    wrong_faces = ((ball.vertices, faces) for faces in (ball.faces[:0], ball.faces + 1000))
    for vertices, faces in (*wrong_faces, (flat, ball.faces), (endless, ball.faces)):
        with pytest.raises(CorruptFile):
            textured_mesh(vertices, faces, np.zeros((len(vertices), 2)), TEXTURE, "mesh")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.obj", b""),
        ("index.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 9\n"),
        ("garbage.glb", b"garbage" * 20),
        ("garbage.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 99\n"),
        ("garbage.stl", b"\x00" * 50),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CorruptFile, check=about(name)):
        read_mesh(path)
    with pytest.raises(InvalidInput):
        read_mesh(tmp_path / "none.obj")
    with pytest.raises(InvalidInput):
        read_mesh(path.rename(tmp_path / "mesh.txt"))


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_formats_agree_in_any_unit_and_glb_is_turned_upright(tmp_path, suffix):
    cone = trimesh.creation.cone(30, 100, sections=64)  # tip up along z
    if suffix == "glb":
        cone.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))  # z up to y up
    cone.export(tmp_path / f"cone.{suffix}")
    mesh = read_mesh(tmp_path / f"cone.{suffix}", scale=1e-3)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.06, 0.06, 0.1), atol=1e-6)
    assert volume(mesh) == pytest.approx(cone.volume * 1e-9, rel=1e-3)
    assert np.linalg.norm(mesh.vertices[np.argmax(mesh.vertices[:, 2])][:2]) < 1e-6


RNG = np.random.default_rng(3)


def colours_on_faces(mesh, weights):
    """Bilinear colours at one place of each face."""
    uv = np.einsum("k,fkc->fc", weights, mesh.uv[mesh.faces])
    height, width = mesh.texture.shape[:2]
    x, y = (uv[:, 0] * width - 0.5).astype(np.float32), ((1 - uv[:, 1]) * height - 0.5).astype(np.float32)
    return cv2.remap(mesh.texture, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]


def sides(mesh) -> np.ndarray:
    """The colours of the middles of the sides of the box, in the order of `NAMES`."""
    normals = mesh.normals[mesh.faces].mean(axis=1)
    colours = colours_on_faces(mesh, np.full(3, 1 / 3)).astype(float)
    axes = np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(-1, 3)
    return np.array([colours[normals @ axis > 0.9].mean(axis=0) for axis in axes])


def turned(colours):
    """Colours of sides as glTF names them, y up, by our axes, z up."""
    return np.asarray(colours)[[0, 1, 5, 4, 2, 3]]


def read_glb(folder, attributes, material=None, image=None, **tree):
    path = folder / "mesh.glb"
    path.write_bytes(glb(*gltf({"POSITION": CORNERS, **attributes}, material, image, **tree)))
    return read_mesh(path)


def srgb(linear):
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear(shown):
    return np.where(shown <= 0.04045 * 255, shown / 255 / 12.92, ((shown / 255 + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("kind", ["vertex_colors", "face_colors"])
def test_baked_colours_come_back_by_bilinear_sampling(tmp_path, kind):
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    colours = RNG.integers(0, 256, (8 if kind == "vertex_colors" else 12, 4)).astype(np.uint8)
    setattr(box.visual, kind, colours)
    box.export(tmp_path / "box.ply")
    mesh = read_mesh(tmp_path / "box.ply")
    places = mesh.vertices[mesh.faces]
    if kind == "vertex_colors":
        nearest = np.linalg.norm(places[:, :, None] - box.vertices, axis=-1).argmin(axis=2)
        corners = colours[nearest][..., :3].astype(float)
    else:
        nearest = np.linalg.norm(places.mean(axis=1)[:, None] - box.triangles_center, axis=-1).argmin(axis=1)
        corners = np.repeat(colours[nearest][:, None, :3], 3, axis=1).astype(float)
    for weights in (np.array([1.0, 0, 0]), np.array([0.2, 0.5, 0.3]), np.array([0, 0.5, 0.5])):
        expected = np.einsum("k,fkc->fc", weights, corners)
        assert np.abs(colours_on_faces(mesh, weights) - expected).max() < 8  # remap interpolates in steps of 1/32


BASE = {"baseColorTexture": {"index": 0}}
BLACK = {"baseColorFactor": [0, 0, 0, 1]}
IMAGE = {"pbrMetallicRoughness": BASE}
GOLD = {"diffuseFactor": [0, 0, 0, 1], "specularFactor": [1, 0.8, 0.3]}
GLOSS = {"diffuseFactor": [1, 0.2, 1, 1], "diffuseTexture": {"index": 0}}


@pytest.mark.parametrize(
    ("attributes", "material", "has_image", "factor"),
    [
        ({}, None, False, (1, 1, 1)),
        ({}, {"pbrMetallicRoughness": {"metallicFactor": 0}}, False, (1, 1, 1)),
        ({}, {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.25, 0, 1]}}, False, (0.5, 0.25, 0)),
        ({}, {"pbrMetallicRoughness": BASE | {"baseColorFactor": [0.5, 1, 1, 1]}}, True, (0.5, 1, 1)),
        ({}, IMAGE | {"extensions": {"KHR_materials_unlit": {}}}, True, (1, 1, 1)),
        ({}, {"extensions": {"KHR_materials_pbrSpecularGlossiness": GLOSS}}, True, (1, 0.2, 1)),
        ({}, {"extensions": {"KHR_materials_pbrSpecularGlossiness": GOLD}}, False, (1, 0.8, 0.3)),
        ({}, {"emissiveFactor": [1, 1, 0.5], "emissiveTexture": {"index": 0}}, True, (1, 1, 0.5)),
        ({}, {"pbrMetallicRoughness": BLACK, "emissiveFactor": [1, 0.5, 0]}, False, (1, 0.5, 0)),
        ({"COLOR_0": np.full((36, 4), 51, np.uint8)}, None, False, (0.2, 0.2, 0.2)),
        ({"COLOR_0": np.full((36, 4), 13107, np.uint16)}, {"alphaMode": "BLEND"}, False, (0.2, 0.2, 0.2)),
        ({"COLOR_0": np.full((36, 3), 0.2, np.float32)}, IMAGE, True, (0.2, 0.2, 0.2)),
    ],
)  # fmt: skip
def test_colours_of_gltf_multiply_in_linear_light(tmp_path, attributes, material, has_image, factor):
    mesh = read_glb(tmp_path, {"TEXCOORD_0": UV, **attributes}, material, encoded(STRIP) if has_image else None)
    base = turned(PALETTE) if has_image else np.full((6, 3), 255)
    np.testing.assert_allclose(sides(mesh), srgb(linear(base) * factor), atol=1)


@pytest.mark.parametrize("material", [None, {"name": "vertex colours"}, {"pbrMetallicRoughness": {}}])
def test_vertex_colours_of_gltf_stay_beside_a_material(tmp_path, material):
    mesh = read_glb(tmp_path, {"COLOR_0": COLOURS}, material)
    np.testing.assert_allclose(sides(mesh), turned(PALETTE), atol=1)


def test_vertex_colours_shade_an_image_within_each_face(tmp_path):
    shade = np.where(CORNERS[:, 1:2] > 0, 1, 0.25) * np.ones(3)
    mesh = read_glb(tmp_path, {"TEXCOORD_0": UV, "COLOR_0": shade.astype(np.float32)}, IMAGE, encoded(STRIP))
    for weights in np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.3, 0.3, 0.4]]):
        height = (mesh.vertices[mesh.faces][..., 2] > 0) @ weights
        np.testing.assert_allclose(colours_on_faces(mesh, weights).max(axis=1), srgb(0.25 + 0.75 * height), atol=3)


def wholes(fractions, kind):
    return np.round(fractions * np.iinfo(kind).max).astype(kind)


TRANSFORM = {"offset": [0.5, 0.25], "scale": [2, 0.5], "rotation": np.pi / 2}


def transformed(uv):
    """Coordinates that TRANSFORM brings back to the given ones."""
    return np.column_stack([(0.25 - uv[:, 1]) / 2, (uv[:, 0] - 0.5) / 0.5]).astype(np.float32)


def textured(**info):
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **info}}}


def extended(**values):
    return textured(extensions={"KHR_texture_transform": values})


ELSEWHERE = np.zeros((36, 2), np.float32)


@pytest.mark.parametrize(
    ("attributes", "material"),
    [
        ({"TEXCOORD_0": UV + 7}, textured()),
        ({"TEXCOORD_0": wholes(UV, np.uint16)}, textured()),
        ({"TEXCOORD_0": wholes(UV / 2, np.uint16)}, extended(scale=[2, 2])),
        ({"TEXCOORD_0": transformed(UV)}, extended(**TRANSFORM)),
        ({"TEXCOORD_0": ELSEWHERE, "TEXCOORD_1": UV}, textured(texCoord=1)),
        ({"TEXCOORD_0": ELSEWHERE, "TEXCOORD_1": UV}, extended(texCoord=1)),
    ],
)
def test_texture_coordinates_of_gltf_are_found_in_any_form(tmp_path, attributes, material):
    mesh = read_glb(tmp_path, attributes, material, encoded(STRIP), extensionsRequired=["KHR_texture_transform"])
    np.testing.assert_allclose(sides(mesh), turned(PALETTE), atol=1)


@pytest.mark.parametrize(("wrap", "u"), [("REPEAT", UV[:, 0] - 3), ("MIRRORED", 2 - UV[:, 0]), ("CLAMP", UV[:, 0])])
def test_textures_are_wrapped_as_their_sampler_says(tmp_path, wrap, u):
    code = {"REPEAT": 10497, "MIRRORED": 33648, "CLAMP": 33071}[wrap]
    uv = np.column_stack([u, UV[:, 1]]).astype(np.float32)
    tables = {"samplers": [{"wrapS": code, "wrapT": 33071}], "textures": [{"source": 0, "sampler": 0}]}
    mesh = read_glb(tmp_path, {"TEXCOORD_0": uv}, IMAGE, encoded(STRIP), **tables)
    np.testing.assert_allclose(sides(mesh), turned(PALETTE), atol=1)


def test_quantised_positions_and_nested_nodes(tmp_path):
    nodes = [{"children": [1], "translation": [5, 0, 0]}, {"mesh": 0, "scale": [0.1 / 32767] * 3}]
    positions = np.round(CORNERS / 0.1 * 32767).astype(np.int16)
    packed = np.zeros((36, 4), np.int16)
    packed[:, :3] = positions
    description, buffer = gltf({"POSITION": CORNERS, "COLOR_0": COLOURS}, nodes=nodes)
    description["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(buffer), "byteLength": packed.nbytes, "byteStride": 8}
    )
    description["accessors"][0] |= {"bufferView": 2, "componentType": 5122}
    (tmp_path / "a.glb").write_bytes(glb(description, buffer + packed.tobytes()))
    mesh = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.1, 0.04, 0.06), atol=1e-5)
    description["accessors"][0]["normalized"] = True
    nodes[1]["scale"] = [0.1] * 3
    (tmp_path / "a.glb").write_bytes(glb(description, buffer + packed.tobytes()))
    mesh = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.1, 0.04, 0.06), atol=1e-5)
    np.testing.assert_allclose(sides(mesh), turned(PALETTE), atol=1)


def test_a_sparse_accessor_replaces_some_numbers(tmp_path):
    description, buffer = gltf({"POSITION": CORNERS, "COLOR_0": np.zeros((36, 3), np.float32)})
    changed = np.flatnonzero(SIDE == 0).astype(np.uint16)
    values = np.repeat(np.float32([[0, 1, 0]]), len(changed), axis=0)
    for data in (changed, values):
        view = {"buffer": 0, "byteOffset": len(buffer), "byteLength": data.nbytes}
        description["bufferViews"].append(view)
        buffer += data.tobytes() + bytes(-data.nbytes % 4)
    indices, view = {"bufferView": 2, "componentType": 5123}, {"bufferView": 3}
    description["accessors"][1]["sparse"] = {"count": len(changed), "indices": indices, "values": view}
    (tmp_path / "a.glb").write_bytes(glb(description, buffer))
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "a.glb")), turned([[0, 255, 0], *[[0, 0, 0]] * 5]), atol=1)


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 2, 3, 2, 1]), (6, [0, 1, 3, 2])], ids=["strip", "fan"])
def test_strips_and_fans_are_triangles(tmp_path, mode, order):
    corners = np.float32([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.02], [0.1, 0.1, 0]])[order]
    description, buffer = gltf({"POSITION": corners})
    description["meshes"][0]["primitives"][0]["mode"] = mode
    (tmp_path / "a.glb").write_bytes(glb(description, buffer))
    mesh = read_mesh(tmp_path / "a.glb")
    areas = np.linalg.norm(np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).transpose(1, 0, 2)), axis=1) / 2
    assert len(mesh.faces) >= 2
    assert areas.max() < 0.0075


@pytest.mark.parametrize("name", [None, "textures/my t\u00e4x.png", " my  t.png"])
def test_gltf_with_its_buffer_and_image_outside(tmp_path, name):
    description, buffer = gltf({"POSITION": CORNERS, "TEXCOORD_0": UV}, IMAGE, encoded(STRIP))
    if name is None:
        contents = (buffer, encoded(STRIP))
        addresses = [f"data:application/octet-stream;base64,{base64.b64encode(d).decode()}" for d in contents]
    else:
        addresses = ["scene.bin", quote(name)]
        put(tmp_path, {"scene.bin": buffer, name: encoded(STRIP)})
    description["buffers"], description["images"] = [{"uri": addresses[0]}], [{"uri": addresses[1]}]
    (tmp_path / "scene.gltf").write_text(json.dumps(description))
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "scene.gltf")), turned(PALETTE), atol=1)


@pytest.mark.parametrize(
    ("required", "word"),
    [
        ("KHR_draco_mesh_compression", "Draco"),
        ("EXT_meshopt_compression", "Meshopt"),
        ("KHR_texture_basisu", "KTX2"),
        ("EXT_mesh_gpu_instancing", "EXT_mesh_gpu_instancing"),
    ],
)
def test_what_a_gltf_needs_and_nobody_reads_is_named(tmp_path, required, word):
    with pytest.raises(CorruptFile, check=about(word)):
        read_glb(tmp_path, {}, extensionsRequired=[required])


def test_compressed_triangles_and_damaged_images_are_refused(tmp_path):
    description, buffer = gltf({"POSITION": CORNERS})
    del description["accessors"][0]["bufferView"]
    for used, word in (([], "compressed"), (["KHR_draco_mesh_compression"], "Draco")):
        (tmp_path / "a.glb").write_bytes(glb(description | {"extensionsUsed": used}, buffer))
        with pytest.raises(CorruptFile, check=about(word)):
            read_mesh(tmp_path / "a.glb")
    with pytest.raises(CorruptFile, check=about("texture")):
        read_glb(tmp_path, {"TEXCOORD_0": UV}, IMAGE, b"\x89PNG\r\n\x1a\n and no more")


@pytest.mark.parametrize("image", [None, encoded(np.full((8, 8, 3), (10, 200, 30)))])
def test_coordinates_do_not_matter_where_there_is_one_colour(tmp_path, image):
    material = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]} | (BASE if image else {})}
    mesh = read_glb(tmp_path, {"TEXCOORD_0": UV * 70000}, material, image)
    np.testing.assert_allclose(sides(mesh), [(10, 200, 30) if image else (255, 255, 255)] * 6, atol=1)


@pytest.mark.parametrize(("texels_each", "place"), [(1, 0.5), (4, 0.4)])
def test_sides_that_take_one_colour_each_of_a_palette_keep_it(tmp_path, texels_each, place):
    palette = np.repeat(PALETTE[None], texels_each, axis=1)
    uv = np.column_stack([(SIDE + place) / 6, np.full(36, 0.5)]).astype(np.float32)
    mesh = read_glb(tmp_path, {"TEXCOORD_0": uv}, IMAGE, encoded(palette))
    np.testing.assert_allclose(sides(mesh), turned(PALETTE), atol=1)


def test_repeated_textures_are_tiled(tmp_path):
    ramp = np.zeros((16, 16, 3), np.uint8)
    ramp[..., 0] = np.arange(16) * 15
    uv = (CORNERS[:, :2] * 25 - 0.7).astype(np.float32)  # 2.5 times along x
    mesh = read_glb(tmp_path, {"TEXCOORD_0": uv}, IMAGE, encoded(ramp))
    assert 0 <= mesh.uv.min() <= mesh.uv.max() <= 1
    u = (mesh.vertices[mesh.faces].mean(axis=1)[:, 0] * 25 - 0.7) % 1
    got = colours_on_faces(mesh, np.full(3, 1 / 3))[:, 0]
    is_spread = np.abs(mesh.normals[mesh.faces].mean(axis=1)[:, 1]) > 0.9  # on the others the texture is a line
    inner = is_spread & (u > 0.1) & (u < 0.9)  # near the wrap the ramp jumps
    assert inner.any()
    np.testing.assert_allclose(got[inner], u[inner] * 240 - 7.5, atol=8)
    with pytest.raises(InvalidInput, check=about("repeats")):
        read_glb(tmp_path, {"TEXCOORD_0": uv * 1000}, IMAGE, encoded(ramp))


def put(folder, files):
    """Write files of an OBJ; return the OBJ."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder / next(iter(files))


@pytest.mark.parametrize(
    "files",
    [
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd t.png\n", "t.png": encoded(STRIP)},
        {"a.obj": obj(), "M.MTL": "newmtl a\nKd 0 0 0\nmap_kd T.PNG\n", "t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd -s 1 1 1 -o 0 0 0 -bm 1 t.png\n", "t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd -clamp on -s 1 1 my t.png\n", "my t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd C:\\x\\T.png\n", "tex/t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd t\u00e4.png\n", "ta\u0308.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd t\u00e4.tif\n".encode("cp1252"),
         "t\u00e4.tif": encoded(STRIP, "TIFF")},
        {"a.obj": obj(head="# mtllib x\nmtllib m.mtl n.mtl\nusemtl a\n"), "n.mtl": "newmtl a\nmap_Kd t.png\n",
         "m.mtl": "newmtl b\n", "t.png": encoded(STRIP)},
        {"a.obj": "\ufeff" + obj().replace("\n", "\r").replace(" ", "\t"), "m.mtl": "newmtl a\rmap_Kd t.png\r",
         "t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd t.png # of the front\n", "t.png": encoded(STRIP)},
        {"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd -colorspace sRGB -s 1 1 1 t.png\n", "t.png": encoded(STRIP)},
        {"a.obj": obj().encode("utf-16"), "m.mtl": "newmtl a\nmap_Kd t.png\n".encode("utf-16"),
         "t.png": encoded(STRIP)},
    ],
    ids=["plain", "case", "options", "spaces", "windows", "decomposed", "cp1252", "two libraries", "cr", "comment",
         "colorspace", "utf-16"],
)  # fmt: skip
def test_textures_of_obj_are_found_as_programs_name_them(tmp_path, files):
    np.testing.assert_allclose(sides(read_mesh(put(tmp_path, files))), PALETTE, atol=1)


def test_scale_and_offset_of_a_texture_of_obj_are_honoured(tmp_path):
    library, uv = "newmtl a\nmap_Kd -s 2 1 1 -o 0.25 0 t.png\n", np.column_stack([(UV[:, 0] - 0.25) / 2, UV[:, 1]])
    path = put(tmp_path, {"a.obj": obj(uv=uv), "m.mtl": library, "t.png": encoded(STRIP)})
    np.testing.assert_allclose(sides(read_mesh(path)), PALETTE, atol=1)


@pytest.mark.parametrize(
    ("library", "factor"), [("Kd 1 1 1", (1, 1, 1)), ("Kd 0.5 1 1", (0.5, 1, 1)), ("Ka 1 1 1", (1, 1, 1))]
)
def test_vertex_colours_of_obj_are_multiplied_by_their_material(tmp_path, library, factor):
    for top in (1, 255):
        path = put(tmp_path, {"a.obj": obj(COLOURS / 255 * top), "m.mtl": f"newmtl a\n{library}\n"})
        np.testing.assert_allclose(sides(read_mesh(path)), PALETTE * factor, atol=1)


def test_each_material_of_an_obj_keeps_its_colour(tmp_path):
    lines = obj(head="mtllib m.mtl\n").splitlines()
    faces = [f"usemtl m{SIDE[3 * i]}\n{line}" for i, line in enumerate(line for line in lines if line[0] == "f")]
    text = "\n".join([line for line in lines if line[0] != "f"] + faces)
    library = "".join(f"newmtl m{i}\nKd {r / 255} {g / 255} {b / 255}\n" for i, (r, g, b) in enumerate(PALETTE[:5]))
    library += "newmtl m5\nmap_Kd t.png\n"
    path = put(tmp_path, {"a.obj": text, "m.mtl": library, "t.png": encoded(STRIP)})
    np.testing.assert_allclose(sides(read_mesh(path)), PALETTE, atol=1)


def test_negative_indices_of_obj_count_back_from_where_they_stand(tmp_path):
    parts = [
        "".join(f"v {x:f} {y:f} {z:f}\n" for x, y, z in CORNERS[i : i + 3]) + "f -3 -2 -1\n" for i in range(0, 36, 3)
    ]
    (tmp_path / "a.obj").write_text("".join(parts))
    np.testing.assert_allclose(np.ptp(read_mesh(tmp_path / "a.obj").vertices, axis=0), (0.1, 0.06, 0.04), atol=1e-5)


@pytest.mark.parametrize(
    ("files", "missing"),
    [
        ({"a.obj": obj()}, "m.mtl"),
        ({"a.obj": obj(), "m.mtl": "newmtl a\nmap_Kd -s 1 1 1 C:\\x\\lost.png\n"}, "lost.png"),
        ({"a.ply": ply().replace(b"element vertex", b"comment TextureFile lost.png\nelement vertex")}, "lost.png"),
        ({"a.gltf": json.dumps(gltf({"POSITION": CORNERS}, buffers=[{"uri": "lost.bin"}])[0])}, "lost.bin"),
    ],
)
def test_what_is_missing_beside_a_mesh_is_named(tmp_path, files, missing):
    with pytest.raises(CorruptFile, check=about(missing)):
        read_mesh(put(tmp_path, files))


def test_of_several_libraries_of_an_obj_the_missing_ones_are_named(tmp_path):
    files = {"a.obj": obj(head="mtllib it\\ is\\ here.mtl gone.mtl\n"), "it is here.mtl": "newmtl a\n"}
    with pytest.raises(CorruptFile, check=about("gone.mtl")) as caught:
        read_mesh(put(tmp_path, files))
    assert "here.mtl" not in str(caught.value)


@pytest.mark.parametrize("is_binary", [False, True])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_ply_with_any_line_ends_keeps_its_colours(tmp_path, line_end, is_binary):
    (tmp_path / "a.ply").write_bytes(ply(line_end, is_binary))
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "a.ply")), PALETTE, atol=1)


@pytest.mark.parametrize("is_binary", [False, True])
@pytest.mark.parametrize(
    ("names", "kind", "most"),
    [
        (("red", "green", "blue"), "float", 1),
        (("red", "green", "blue"), "float", 255),
        (("red", "green", "blue"), "ushort", 65535),
        (("diffuse_red", "diffuse_green", "diffuse_blue"), "uchar", 255),
        (("r", "g", "b"), "int", 255),
    ],
)
def test_colours_of_ply_in_any_unit_and_of_faces_with_four_corners(tmp_path, names, kind, most, is_binary):
    (tmp_path / "a.ply").write_bytes(ply_of_quads(names, kind, most, is_binary))
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "a.ply")), PALETTE, atol=1)


@pytest.mark.parametrize(
    ("attributes", "material"),
    [
        ({"COLOR_0": np.full((36, 3), np.nan, np.float32)}, None),
        ({}, {"pbrMetallicRoughness": {"baseColorFactor": [float("inf"), 0, 0, 1]}}),
        ({"POSITION": np.where(CORNERS > 0, np.inf, CORNERS)}, None),
    ],
)
def test_numbers_that_are_not_finite_are_refused(tmp_path, attributes, material):
    with pytest.raises(CorruptFile, check=about("finite")):
        read_glb(tmp_path, attributes, material)


@pytest.mark.parametrize("is_magics", [False, True])
def test_colours_of_binary_stl(tmp_path, is_magics):
    red, green, blue = (COLOURS[::3] >> 3).astype(int).T
    faces = np.zeros(12, [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    faces["v"] = CORNERS.reshape(-1, 3, 3)
    faces["a"] = (red | green << 5 | blue << 10) if is_magics else (0x8000 | blue | green << 5 | red << 10)
    head = b"COLOR=\x80\x80\x80\xff" if is_magics else b"made by hand"
    (tmp_path / "a.stl").write_bytes(head.ljust(80) + np.uint32(12).tobytes() + faces.tobytes())
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "a.stl")), PALETTE, atol=1)


def test_a_zip_is_read_as_its_mesh_and_stays(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("d/without_colours.ply", BOX.export(file_type="ply"))
        for name, content in {"d/a.obj": obj(), "d/m.mtl": "newmtl a\nmap_Kd t.png\n", "t.png": encoded(STRIP)}.items():
            archive.writestr(name, content)
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "a.zip")), PALETTE, atol=1)
    (tmp_path / "b.zip").write_bytes(glb(*gltf({"POSITION": CORNERS, "COLOR_0": COLOURS})))
    np.testing.assert_allclose(sides(read_mesh(tmp_path / "b.zip")), turned(PALETTE), atol=1)
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip", "b.zip"}


SQUARE_UV = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def test_black_background_never_reaches_any_mip_level():
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[64:192, 64:192] = (200, 150, 100)
    clean = clean_texture(texture, SQUARE_UV, SQUARE)
    level = clean.astype(np.float32)
    while min(level.shape[:2]) > 1:
        assert np.abs(level - (200, 150, 100)).max() <= 2
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def test_reduction_keeps_means_inside_and_ignores_outside():
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[128:384, 128:384] = np.random.default_rng(1).integers(0, 256, (256, 256, 3))
    clean = clean_texture(texture, SQUARE_UV, SQUARE, max_side=128)
    assert clean.shape == (128, 128, 3)
    expected = cv2.resize(texture.astype(np.float32), (128, 128), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(clean[36:92, 36:92], expected[36:92, 36:92], atol=0.51)
    assert clean.min() > 20  # the black background is gone


def test_a_chart_thinner_than_its_rim_keeps_a_colour():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[31:33] = 200
    uv = np.array([[0.0, 0.5], [1.0, 0.5], [1.0, 0.51]])
    clean = clean_texture(texture, uv, np.array([[0, 1, 2]]))
    assert clean[31:33].max() == 200


@pytest.mark.parametrize("normals", [(), np.ones((8, 3))])
def test_msh_files_are_read_with_v_upwards_and_refused_if_truncated_or_without_uv_or_texture(tmp_path, normals):
    path, uv, solid = tmp_path / "a.msh", np.random.default_rng(0).random((8, 2)), BOX.copy()
    whole = msh_bytes(solid.vertices, uv, solid.faces, normals)
    path.write_bytes(whole)
    with pytest.raises(CorruptFile, check=about("a.png")):
        read_msh(path)
    Image.fromarray(TEXTURE).save(tmp_path / "a.png")
    mesh = read_msh(path)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), solid.extents, atol=1e-7)
    corner = np.linalg.norm(mesh.vertices[:, None] - solid.vertices, axis=2).argmin(axis=1)
    np.testing.assert_allclose(mesh.uv, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)[corner], atol=1e-6)
    for damaged in (b"", bytes(200), whole[:-1], whole[:-40], msh_bytes(solid.vertices, uv[:0], solid.faces, normals)):
        path.write_bytes(damaged)
        with pytest.raises(CorruptFile):
            read_msh(path)


def box_parts(sides):
    return (np.array(trimesh.creation.box(sides).vertices),)


def test_a_box_rests_on_each_face():
    sides = np.array([0.10, 0.09, 0.08])
    resting = resting_poses(box_parts(sides))
    assert len(resting.quaternions) == 6
    downs = np.array([rotate(quaternion_conjugate(q), np.array([0, 0, -1.0])) for q in resting.quaternions])
    np.testing.assert_allclose(np.abs(downs).max(axis=1), 1, atol=1e-6)
    assert len({tuple(d.round(3) + 0.0) for d in downs}) == 6
    assert np.abs(downs[0])[2] == pytest.approx(1)  # 10 x 9 cm is the largest face
    assert resting.probabilities.sum() == pytest.approx(1)
    assert (np.diff(resting.probabilities) <= 1e-12).all()


def test_mass_counts_where_the_parts_are():
    block = np.array(trimesh.creation.box((0.1, 0.1, 0.1)).vertices)
    rod = trimesh.creation.box((0.01, 0.01, 0.2))
    rod.apply_translation((0, 0, 0.15))
    resting = resting_poses((block, np.array(rod.vertices)))
    ups = np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])
    assert ups[:, 2].max() == pytest.approx(1)  # standing on the block
    assert (ups[:, 2] > -0.7).all()  # never balanced on the rod
