"""A light copy of a textured mesh for 3D views in browsers."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import cv2
import numpy as np

from osfcore.objects.asset import TexturedMesh

if TYPE_CHECKING:
    import trimesh

MAX_TEXTURE_SIDE = 1024
_JPEG_QUALITY = 85


def viewer_glb(mesh: TexturedMesh) -> bytes:
    """Binary glTF with a JPEG texture of at most 1024 texels a side, in the mesh's own frame [m]."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    return bytes(export_glb(trimesh.Scene(light_mesh(mesh, MAX_TEXTURE_SIDE)), include_normals=True))


def light_mesh(mesh: TexturedMesh, max_side: int) -> trimesh.Trimesh:
    """The mesh as exporters take it: matte, with a JPEG texture of at most `max_side` texels a side."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    texture = mesh.texture
    scale = max_side / max(texture.shape[:2])
    if scale < 1:
        texture = cv2.resize(texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # trimesh embeds an image in the format that it was read in.
    encoded = io.BytesIO()
    Image.fromarray(texture).save(encoded, format="JPEG", quality=_JPEG_QUALITY)
    image = Image.open(encoded)
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(uv=mesh.uv, material=material)
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=np.asarray(mesh.normals), visual=visual, process=False
    )
