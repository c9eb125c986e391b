import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from osfcore.errors import InvalidInput
from osfcore.objects.mesh import joined, piece_of

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
