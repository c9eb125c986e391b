"""glTF 2.0, as .gltf and .glb, with the colours that its specification gives a diffuse surface.

trimesh ignores vertex colours beside a material, texture transforms, second texture coordinates, sparse accessors and
whether integers are normalised.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int, UInt8

from osfcore.errors import CorruptFile
from osfcore.geometry.poses import quaternion_to_matrix
from osfcore.objects.named_files import NamedFiles
from osfcore.objects.surface import Surface

_GLB, _BIN = b"glTF", 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_CLAMP, _MIRROR = 33071, 33648
_UNCOMPRESSED = "export it without compression, for example from Blender with Compression off"
_ADVICE = {  # extensions without which a file cannot be understood, and what to do
    "KHR_draco_mesh_compression": f"its triangles are compressed with Draco; {_UNCOMPRESSED}",
    "EXT_meshopt_compression": f"its triangles are compressed with Meshopt (gltfpack -c); {_UNCOMPRESSED}",
    "KHR_meshopt_compression": f"its triangles are compressed with Meshopt; {_UNCOMPRESSED}",
    "KHR_texture_basisu": "its textures are KTX2 (Basis Universal); export it with PNG or JPEG textures",
}
_UNDERSTOOD = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "KHR_xmp_json_ld",
               "EXT_texture_webp", "EXT_texture_avif")  # fmt: skip
_LOOKS = "KHR_materials_"  # extensions of materials are read or change nothing of the diffuse colour


def read_gltf(path: Path, files: NamedFiles) -> list[Surface]:
    """Read the default scene, one surface for each primitive of each node, in the scene's frame (y up).

        colour = COLOR_0 x baseColorFactor x baseColorTexture

    With KHR_materials_pbrSpecularGlossiness the diffuse factor and texture stand for the base colour. Where there is no
    base colour or a black one, the emission does. Everything is opaque, and bones and morph targets are at rest.

    Args:
        path: of the file.
        files: that it may name.

    Raises:
        CorruptFile: if it is of glTF 1.0, compressed, needs an extension that is not read, or has a damaged image.
        InvalidInput: if an image is too large.
        KeyError, IndexError, TypeError, ValueError: if it is damaged.
    """
    tree, chunk = _parts(path.read_bytes())
    if not str(tree["asset"]["version"]).startswith("2"):
        raise CorruptFile(files.source, f"it is glTF {tree['asset']['version']}; export it as glTF 2.0")
    for name in tree.get("extensionsRequired", ()):
        if name not in _UNDERSTOOD and not name.startswith(_LOOKS):
            reason = _ADVICE.get(name, f"it needs the extension {name}, which is not read; export it without")
            raise CorruptFile(files.source, reason)
    reader = _Reader(tree, chunk, files)
    return [
        surface
        for mesh, matrix in reader.placed_meshes()
        for primitive in tree["meshes"][mesh]["primitives"]
        if (surface := reader.surface(primitive, matrix)) is not None
    ]


def _parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary chunk, empty if there is none."""
    if not data.startswith(_GLB):
        return json.loads(data), b""
    place, chunks = 12, {}
    while place + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, place)
        chunks.setdefault(kind, data[place + 8 : place + 8 + size])
        place += 8 + size
    description = chunks.pop(next(iter(chunks)))  # always the first
    return json.loads(description), chunks.get(_BIN, b"")


class _Reader:
    """Reads what the parts of one description refer to.

    Args:
        tree: the description.
        chunk: the buffer that a GLB holds.
        files: for buffers and images that lie elsewhere.
    """

    def __init__(self, tree: dict[str, Any], chunk: bytes, files: NamedFiles) -> None:
        self._tree, self._files = tree, files
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
        if chunk:
            self._buffers[0] = chunk

    def placed_meshes(self) -> Iterator[tuple[int, Float[np.ndarray, "4 4"]]]:
        """Yield the meshes of the default scene, with `T_scene_mesh`."""
        nodes, scenes = self._tree.get("nodes", []), self._tree.get("scenes")
        if scenes:
            roots = scenes[self._tree.get("scene", 0)].get("nodes", [])
        else:
            roots = set(range(len(nodes))) - {child for node in nodes for child in node.get("children", ())}
        waiting, seen = [(root, np.eye(4)) for root in roots], set()
        while waiting:
            index, above = waiting.pop()
            if index in seen:  # a damaged file may lead round in a circle
                continue
            seen.add(index)
            matrix = above @ _node_matrix(nodes[index])
            waiting += [(child, matrix) for child in nodes[index].get("children", ())]
            if "mesh" in nodes[index]:
                yield nodes[index]["mesh"], matrix

    def surface(self, primitive: dict[str, Any], matrix: Float[np.ndarray, "4 4"]) -> Surface | None:
        """Return the triangles of a primitive, None if it has points or lines."""
        attributes, mode = primitive["attributes"], primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            return None
        points = self._numbers(attributes["POSITION"]) @ matrix[:3, :3].T + matrix[:3, 3]
        indices = np.arange(len(points))
        if "indices" in primitive:
            indices = self._numbers(primitive["indices"])[:, 0].astype(np.int64)
        faces = _triangles(indices, mode)
        colours = np.ones((len(points), 3))
        if "COLOR_0" in attributes:
            colours = self._numbers(attributes["COLOR_0"])[:, :3]
        factor, texture = _diffuse(self._tree["materials"][primitive["material"]] if "material" in primitive else {})
        uv = image = None
        if texture is not None:
            uv, image = self._mapped(texture, attributes)
        return Surface(points, faces, (colours * factor)[faces], uv, image, is_linear=True)

    def _mapped(
        self, info: dict[str, Any], attributes: dict[str, int]
    ) -> tuple[Float[np.ndarray, "P 2"] | None, UInt8[np.ndarray, "h w 3"] | None]:
        """Return coordinates and image of a texture, both None without coordinates."""
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
        if name not in attributes:
            return None, None
        turn = transform.get("rotation", 0.0)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        uv = self._numbers(attributes[name]) * transform.get("scale", (1, 1)) @ rotation.T
        uv += transform.get("offset", (0, 0))
        texture = self._tree["textures"][info["index"]]
        image = self._image(self._source(texture))
        sampler = self._tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
        for axis, key in enumerate(("wrapS", "wrapT")):
            if sampler.get(key) == _CLAMP:
                uv[:, axis] = np.clip(uv[:, axis], 0, 1)
            elif sampler.get(key) == _MIRROR and np.any((uv[:, axis] < 0) | (uv[:, axis] > 1)):
                image = np.concatenate([image, np.flip(image, 1 - axis)], axis=1 - axis)
                uv[:, axis] /= 2
        return uv * (1, -1) + (0, 1), image

    def _source(self, texture: dict[str, Any]) -> int:
        extensions = texture.get("extensions", {})
        for name in ("EXT_texture_webp", "EXT_texture_avif"):
            if name in extensions:
                return extensions[name]["source"]
        if "source" not in texture:
            raise CorruptFile(self._files.source, _ADVICE["KHR_texture_basisu"])
        return texture["source"]

    def _image(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        if index not in self._images:
            entry = self._tree["images"][index]
            uri = entry.get("uri", "data:")
            data = self._view(entry["bufferView"])[0] if "bufferView" in entry else self._resource(uri)
            name = entry.get("name", f"number {index}") if uri.startswith("data:") else unquote(uri)
            self._images[index] = self._files.decoded(bytes(data), name)
        return self._images[index]

    def _resource(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, content = uri.partition(",")
            return base64.b64decode(content) if head.endswith(";base64") else unquote_to_bytes(content)
        return self._files.get(unquote(uri))

    def _view(self, index: int) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride, 0 if it is packed."""
        view = self._tree["bufferViews"][index]
        if view["buffer"] not in self._buffers:
            entry = self._tree["buffers"][view["buffer"]]
            self._buffers[view["buffer"]] = self._resource(entry["uri"])
        start = view.get("byteOffset", 0)
        data = memoryview(self._buffers[view["buffer"]])[start : start + view["byteLength"]]
        return data, view.get("byteStride", 0)

    def _rows(self, place: dict[str, Any], kind: int, width: int, count: int) -> np.ndarray:
        data, stride = self._view(place["bufferView"])
        dtype = np.dtype(_TYPES[kind])
        strides = (stride or width * dtype.itemsize, dtype.itemsize)
        return np.ndarray((count, width), dtype, data, place.get("byteOffset", 0), strides)

    def _numbers(self, index: int) -> Float[np.ndarray, "P k"]:
        """Return the rows of an accessor, integers that stand for fractions as such."""
        accessor = self._tree["accessors"][index]
        kind, width, count = accessor["componentType"], _WIDTHS[accessor["type"]], accessor["count"]
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            rows = self._rows(accessor, kind, width, count)
        elif sparse is not None:
            rows = np.zeros((count, width), _TYPES[kind])
        else:  # its numbers are in an extension that compresses them, though nothing says that it is required
            used = self._tree.get("extensionsUsed", ())
            unknown = f"its triangles are compressed; {_UNCOMPRESSED}"
            raise CorruptFile(self._files.source, next((_ADVICE[name] for name in used if name in _ADVICE), unknown))
        if sparse is not None:
            rows = rows.copy()
            where = self._rows(sparse["indices"], sparse["indices"]["componentType"], 1, sparse["count"])[:, 0]
            rows[where] = self._rows(sparse["values"], kind, width, sparse["count"])
        if accessor.get("normalized", False):
            return np.maximum(rows / np.iinfo(rows.dtype).max, -1.0)
        return rows.astype(float)


def _node_matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return `T_parent_node`."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix[:3, :3] = quaternion_to_matrix(np.array([w, x, y, z], float)) * node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _triangles(indices: Int[np.ndarray, "I"], mode: int) -> Int[np.ndarray, "F 3"]:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], axis=1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _diffuse(material: dict[str, Any]) -> tuple[Float[np.ndarray, "3"], dict[str, Any] | None]:
    """Return the linear factor and the texture of what a material scatters, or else sends out."""
    base = material.get("pbrMetallicRoughness", {})
    factor, texture = base.get("baseColorFactor", (1, 1, 1)), base.get("baseColorTexture")
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if gloss is not None:
        factor, texture = gloss.get("diffuseFactor", (1, 1, 1)), gloss.get("diffuseTexture")
        if not any(factor[:3]):  # a metal, whose base colour is what it reflects
            factor, texture = gloss.get("specularFactor", (1, 1, 1)), gloss.get("specularGlossinessTexture")
    emitted = material.get("emissiveFactor", (0, 0, 0))
    if any(emitted) and (not any(factor[:3]) or (not base and gloss is None)):
        factor, texture = emitted, material.get("emissiveTexture")
    return np.array(factor[:3], float), texture
