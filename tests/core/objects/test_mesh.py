import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.poses import quaternion_conjugate, rotate
from osfcore.objects.mesh import (
    WrongMeshSize,
    clean_texture,
    joined,
    piece_of,
    read_mesh,
    read_msh,
    resting_poses,
    textured_mesh,
)
from tests.core.objects.meshes import msh_bytes
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


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((0.1, 0.06, 0.04))


def textured_box(colour, uv=None, size=(8, 8), factor=None) -> trimesh.Trimesh:
    mesh = box()
    image = Image.fromarray(np.broadcast_to(np.array(colour, np.uint8), (*size, 3)).copy())
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, baseColorFactor=factor)
    uv = RNG.random((8, 2)) if uv is None else uv
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return mesh


def colours_on_faces(piece, weights):
    """Bilinear colours at one place of each face."""
    uv = np.einsum("k,fkc->fc", weights, piece.uv[piece.faces])
    height, width = piece.texture.shape[:2]
    x, y = (uv[:, 0] * width - 0.5).astype(np.float32), ((1 - uv[:, 1]) * height - 0.5).astype(np.float32)
    return cv2.remap(piece.texture, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]


@pytest.mark.parametrize("kind", ["vertex_colors", "face_colors"])
def test_baked_colours_come_back_by_bilinear_sampling(kind):
    mesh = box()
    colours = RNG.integers(0, 256, (8 if kind == "vertex_colors" else 12, 4)).astype(np.uint8)
    setattr(mesh.visual, kind, colours)
    piece = piece_of(mesh)
    corners = colours[mesh.faces] if kind == "vertex_colors" else np.repeat(colours[:, None], 3, axis=1)
    for weights in (np.array([1.0, 0, 0]), np.array([0.2, 0.5, 0.3]), np.array([0, 0.5, 0.5])):
        expected = np.einsum("k,fkc->fc", weights, corners[..., :3].astype(float))
        assert np.abs(colours_on_faces(piece, weights) - expected).max() < 8  # remap interpolates in steps of 1/32


def test_a_colour_factor_darkens_the_image_and_a_mesh_without_colours_is_grey():
    piece = piece_of(textured_box((200, 100, 50), factor=[0.5, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(piece.texture[0, 0], (100, 100, 50), atol=1)
    assert len(np.unique(piece_of(box()).texture)) == 1


def test_joined_pieces_keep_their_colours():
    colours = [(200, 10, 20), (20, 200, 10), (200, 10, 20)]
    pieces = [piece_of(textured_box(c, size=s)) for c, s in zip(colours, [(8, 8), (32, 16), (8, 8)], strict=True)]
    whole = joined(pieces)
    assert len(whole.faces) == 36
    got = colours_on_faces(whole, np.array([0.2, 0.3, 0.5])).reshape(3, 12, 3)
    for piece, colour in zip(got, colours, strict=True):
        assert np.abs(piece.astype(int) - colour).max() < 120  # at the seam of two images colours may mix
        assert np.abs(np.median(piece, axis=0) - colour).max() <= 1


def test_repeated_textures_are_tiled():
    base = RNG.random((8, 2))
    ramp = np.zeros((16, 16, 3), np.uint8)
    ramp[..., 0] = np.arange(16) * 15
    mesh = textured_box((0, 0, 0), uv=base * 2.5 - 0.7)
    mesh.visual.material.baseColorTexture = Image.fromarray(ramp)
    piece = piece_of(mesh)
    assert piece.uv.min() >= 0
    assert piece.uv.max() <= 1
    u = (base * 2.5 - 0.7)[mesh.faces].mean(axis=1)[:, 0]
    got = colours_on_faces(piece, np.full(3, 1 / 3))[:, 0]
    expected = (u % 1) * 240 - 7.5
    inner = (u % 1 > 0.1) & (u % 1 < 0.9)  # near the wrap the ramp jumps
    assert inner.any()
    np.testing.assert_allclose(got[inner], expected[inner], atol=8)
    with pytest.raises(InvalidInput, check=about("repetitions")):
        piece_of(textured_box((1, 2, 3), uv=base * 50))


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
    path, uv, solid = tmp_path / "a.msh", np.random.default_rng(0).random((8, 2)), box()
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
