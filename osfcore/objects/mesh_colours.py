"""Colours of loaded meshes as one texture: images, colour factors, vertex or face colours, several materials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

MAX_IMAGE_PIXELS = 8192 * 8192
_MAX_TILES = 4  # how often a texture may repeat along one side
PLAIN_SIDE = 4  # texels a side of the texture of a body of one colour
_CELL = 4  # texels a side of the cell that one face's vertex colours get
_GREY = (178, 178, 178)


@dataclass(frozen=True, eq=False, slots=True)
class TexturedPiece:
    """Triangles with one texture.

    Attributes:
        vertices: in the file's units.
        faces: vertex indices.
        uv: in [0, 1], v upwards.
        texture: RGB, first row at v = 1.
        is_padded: whether texels around the faces' own continue their colours already.
    """

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "P 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    is_padded: bool = False


def piece_of(mesh: trimesh.Trimesh) -> TexturedPiece:
    """One loaded mesh with its image, its vertex or face colours, or a grey.

    Raises:
        InvalidInput: if the image has over 67 million pixels or repeats too often.
    """
    visual: Any = mesh.visual  # trimesh's kinds of visuals share no base that tells their attributes
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    uv = getattr(visual, "uv", None)
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        factor = getattr(material, "baseColorFactor", None)
        if image is not None and uv is not None and len(uv) == len(vertices):
            texture = _pixels(image)
            if factor is not None:
                texture = np.round(texture * _rgb(factor)).astype(np.uint8)
            return _unrepeated(TexturedPiece(vertices, faces, np.asarray(uv, float), texture))
        colour = _rgb(material.main_color) * 255
    elif visual.kind in ("vertex", "face"):
        corner_colours = (
            np.asarray(visual.vertex_colors)[faces]
            if visual.kind == "vertex"
            else np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1)
        )
        return _baked(vertices, faces, corner_colours[..., :3].astype(float))
    else:
        colour = np.array(_GREY)
    texture = np.broadcast_to(np.round(colour).astype(np.uint8), (PLAIN_SIDE, PLAIN_SIDE, 3)).copy()
    return TexturedPiece(vertices, faces, np.full((len(vertices), 2), 0.5), texture)


def _rgb(colour: object) -> Float[np.ndarray, "3"]:
    """The first three channels in [0, 1], from bytes or fractions."""
    array = np.asarray(colour)
    return np.clip(array[:3] / 255.0 if array.dtype.kind in "ui" else array[:3].astype(float), 0, 1)


def _pixels(image: Image) -> UInt8[np.ndarray, "h w 3"]:
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise InvalidInput("texture size [px]", f"{image.width} x {image.height}", "at most 8192 x 8192")
    return np.asarray(image.convert("RGB"))


def _unrepeated(piece: TexturedPiece) -> TexturedPiece:
    """Texture coordinates brought into [0, 1], with the texture tiled where a face spans several copies of it."""
    if not np.all(np.isfinite(piece.uv)) or (piece.uv.min() >= 0 and piece.uv.max() <= 1):
        return piece
    corners = piece.uv[piece.faces]
    corners = corners - np.floor(corners.min(axis=1, keepdims=True) + 1e-6)
    tiles = np.maximum(np.ceil(corners.max(axis=(0, 1)) - 1e-6), 1).astype(int)
    if tiles.max() > _MAX_TILES:
        raise InvalidInput("repetitions of the texture within one triangle", int(tiles.max()), f"at most {_MAX_TILES}")
    texture = np.tile(piece.texture, (tiles[1], tiles[0], 1))
    faces = np.arange(3 * len(piece.faces)).reshape(-1, 3)
    return TexturedPiece(piece.vertices[piece.faces].reshape(-1, 3), faces, (corners / tiles).reshape(-1, 2), texture)


def _baked(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], colours: Float[np.ndarray, "F 3 3"]
) -> TexturedPiece:
    """A texture with a small square for each face, in which bilinear sampling gives back the corners' colours."""
    across = int(np.ceil(np.sqrt(len(faces))))
    down = -(-len(faces) // across)
    index = np.arange(len(faces))
    origin = np.stack([index % across, index // across], axis=1) * _CELL
    # Corners lie on texel centres (0, 0), (2, 0), (0, 2) of the cell; the rest of the cell continues the same plane.
    y, x = np.meshgrid(np.arange(_CELL) / 2, np.arange(_CELL) / 2, indexing="ij")
    a, b, c = colours[:, 0], colours[:, 1], colours[:, 2]
    cells = a[:, None, None] + x[..., None] * (b - a)[:, None, None] + y[..., None] * (c - a)[:, None, None]
    padded = np.zeros((across * down, _CELL, _CELL, 3))
    padded[: len(faces)] = cells
    rows = padded.reshape(down, across, _CELL, _CELL, 3).transpose(0, 2, 1, 3, 4)
    texture = np.clip(np.round(rows.reshape(down * _CELL, across * _CELL, 3)), 0, 255).astype(np.uint8)
    pixel = origin[:, None] + np.array([[0.5, 0.5], [2.5, 0.5], [0.5, 2.5]])
    uv = pixel / (np.array([across, down]) * _CELL)
    uv[..., 1] = 1 - uv[..., 1]
    flat = np.arange(3 * len(faces)).reshape(-1, 3)
    return TexturedPiece(vertices[faces].reshape(-1, 3), flat, uv.reshape(-1, 2), texture, is_padded=True)


def joined(pieces: list[TexturedPiece]) -> TexturedPiece:
    """All pieces as one, their textures (equal ones once) stacked into one image."""
    if len(pieces) == 1:
        return pieces[0]
    images = {_key(p.texture): p.texture for p in pieces}
    width = max(image.shape[1] for image in images.values())
    tops, rows, top = {}, [], 0
    for key, image in images.items():
        height = max(round(image.shape[0] * width / image.shape[1]), 1)
        rows.append(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
        tops[key] = (top, height)
        top += height
    if width * top > MAX_IMAGE_PIXELS:
        raise InvalidInput("size of all textures together [px]", f"{width} x {top}", "at most 8192 x 8192")
    uvs, faces, offset = [], [], 0
    for piece in pieces:
        start, height = tops[_key(piece.texture)]
        below = (1 - piece.uv[:, 1]) * height + start
        uvs.append(np.stack([piece.uv[:, 0], 1 - below / top], axis=1))
        faces.append(piece.faces + offset)
        offset += len(piece.vertices)
    vertices = np.concatenate([p.vertices for p in pieces])
    return TexturedPiece(vertices, np.concatenate(faces), np.concatenate(uvs), np.concatenate(rows))


def _key(texture: UInt8[np.ndarray, "h w 3"]) -> tuple[tuple[int, ...], bytes]:
    return texture.shape, texture.tobytes()
