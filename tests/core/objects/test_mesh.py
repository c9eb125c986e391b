"""Mesh: mesh, mesh colours, texture, msh, stable poses."""

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.poses import quaternion_conjugate, rotate
from osfcore.objects.mesh import (
    MAX_POSES,
    clean_texture,
    coverage,
    joined,
    piece_of,
    read_mesh,
    read_msh,
    resting_poses,
    textured_mesh,
)

# Mesh


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


# Mesh colours


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


def sample(piece, uv):
    """Bilinear colours at texture coordinates."""
    height, width = piece.texture.shape[:2]
    xy = np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], axis=1).astype(np.float32) - 0.5
    border = cv2.BORDER_REPLICATE
    return cv2.remap(
        piece.texture, xy[None, :, :1].copy(), xy[None, :, 1:].copy(), cv2.INTER_LINEAR, borderMode=border
    )[0]


def colours_on_faces(piece, weights):
    uv = np.einsum("k,fkc->fc", weights, piece.uv[piece.faces])
    return sample(piece, uv)


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


def test_a_mesh_without_colours_is_grey():
    piece = piece_of(box())
    assert len(np.unique(piece.texture)) == 1
    assert piece.uv.shape == (8, 2)


def test_colour_factor_darkens_the_image():
    piece = piece_of(textured_box((200, 100, 50), factor=[0.5, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(piece.texture[0, 0], (100, 100, 50), atol=1)


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


def test_too_many_repetitions_are_refused():
    with pytest.raises(InvalidInput, match="repetitions"):
        piece_of(textured_box((1, 2, 3), uv=RNG.random((8, 2)) * 50))


# Texture


SQUARE_UV = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def test_coverage_of_a_square():
    mask = coverage(SQUARE_UV, SQUARE, 64, 64)
    assert mask[20:44, 20:44].all()
    assert not mask[:14].any()
    assert not mask[50:].any()
    assert int(mask.sum()) == pytest.approx(32 * 32, rel=0.1)


def test_coverage_counts_v_upwards():
    uv = np.array([[0.0, 0.8], [1.0, 0.8], [0.5, 1.0]])
    mask = coverage(uv, np.array([[0, 1, 2]]), 50, 50)
    assert mask[:10].any()
    assert not mask[12:].any()


def test_black_background_never_reaches_any_mip_level():
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[64:192, 64:192] = (200, 150, 100)
    clean = clean_texture(texture, SQUARE_UV, SQUARE)
    level = clean.astype(np.float32)
    while min(level.shape[:2]) > 1:
        assert np.abs(level - (200, 150, 100)).max() <= 2
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def test_covered_texels_stay_as_they_are():
    texture = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    clean = clean_texture(texture, SQUARE_UV, SQUARE)
    np.testing.assert_array_equal(clean[34:94, 34:94], texture[34:94, 34:94])


def test_reduction_keeps_means_inside_and_ignores_outside():
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[128:384, 128:384] = np.random.default_rng(1).integers(0, 256, (256, 256, 3))
    clean = clean_texture(texture, SQUARE_UV, SQUARE, max_side=128)
    assert clean.shape == (128, 128, 3)
    expected = cv2.resize(texture.astype(np.float32), (128, 128), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(clean[36:92, 36:92], expected[36:92, 36:92], atol=0.51)
    assert clean.min() > 20  # the black background is gone


def test_uncovered_or_oblong_textures_are_fine():
    texture = np.full((3, 7, 3), 9, np.uint8)
    outside = np.full((4, 2), 0.5)
    assert clean_texture(texture, outside, np.zeros((0, 3), int)).shape == (3, 7, 3)
    assert (clean_texture(texture, SQUARE_UV, SQUARE) == 9).all()


def test_a_chart_thinner_than_its_rim_keeps_a_colour():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[31:33] = 200
    uv = np.array([[0.0, 0.5], [1.0, 0.5], [1.0, 0.51]])
    clean = clean_texture(texture, uv, np.array([[0, 1, 2]]))
    assert clean[31:33].max() == 200


# Msh


VERTICES = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
UV = np.array([[0, 0], [1, 0], [0, 1], [0.25, 0.75]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def msh_bytes(vertices=VERTICES, normals=None, uv=UV, faces=FACES) -> bytes:
    normals = np.zeros((0, 3), np.float32) if normals is None else normals
    counts = np.array([len(vertices), len(normals), len(uv), len(faces)], np.int32)
    return b"".join(a.tobytes() for a in (counts, vertices, normals, uv, faces))


@pytest.mark.parametrize("normals", [None, np.ones((4, 3), np.float32)])
def test_reads_what_was_written_and_turns_v(tmp_path, normals):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes(normals=normals))
    mesh = read_msh(path)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.uv, np.stack([UV[:, 0], 1 - UV[:, 1]], axis=1))


@given(st.binary(max_size=200))
def test_any_other_bytes_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("msh") / "a.msh"
    path.write_bytes(data)
    with pytest.raises(CorruptFile, match=r"a\.msh"):
        read_msh(path)


@pytest.mark.parametrize("cut", [1, 4, 40])
def test_a_truncated_file_is_refused(tmp_path, cut):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes()[:-cut])
    with pytest.raises(CorruptFile, match="bytes long instead of"):
        read_msh(path)


def test_missing_texture_coordinates_are_refused(tmp_path):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes(uv=UV[:0]))
    with pytest.raises(CorruptFile, match="0 texture coordinates for 4 vertices"):
        read_msh(path)


# Stable poses


def box_parts(sides):
    return (np.array(trimesh.creation.box(sides).vertices),)


def test_a_box_rests_on_each_face():
    sides = np.array([0.10, 0.09, 0.08])
    resting = resting_poses(box_parts(sides))
    assert len(resting.quaternions) == 6
    downs = np.array([rotate(quaternion_conjugate(q), np.array([0, 0, -1.0])) for q in resting.quaternions])
    np.testing.assert_allclose(np.abs(downs).max(axis=1), 1, atol=1e-6)
    assert len({tuple(d.round(3) + 0.0) for d in downs}) == 6
    largest_face = np.abs(downs[0])
    assert largest_face[2] == pytest.approx(1)  # 10 x 9 cm is the largest


def test_probabilities_are_a_distribution_largest_first():
    resting = resting_poses(box_parts((0.1, 0.06, 0.05)))
    assert resting.probabilities.sum() == pytest.approx(1)
    assert (np.diff(resting.probabilities) <= 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(resting.quaternions, axis=1), 1, atol=1e-9)


def test_a_thin_plate_does_not_stand_on_its_edge():
    resting = resting_poses(box_parts((0.2, 0.2, 0.005)))
    ups = np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])
    np.testing.assert_allclose(np.abs(ups[:, 2]), 1, atol=1e-6)


def test_a_can_stands_and_lies_in_a_handful_of_ways():
    can = np.array(trimesh.creation.cylinder(0.035, 0.1, sections=64).vertices)
    resting = resting_poses((can,))
    assert 3 <= len(resting.quaternions) <= MAX_POSES
    ups = np.abs(np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])[:, 2])
    assert np.all((ups > 0.999) | (ups < 0.03))


def test_mass_counts_where_the_parts_are():
    block = np.array(trimesh.creation.box((0.1, 0.1, 0.1)).vertices)
    rod = trimesh.creation.box((0.01, 0.01, 0.2))
    rod.apply_translation((0, 0, 0.15))
    resting = resting_poses((block, np.array(rod.vertices)))
    ups = np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])
    assert ups[:, 2].max() == pytest.approx(1)  # standing on the block
    assert (ups[:, 2] > -0.7).all()  # never balanced on the rod


def test_the_same_parts_give_the_same_poses(library):
    parts = library.load("006_mustard_bottle").parts
    first, second = resting_poses(parts), resting_poses(parts)
    assert np.array_equal(first.quaternions, second.quaternions)
    assert np.array_equal(first.probabilities, second.probabilities)


@pytest.mark.parametrize("name", ["003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "035_power_drill"])
def test_real_objects_have_their_centre_over_what_they_stand_on(name, library):
    asset = library.load(name)
    points = np.concatenate(asset.parts)
    assert 2 <= len(asset.resting.quaternions) <= MAX_POSES
    for q in asset.resting.quaternions:
        placed = rotate(q, points)
        feet = placed[placed[:, 2] < placed[:, 2].min() + 1e-3][:, :2]
        assert len(feet) >= 3
        # the frame's origin is near the centre of mass for these bodies
        assert (feet.min(axis=0) < 0.03).all()
        assert (feet.max(axis=0) > -0.03).all()
