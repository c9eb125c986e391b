"""Wavefront OBJ with its MTL, as programs write them.

trimesh reads one MTL, no options of `map_Kd`, neither CR line ends nor tabs, and counts negative indices from the end
of the file.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from osfcore.errors import InvalidInput
from osfcore.objects.named_files import NamedFiles
from osfcore.objects.surface import Surface

GREY = 0.7  # of what has no colour
_NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2, "-bm": 1, "-boost": 1, "-texres": 1}  # at most, behind an option
# options with one word behind them
_WORDS = ("-blendu", "-blendv", "-cc", "-clamp", "-colorspace", "-imfchan", "-type")


@dataclass(frozen=True, eq=False, slots=True)
class _Material:
    """What an MTL says of a material: Kd, map_Kd, and its options -s and -o."""

    colour: tuple[float, ...] = (1.0, 1.0, 1.0)
    image: UInt8[np.ndarray, "h w 3"] | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def read_obj(path: Path, files: NamedFiles, max_faces: int) -> list[Surface]:
    """Read an OBJ, one surface for each of its materials.

    The colour is Kd x vertex colours. An image takes the place of both, for programs write them beside it without
    meaning that they darken it.

    Args:
        path: of the file.
        files: that it may name.
        max_faces: triangles that are read.

    Raises:
        InvalidInput: if there are more triangles, or an image is too large.
        CorruptFile: if an image cannot be read.
        ValueError, IndexError: if a line is not as the format wants it.
    """
    vertices: list[list[str]] = []
    uvs: list[list[str]] = []
    corners: dict[str, list[tuple[int, int]]] = {}  # indices into both, by material
    materials: dict[str, _Material] = {}
    material, count = "", 0
    for key, rest in _statements(path.read_bytes()):
        if key == "v":
            vertices.append(rest.split())
        elif key == "vt":
            uvs.append([*rest.split(), "0"][:2])
        elif key == "f":
            first, *others = (_corner(text, len(vertices), len(uvs)) for text in rest.split("#")[0].split())
            triangles = list(pairwise(others))
            corners.setdefault(material, []).extend(corner for pair in triangles for corner in (first, *pair))
            count += len(triangles)
            if count > max_faces:
                allowed = f"at most {max_faces}; simplify the mesh"
                raise InvalidInput(f"number of triangles of {files.source}", "more", allowed)
        elif key == "usemtl":
            material = rest
        elif key == "mtllib":
            several = [name.replace("\\ ", " ") for name in re.split(r"(?<!\\)\s+", rest)]
            is_one = files.find(rest) is not None or not any(files.find(one) for one in several)
            for name in [rest] if is_one else several:
                materials.update(_materials(name, files))
    points = np.array([row[:3] for row in vertices], float).reshape(-1, 3)
    colours = _vertex_colours(vertices)
    uv = np.array(uvs, float).reshape(-1, 2)
    return [_surface(points, colours, uv, np.array(c), materials.get(name)) for name, c in corners.items() if c]


def _statements(data: bytes) -> Iterator[tuple[str, str]]:
    """Yield the first word and the rest of each line, whatever its end, indentation and encoding."""
    try:
        text = data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        words = line.split(maxsplit=1)
        if len(words) == 2 and not words[0].startswith("#"):
            yield words[0], words[1].strip()


def _corner(text: str, vertices: int, uvs: int) -> tuple[int, int]:
    """Return the indices of a corner's vertex and texture coordinates from 0 on; -1 for none.

    Args:
        text: such as "3", "3/1", "3//2" or "-1/-1"; negative numbers count back from what was read last.
        vertices: that were read so far.
        uvs: texture coordinates that were read so far.
    """
    place, texture, *_ = (*text.split("/"), "")
    vertex, uv = int(place), int(texture or 0)
    return (vertex - 1 if vertex > 0 else vertices + vertex), (uv - 1 if uv >= 0 else uvs + uv)


def _vertex_colours(rows: list[list[str]]) -> Float[np.ndarray, "P 3"] | None:
    """Return the colours behind the coordinates, white where there are none; None if there are none at all."""
    if not any(len(row) >= 6 for row in rows):
        return None
    colours = np.array([row[3:6] if len(row) >= 6 else ("nan",) * 3 for row in rows], float)
    return np.nan_to_num(colours / 255 if np.nanmax(colours) > 1 else colours, nan=1.0)


def _surface(
    points: Float[np.ndarray, "P 3"],
    colours: Float[np.ndarray, "P 3"] | None,
    uv: Float[np.ndarray, "T 2"],
    corners: Int[np.ndarray, "C 2"],
    material: _Material | None,
) -> Surface:
    pairs, inverse = np.unique(corners, axis=0, return_inverse=True)
    faces, vertices = inverse.reshape(-1, 3), points[pairs[:, 0]]
    if material is not None and material.image is not None and len(uv) and pairs[:, 1].max() >= 0:
        mapped = np.where(pairs[:, 1:] >= 0, uv[pairs[:, 1]], 0.0) * material.scale + material.offset
        return Surface(vertices, faces, np.ones((len(faces), 3, 3)), mapped, material.image)
    factor = material.colour if material is not None else (1.0 if colours is not None else GREY,) * 3
    shades = np.ones((len(vertices), 3)) if colours is None else colours[pairs[:, 0]]
    return Surface(vertices, faces, (shades * factor)[faces])


def _materials(name: str, files: NamedFiles) -> dict[str, _Material]:
    """Read an MTL; what it lacks is noted by `files`."""
    try:
        data = files.get(name)
    except FileNotFoundError:
        return {}
    materials, current = {}, ""
    for key, rest in _statements(data):
        if key.lower() == "newmtl":
            current = rest
            materials[current] = _Material()
        elif key.lower() == "kd" and current in materials:
            values = rest.split()
            if values[0] not in ("spectral", "xyz"):  # spectra and other colour spaces, which nothing writes
                colour = tuple(float(value) for value in (values * 3)[:3])
                materials[current] = replace(materials[current], colour=colour)
        elif key.lower() == "map_kd" and current in materials:
            materials[current] = _with_image(materials[current], rest, files)
    return materials


def _with_image(material: _Material, rest: str, files: NamedFiles) -> _Material:
    """Read what follows `map_Kd`: options, then the name of an image, which may have spaces."""
    words, options = rest.split(), {}
    while len(words) > 1 and (words[0] in _NUMBERS or words[0] in _WORDS):
        option = words.pop(0)
        count = 1 if option in _WORDS else len(list(takewhile(_is_number, words[: _NUMBERS[option]])))
        options[option], words = words[:count], words[count:]
    plain = " ".join(words)
    name = next(filter(files.find, (rest, plain, plain.partition(" #")[0])), plain)  # a comment may follow
    try:
        image = files.image(name)
    except FileNotFoundError:
        return material
    scale = tuple(float(number) for number in [*options.get("-s", ()), "1", "1"][:2])
    offset = tuple(float(number) for number in [*options.get("-o", ()), "0", "0"][:2])
    return replace(material, image=image, scale=scale, offset=offset)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
