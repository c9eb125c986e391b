"""Matte materials of USD: a texture, or the colours of the vertices."""

from __future__ import annotations

from pathlib import Path

import trimesh
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdShade
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

_TYPES, _TEXTURES = Sdf.ValueTypeNames, "textures"


class Materials:
    """UsdPreviewSurface without specular light, one for each mesh.

    Args:
        stage: that takes them.
        folder: of the stage's layer; textures come into a folder in it.
        is_unlit: colours are sent out as they are.
    """

    def __init__(self, stage: Usd.Stage, folder: Path, *, is_unlit: bool) -> None:
        self._stage, self._folder = stage, folder
        self._input, self._other = ("emissiveColor", "diffuseColor") if is_unlit else ("diffuseColor", "emissiveColor")

    def bind(self, prim: UsdGeom.Mesh, mesh: trimesh.Trimesh) -> None:
        """Give a mesh its material, which lies below it."""
        path = prim.GetPath().AppendChild("material")
        material = UsdShade.Material.Define(self._stage, path)
        surface = self._shader(path, "UsdPreviewSurface")
        surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
        surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(1)  # only so can all reflection be diffuse
        surface.CreateInput("specularColor", _TYPES.Color3f).Set((0.0, 0.0, 0.0))
        surface.CreateInput(self._other, _TYPES.Color3f).Set((0.0, 0.0, 0.0))
        texture = _texture_of(mesh)
        colour = self._vertex_colours(path) if texture is None else self._texture(path, texture)
        surface.CreateInput(self._input, _TYPES.Color3f).ConnectToSource(colour)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)

    def _texture(self, path: Sdf.Path, image: Image.Image) -> UsdShade.Output:
        file = f"{_TEXTURES}/{path.GetParentPath().name}.jpg"
        (self._folder / _TEXTURES).mkdir(exist_ok=True)
        image.save(self._folder / file, format="JPEG", quality="keep")
        reader = self._shader(path, "UsdPrimvarReader_float2")
        reader.CreateInput("varname", _TYPES.String).Set("st")
        texture = self._shader(path, "UsdUVTexture")
        texture.CreateInput("file", _TYPES.Asset).Set(f"./{file}")
        texture.CreateInput("sourceColorSpace", _TYPES.Token).Set("sRGB")
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, _TYPES.Token).Set("clamp")
        texture.CreateInput("st", _TYPES.Float2).ConnectToSource(reader.CreateOutput("result", _TYPES.Float2))
        return texture.CreateOutput("rgb", _TYPES.Float3)

    def _vertex_colours(self, path: Sdf.Path) -> UsdShade.Output:
        reader = self._shader(path, "UsdPrimvarReader_float3")
        reader.CreateInput("varname", _TYPES.String).Set("displayColor")
        return reader.CreateOutput("result", _TYPES.Float3)

    def _shader(self, path: Sdf.Path, kind: str) -> UsdShade.Shader:
        shader = UsdShade.Shader.Define(self._stage, path.AppendChild(kind))
        shader.CreateIdAttr(kind)
        return shader


def _texture_of(mesh: trimesh.Trimesh) -> Image.Image | None:
    """The JPEG that `light_mesh` has made; None for a mesh with vertex colours."""
    material = mesh.visual.material if isinstance(mesh.visual, TextureVisuals) else None
    return material.baseColorTexture if isinstance(material, PBRMaterial) else None
