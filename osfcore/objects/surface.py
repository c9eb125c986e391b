"""Colours of surfaces as one texture: images, colour factors, vertex or face colours, several materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from osfcore.errors import InvalidInput

MAX_IMAGE_PIXELS = 8192 * 8192
PLAIN_SIDE = 4  # texels a side of the texture of a body of one colour
_CELL = 4  # texels a side of the cell that one face's vertex colours get
_MAX_CELLS_SIDE = 2048  # of all cells together, where they hold parts of an image


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """Triangles as a file describes them. Their colour is image x colours.

    Attributes:
        vertices: in the file's units.
        faces: vertex indices.
        colours: of the corners of each face, in [0, 1].
        uv: texture coordinates of the vertices, v upwards; the image repeats. None without an image.
        image: RGB, first row at v = 1; None for white.
        is_linear: whether colours are linear light, as in glTF; else they are as a screen shows them.
    """

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "F 3 3"]
    uv: Float[np.ndarray, "P 2"] | None = None
    image: UInt8[np.ndarray, "h w 3"] | None = None
    is_linear: bool = False


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


def pieces_of(surfaces: Sequence[Surface]) -> list[TexturedPiece]:
    """Return surfaces with a texture each; those that have colours but no image share one.

    Raises:
        InvalidInput: if a texture with its repetitions has over 67 million pixels.
    """
    pieces, shaded = [], []
    for surface in map(_without_plain_image, surfaces):
        if np.ptp(surface.colours, axis=(0, 1)).max() == 0:
            pieces.append(_tinted(surface))
        elif surface.image is None:
            shaded.append(replace(surface, colours=_shown(surface.colours, surface), is_linear=False))
        else:
            pieces.append(_baked(surface))
    if shaded:
        pieces.append(_baked(_merged(shaded)))
    return pieces


def _light(shown: np.ndarray, surface: Surface) -> np.ndarray:
    """Return fractions as a screen shows them in the unit in which the surface's colours multiply."""
    from trimesh.visual.color import srgb_to_linear

    return srgb_to_linear(shown) if surface.is_linear else shown


def _shown(light: np.ndarray, surface: Surface) -> np.ndarray:
    """Undo `_light`, cut to [0, 1]."""
    from trimesh.visual.color import linear_to_srgb

    light = np.clip(light, 0, 1)
    return linear_to_srgb(light) if surface.is_linear else light


def _bytes(shown: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return np.round(shown * 255).astype(np.uint8)


def _without_plain_image(surface: Surface) -> Surface:
    """Make an image of one colour part of the colours: then it does not matter how often it repeats."""
    image = surface.image
    if image is None or np.any(image != image[0, 0]):
        return surface
    colours = surface.colours * _light(image[0, 0] / 255, surface)
    return Surface(surface.vertices, surface.faces, colours, is_linear=surface.is_linear)


def _tinted(surface: Surface) -> TexturedPiece:
    """Multiply the image by the one colour of all corners."""
    tint, image, uv = surface.colours[0, 0], surface.image, surface.uv
    if image is None or uv is None:
        texture = np.broadcast_to(_bytes(_shown(tint, surface)), (PLAIN_SIDE, PLAIN_SIDE, 3)).copy()
        return TexturedPiece(surface.vertices, surface.faces, np.full((len(surface.vertices), 2), 0.5), texture, True)
    if np.any(tint != 1):
        levels = _light(np.arange(256) / 255, surface)
        image = cv2.LUT(image, _bytes(_shown(levels[:, None] * tint, surface))[None])
    return _unrepeated(TexturedPiece(surface.vertices, surface.faces, uv, image))


def _unrepeated(piece: TexturedPiece) -> TexturedPiece:
    """Bring texture coordinates into [0, 1], and tile the texture where a face spans several copies of it."""
    if not np.all(np.isfinite(piece.uv)) or (piece.uv.min() >= 0 and piece.uv.max() <= 1):
        return piece
    corners = piece.uv[piece.faces]
    corners = corners - np.floor(corners.min(axis=1, keepdims=True) + 1e-6)
    tiles = np.maximum(np.ceil(corners.max(axis=(0, 1)) - 1e-6), 1)
    height, width = piece.texture.shape[:2] * tiles[::-1]
    if width * height > MAX_IMAGE_PIXELS:
        size, repeated = f"{width:.0f} x {height:.0f}", f"{tiles[0]:.0f} x {tiles[1]:.0f}"
        what = f"size [px] of a texture that repeats {repeated} times within one triangle"
        raise InvalidInput(what, size, "at most 8192 x 8192; divide the triangles or make the texture smaller")
    texture = np.tile(piece.texture, (int(tiles[1]), int(tiles[0]), 1))
    faces = np.arange(3 * len(piece.faces)).reshape(-1, 3)
    return TexturedPiece(piece.vertices[piece.faces].reshape(-1, 3), faces, (corners / tiles).reshape(-1, 2), texture)


def _merged(surfaces: Sequence[Surface]) -> Surface:
    """Join surfaces without images into one."""
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    faces = [s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]
    vertices, colours = np.concatenate([s.vertices for s in surfaces]), np.concatenate([s.colours for s in surfaces])
    return Surface(vertices, np.concatenate(faces), colours)


def _baked(surface: Surface) -> TexturedPiece:
    """Make a texture with a small square for each face, in which bilinear sampling gives image x colours."""
    count = len(surface.faces)
    across = int(np.ceil(np.sqrt(count)))
    down = -(-count // across)
    cell = _CELL if surface.image is None else max(_MAX_CELLS_SIDE // across, _CELL)
    light = _cells(surface.colours, across, down, cell)
    if surface.image is not None and surface.uv is not None:
        height, width = surface.image.shape[:2]
        uv = surface.uv[surface.faces]
        place = _cells(uv - np.floor(uv.min(axis=1, keepdims=True)), across, down, cell)
        x, y = place[..., 0] * width - 0.5, (1 - place[..., 1]) * height - 0.5
        x, y = x.astype(np.float32), y.astype(np.float32)
        sampled = cv2.remap(surface.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        light = light * _light(sampled / 255, surface)
    index = np.arange(count)
    origin = np.stack([index % across, index // across], axis=1) * cell
    pixel = origin[:, None] + 0.5 + np.array([[0, 0], [1, 0], [0, 1]]) * (cell - 2)
    uv = pixel / (np.array([across, down]) * cell)
    uv[..., 1] = 1 - uv[..., 1]
    flat = np.arange(3 * count).reshape(-1, 3)
    vertices = surface.vertices[surface.faces].reshape(-1, 3)
    return TexturedPiece(vertices, flat, uv.reshape(-1, 2), _bytes(_shown(light, surface)), is_padded=True)


def _cells(corners: Float[np.ndarray, "F 3 k"], across: int, down: int, cell: int) -> Float[np.ndarray, "h w k"]:
    """Continue each face's values at its corners over its square.

    Corners lie on the centres of texels (0, 0), (cell - 2, 0), (0, cell - 2); the rest continues the same plane.
    """
    y, x = np.meshgrid(*2 * [np.arange(cell) / (cell - 2)], indexing="ij")
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    planes = a[:, None, None] + x[..., None] * (b - a)[:, None, None] + y[..., None] * (c - a)[:, None, None]
    padded = np.zeros((across * down, cell, cell, corners.shape[2]))
    padded[: len(corners)] = planes
    rows = padded.reshape(down, across, cell, cell, -1).transpose(0, 2, 1, 3, 4)
    return rows.reshape(down * cell, across * cell, -1)


def joined(pieces: Sequence[TexturedPiece]) -> TexturedPiece:
    """Join pieces into one, their textures (equal ones once) stacked into one image.

    Raises:
        InvalidInput: if that has over 67 million pixels.
    """
    if len(pieces) == 1:
        return pieces[0]
    images = {key_of(p.texture): p.texture for p in pieces}
    width, height = max(i.shape[1] for i in images.values()), sum(i.shape[0] for i in images.values())
    if width * height > MAX_IMAGE_PIXELS:
        raise InvalidInput("size of all textures together [px]", f"{width} x {height}", "at most 8192 x 8192")
    rows = [cv2.resize(i, (width, i.shape[0]), interpolation=cv2.INTER_LINEAR) for i in images.values()]
    tops = dict(zip(images, np.cumsum([0, *(len(row) for row in rows)]), strict=False))
    uvs, faces, offset = [], [], 0
    for piece in pieces:
        below = (1 - piece.uv[:, 1]) * piece.texture.shape[0] + tops[key_of(piece.texture)]
        uvs.append(np.stack([piece.uv[:, 0], 1 - below / height], axis=1))
        faces.append(piece.faces + offset)
        offset += len(piece.vertices)
    vertices = np.concatenate([p.vertices for p in pieces])
    is_padded = all(p.is_padded for p in pieces)
    return TexturedPiece(vertices, np.concatenate(faces), np.concatenate(uvs), np.concatenate(rows), is_padded)


def key_of(texture: UInt8[np.ndarray, "h w 3"]) -> tuple[tuple[int, ...], bytes]:
    """Return what equal textures share."""
    return texture.shape, texture.tobytes()
