"""Mesh files made by hand."""

import io
import json
import struct

import numpy as np
import trimesh
from PIL import Image

# A box of 10 x 6 x 4 cm, whose sides have colours of their own.

BOX = trimesh.creation.box((0.1, 0.06, 0.04))
CORNERS = BOX.triangles.reshape(-1, 3).astype(np.float32)
NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
PALETTE = np.array([[255, 0, 0], [0, 255, 255], [0, 255, 0], [255, 0, 255], [0, 0, 255], [255, 255, 0]], np.uint8)
SIDE = np.repeat([2 * np.abs(n).argmax() + (n.sum() < 0) for n in BOX.face_normals], 3)  # of each corner, as in NAMES
COLOURS = PALETTE[SIDE]
STRIP = np.repeat(np.repeat(PALETTE[None], 16, axis=0), 16, axis=1)  # the six colours side by side
_IN_CELL = np.tile([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8]], (12, 1))
UV = np.column_stack([(SIDE + _IN_CELL[:, 0]) / 6, _IN_CELL[:, 1]]).astype(np.float32)  # of the corners, on the strip


def encoded(image, kind="PNG") -> bytes:
    """An image as a file."""
    content = io.BytesIO()
    Image.fromarray(np.asarray(image, np.uint8)).save(content, kind)
    return content.getvalue()


_KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def gltf(attributes, material=None, image=None, **tree) -> tuple[dict, bytes]:
    """The description and the buffer of one node with one mesh of one primitive.

    Args:
        attributes: arrays by name, v downwards; integers of coordinates and colours stand for fractions.
        material: its description; texture 0 shows the image.
        image: an encoded image.
        tree: what the description has in place of its own entries, or on top.
    """
    buffer, views, accessors = b"", [], []
    for name, array in attributes.items():
        data = np.asarray(array)
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": data.nbytes})
        kind = {"componentType": _KINDS[data.dtype.str[1:]], "type": _SHAPES[data.shape[1]], "count": len(data)}
        is_fraction = data.dtype.kind in "iu" and name != "POSITION"
        accessors.append({"bufferView": len(views) - 1, **kind, "normalized": is_fraction})
        buffer += data.tobytes() + bytes(-data.nbytes % 4)
    primitive = {"attributes": {name: index for index, name in enumerate(attributes)}}
    description = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "accessors": accessors,
        "bufferViews": views,
    }
    if material is not None:
        primitive["material"], description["materials"] = 0, [material]
    if image is not None:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(image)})
        description |= {"images": [{"bufferView": len(views) - 1}], "textures": [{"source": 0}]}
        buffer += image + bytes(-len(image) % 4)
    description |= {"meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": len(buffer)}]}
    return description | tree, buffer


def glb(description, buffer) -> bytes:
    """Both as one binary file."""
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def obj(colours=None, head="mtllib m.mtl\nusemtl a\n", uv=UV) -> str:
    """The box as OBJ, with texture coordinates, and with colours of its corners if they are given."""
    rows = CORNERS if colours is None else np.column_stack([CORNERS, colours])
    vertices = "".join("v " + " ".join(f"{number:.6f}" for number in row) + "\n" for row in rows)
    coordinates = "".join(f"vt {u:.6f} {1 - v:.6f}\n" for u, v in uv)
    faces = "".join("f " + " ".join(f"{i + k}/{i + k}" for k in (1, 2, 3)) + "\n" for i in range(0, 36, 3))
    return head + vertices + coordinates + faces


_PLY_KINDS = {"uchar": "u1", "ushort": "<u2", "int": "<i4", "float": "<f4"}


def ply(line_end="\n", is_binary=False) -> bytes:
    """The box as PLY with a colour and an opacity for each corner."""
    head = f"ply\nformat {'binary_little_endian' if is_binary else 'ascii'} 1.0\nelement vertex 36\n"
    head += "".join(f"property float {k}\n" for k in "xyz")
    head += "".join(f"property uchar {k}\n" for k in ("red", "green", "blue", "alpha"))
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    if is_binary:
        vertices = np.zeros(36, [("p", "<f4", 3), ("c", "u1", 4)])
        vertices["p"], vertices["c"] = CORNERS, np.column_stack([COLOURS, SIDE])
        faces = np.zeros(12, [("n", "u1"), ("i", "<i4", 3)])
        faces["n"], faces["i"] = 3, np.arange(36).reshape(-1, 3)
        return head.replace("\n", line_end).encode() + vertices.tobytes() + faces.tobytes()
    head += "".join(f"{x} {y} {z} {r} {g} {b} 9\n" for (x, y, z), (r, g, b) in zip(CORNERS, COLOURS, strict=True))
    head += "".join(f"3 {i} {i + 1} {i + 2}\n" for i in range(0, 36, 3))
    return head.replace("\n", line_end).encode()


def ply_of_quads(names, kind, most, is_binary) -> bytes:
    """The box as PLY of six faces with four corners, with a colour for each.

    Args:
        names: of the colours.
        kind: of their numbers, as PLY calls it.
        most: the number of full brightness.
        is_binary: whether the numbers are bytes.
    """
    head = f"ply\nformat {'binary_little_endian' if is_binary else 'ascii'} 1.0\nelement vertex 8\n"
    head += "".join(f"property float {k}\n" for k in "xyz") + "element face 6\nproperty list uchar int vertex_indices\n"
    head += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    whole = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.03, 0.03) for z in (-0.02, 0.02)], np.float32)
    corners = [(4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4)]
    faces = np.zeros(6, [("n", "u1"), ("i", "<i4", 4), ("c", _PLY_KINDS[kind], 3)])
    faces["n"], faces["i"], faces["c"] = 4, corners, PALETTE / 255 * most
    if is_binary:
        return head.encode() + whole.tobytes() + faces.tobytes()
    rows = [*whole.tolist(), *([n, *i.tolist(), *c.tolist()] for n, i, c in faces)]
    return (head + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()


def msh_bytes(vertices, uv, faces, normals=()) -> bytes:
    """The contents of a MuJoCo .msh file, v downwards."""
    floats = [np.asarray(array, np.float32).reshape(-1) for array in (vertices, normals, uv)]
    counts = np.array([len(vertices), len(normals), len(uv), len(faces)], np.int32)
    return b"".join(array.tobytes() for array in (counts, *floats, np.asarray(faces, np.int32)))
