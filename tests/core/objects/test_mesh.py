import numpy as np
import pytest
import trimesh

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.objects.mesh import read_mesh, textured_mesh

TEXTURE = np.full((8, 8, 3), 100, np.uint8)


def as_textured(mesh: trimesh.Trimesh):
    uv = np.random.default_rng(0).random((len(mesh.vertices), 2))
    return textured_mesh(mesh.vertices, mesh.faces, uv, TEXTURE, "mesh")


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_object_frame_is_the_centre_of_the_bounding_box():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    box.apply_translation((1, -2, 3))
    mesh = as_textured(box)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (0.05, 0.03, 0.02), atol=1e-7)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), (-0.05, -0.03, -0.02), atol=1e-7)


def test_dtypes():
    mesh = as_textured(trimesh.creation.icosphere(1, 0.05))
    assert mesh.vertices.dtype == mesh.normals.dtype == mesh.uv.dtype == np.float32
    assert mesh.faces.dtype == np.int32
    assert mesh.texture.dtype == np.uint8


def test_unused_vertices_do_not_move_the_frame():
    ball = trimesh.creation.icosphere(2, 0.05)
    vertices = np.vstack([ball.vertices, [[5.0, 5, 5]]])
    mesh = textured_mesh(vertices, ball.faces, np.zeros((len(vertices), 2)), TEXTURE, "mesh")
    assert np.abs(mesh.vertices).max() == pytest.approx(0.05, rel=1e-3)


def test_normals_of_a_sphere_point_away_from_its_centre_across_seams():
    ball = trimesh.creation.icosphere(3, 0.05)
    split = trimesh.Trimesh(
        ball.vertices[ball.faces].reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3), process=False
    )
    mesh = as_textured(split)
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
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normals, mesh.normals[mesh.faces[:, 0]]) > 0).all(), centre.shape


def test_a_box_keeps_flat_faces_and_sharp_edges():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    mesh = textured_mesh(box.vertices, box.faces, np.zeros((8, 2)), np.zeros((2, 2, 3), np.uint8), "box")
    assert len(mesh.vertices) == 24
    assert np.allclose(np.abs(mesh.normals).max(axis=1), 1)
    outside = np.einsum("ij,ij->i", mesh.normals, mesh.vertices)
    assert (outside > 0).all()


def test_degenerate_triangles_are_dropped():
    ball = trimesh.creation.icosphere(1, 0.05)
    faces = np.vstack([ball.faces, [[0, 0, 1], [2, 2, 2]]])
    mesh = textured_mesh(ball.vertices, faces, np.zeros((len(ball.vertices), 2)), TEXTURE, "mesh")
    assert len(mesh.faces) == len(ball.faces)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize(("size", "hint"), [(100.0, "100 x 100 x 100.*millimetres"), (1e-3, "another unit")])
def test_absurd_sizes_name_the_size_and_hint_at_units(size, hint):
    with pytest.raises(InvalidInput, match=hint):
        as_textured(trimesh.creation.box((size, size, size)))


def test_unusable_geometry_is_refused():
    ball = trimesh.creation.icosphere(1, 0.05)
    uv = np.zeros((len(ball.vertices), 2))
    vertices = np.array(ball.vertices)
    with pytest.raises(CorruptFile, match="no triangles"):
        textured_mesh(vertices, ball.faces[:0], uv, TEXTURE, "mesh")
    with pytest.raises(CorruptFile, match="do not exist"):
        textured_mesh(vertices, ball.faces + 1000, uv, TEXTURE, "mesh")
    with pytest.raises(CorruptFile, match="flat"):
        textured_mesh(vertices * [1, 1, 0], ball.faces, uv, TEXTURE, "mesh")
    vertices[3] = np.nan
    with pytest.raises(CorruptFile, match="finite"):
        textured_mesh(vertices, ball.faces, uv, TEXTURE, "mesh")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.obj", b""),
        ("points.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 0\n"),
        ("nan.obj", b"v nan 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 3\n"),
        ("index.obj", b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 9\n"),
        ("garbage.glb", b"garbage" * 20),
        ("header.glb", b"glTF\x02\x00\x00\x00\xff\xff\x00\x00"),
        ("garbage.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 99\n"),
        ("garbage.stl", b"\x00" * 50),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CorruptFile, match=name):
        read_mesh(path)


def test_missing_files_and_unknown_kinds_are_refused(tmp_path):
    with pytest.raises(InvalidInput, match="exists"):
        read_mesh(tmp_path / "none.obj")
    with pytest.raises(InvalidInput, match=r"\.glb"):
        read_mesh(tmp_path / "none.txt")


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_formats_agree_and_glb_is_turned_upright(tmp_path, suffix):
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    if suffix == "glb":
        box.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))  # z up to y up
    box.export(tmp_path / f"box.{suffix}")
    mesh = read_mesh(tmp_path / f"box.{suffix}")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.1, 0.06, 0.04), atol=1e-6)
    assert volume(mesh) == pytest.approx(0.1 * 0.06 * 0.04, rel=1e-4)


def test_glb_keeps_what_was_on_top(tmp_path):
    cone = trimesh.creation.cone(0.03, 0.1)  # tip up along z; in GLB that is y
    cone.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    cone.export(tmp_path / "cone.glb")
    mesh = read_mesh(tmp_path / "cone.glb")
    tip = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    assert np.linalg.norm(tip[:2]) < 1e-6


def test_scale_converts_units(tmp_path):
    trimesh.creation.box((100, 60, 40)).export(tmp_path / "box.obj")
    mesh = read_mesh(tmp_path / "box.obj", scale=1e-3)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.1, 0.06, 0.04), atol=1e-6)


def test_a_scan_is_right_way_up_and_in_its_colours(library):
    mesh = library.load("006_mustard_bottle").mesh
    v = mesh.vertices
    cap, body = v[v[:, 2] > 0.08], v[v[:, 2] < 0.0]
    assert np.ptp(cap[:, 0]) < 0.5 * np.ptp(body[:, 0])  # the narrow cap is on top
    height, width = mesh.texture.shape[:2]
    texels = np.floor(np.stack([(1 - mesh.uv[:, 1]) * height, mesh.uv[:, 0] * width])).astype(int)
    colours = mesh.texture[np.clip(texels[0], 0, height - 1), np.clip(texels[1], 0, width - 1)].astype(float)
    red, green, blue = np.median(colours, axis=0)
    assert red > 150
    assert blue < 0.4 * green  # mustard yellow: channels in RGB order, v the right way round
