"""The types of one object: catalogue facts, textured mesh, convex collision parts, resting orientations.

Object frame: the frame of the source mesh moved to the centre of its bounding box, z up, [m].
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, slots=True)
class Symmetry:
    """The rotations after which an object looks the same, after BOP's YCB-V.

    Attributes:
        kind: "none", "discrete" or "continuous".
        rotations: for "discrete", the unit quaternions (w, x, y, z) that map the object to itself, without the
            identity.
        axis: for "continuous", the axis of revolution in the object frame.
        reason: reason for this choice, in a few words.
    """

    kind: Literal["none", "discrete", "continuous"]
    rotations: tuple[tuple[float, float, float, float], ...] = ()
    axis: tuple[float, float, float] | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """Catalogue facts.

    Attributes:
        name: identifier such as "006_mustard_bottle".
        label: name for a person, such as "Mustard bottle".
        mass_kg: mass [kg].
        symmetry: symmetry of its appearance.
        licence: licence of the mesh, in SPDX form if there is one.
        attribution: whom to credit.
    """

    name: str
    label: str
    mass_kg: float
    symmetry: Symmetry
    licence: str
    attribution: str


@dataclass(frozen=True, eq=False, slots=True)
class TexturedMesh:
    """Triangles with smooth normals and one texture; corners on a UV seam are separate vertices with equal normals.

    Attributes:
        vertices: vertices in the object frame [m].
        normals: outward unit normals.
        faces: vertex indices, counter-clockwise from outside.
        uv: texture coordinates in [0, 1], v upwards as in OBJ.
        texture: linear RGB, first row at v = 1; texels that no face covers continue their neighbours' colours.
    """

    vertices: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "P 2"]
    texture: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False, slots=True)
class ObjectGeometry:
    """The shape of an object, in its frame.

    Attributes:
        vertices: vertices of its mesh [m].
        faces: vertex indices, counter-clockwise from outside.
        parts: vertices of each convex collision part [m].
    """

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "F 3"]
    parts: tuple[Float[np.ndarray, "_ 3"], ...]


@dataclass(frozen=True, eq=False, slots=True)
class RestingPoses:
    """Orientations in which the object rests on a plane.

    Attributes:
        quaternions: rotations from the object frame to a z-up world, (w, x, y, z), each up to a turn about z.
        probabilities: probability of each orientation after a random drop, largest first. They sum to 1.
    """

    quaternions: Float[np.ndarray, "M 4"]
    probabilities: Float[np.ndarray, "M"]


@dataclass(frozen=True, eq=False, slots=True)
class ObjectAsset:
    """Everything that the simulator needs of one object.

    Attributes:
        info: catalogue facts.
        mesh: mesh for images.
        parts: vertices of each convex collision part, in the object frame [m].
        resting: resting orientations, for scenes.
    """

    info: ObjectInfo
    mesh: TexturedMesh
    parts: tuple[Float[np.ndarray, "_ 3"], ...]
    resting: RestingPoses

    @property
    def size_m(self) -> Float[np.ndarray, "3"]:
        """Extents of the bounding box in the object frame [m]."""
        return np.ptp(self.mesh.vertices, axis=0)

    @property
    def radius_m(self) -> float:
        """Radius of the smallest sphere around the frame's origin that holds the object [m]."""
        return float(np.linalg.norm(self.mesh.vertices, axis=1).max())


MAX_TEXTURE_SIDE = 1024
_JPEG_QUALITY = 85


def viewer_glb(mesh: TexturedMesh) -> bytes:
    """Return binary glTF with a JPEG texture of at most 1024 texels a side, in the mesh's own frame [m]."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    return bytes(export_glb(trimesh.Scene(light_mesh(mesh, MAX_TEXTURE_SIDE)), include_normals=True))


def light_mesh(mesh: TexturedMesh, max_side: int) -> trimesh.Trimesh:
    """Return the mesh for exporters: matte, with a JPEG texture of at most `max_side` texels a side."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    texture = mesh.texture
    scale = max_side / max(texture.shape[:2])
    if scale < 1:
        texture = cv2.resize(texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # trimesh embeds an image in the format that it was read in
    encoded = io.BytesIO()
    Image.fromarray(texture).save(encoded, format="JPEG", quality=_JPEG_QUALITY)
    image = Image.open(encoded)
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(uv=mesh.uv, material=material)
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=np.asarray(mesh.normals), visual=visual, process=False
    )
