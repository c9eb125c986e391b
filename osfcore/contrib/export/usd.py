"""Scenes and fields as Universal Scene Description (USD), for Omniverse, Houdini, Maya, Blender and Apple's devices.

Axes: y up, which Apple's devices ask for, in metres. Below one prim, /World/z_up, everything has the coordinates that
it has here. Names of prims are made of letters, digits and underscores; the exact ones are their display names.

Raises:
    MissingExtra: on import, if Pixar's library is not installed.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual import TextureVisuals

from osfcore.contrib.export.meshes import (
    OPENCV_TO_GLTF,
    TABLE_FRAME,
    Y_UP,
    camera_node,
    field_meshes,
    light_matrix,
    scene_meshes,
)
from osfcore.errors import InvalidInput, shown
from osfcore.extras import need
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light
from osfcore.io.scene_file import Scene
from osfcore.objects.asset import TexturedMesh

need("usd", "A USD file")
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, Vt  # noqa: E402

_FILM = 0.36  # width of the film in tenths of a metre, as USD has it: 36 mm
_CLIPPING_M = (0.01, 100.0)
_WORLD = Sdf.Path("/World")
_BASE = _WORLD.AppendChild(TABLE_FRAME)
_TYPES, _TEXTURES = Sdf.ValueTypeNames, "textures"


def bind_material(stage: Usd.Stage, prim: UsdGeom.Mesh, mesh: trimesh.Trimesh, folder: Path, *, is_unlit: bool) -> None:
    """Give a mesh a matte material (UsdPreviewSurface), below it in the stage: its texture, or its vertices' colours.

    Args:
        stage: that holds the mesh.
        prim: the mesh in it.
        mesh: its colours; a texture is the JPEG that `light_mesh` has made.
        folder: of the stage's layer; textures are written to a folder in it.
        is_unlit: colours are sent out as they are.
    """
    path = prim.GetPath().AppendChild("material")
    material = UsdShade.Material.Define(stage, path)
    shown, black = ("emissiveColor", "diffuseColor") if is_unlit else ("diffuseColor", "emissiveColor")

    def shader(kind: str) -> UsdShade.Shader:
        made = UsdShade.Shader.Define(stage, path.AppendChild(kind))
        made.CreateIdAttr(kind)
        return made

    surface = shader("UsdPreviewSurface")
    surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
    surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(1)  # only so can all reflection be diffuse
    surface.CreateInput("specularColor", _TYPES.Color3f).Set((0.0, 0.0, 0.0))
    surface.CreateInput(black, _TYPES.Color3f).Set((0.0, 0.0, 0.0))
    if isinstance(mesh.visual, TextureVisuals):
        textured: Any = mesh.visual.material
        file = f"{_TEXTURES}/{prim.GetPath().name}.jpg"
        (folder / _TEXTURES).mkdir(exist_ok=True)
        textured.baseColorTexture.save(folder / file, format="JPEG", quality="keep")
        reader = shader("UsdPrimvarReader_float2")
        reader.CreateInput("varname", _TYPES.String).Set("st")
        texture = shader("UsdUVTexture")
        texture.CreateInput("file", _TYPES.Asset).Set(f"./{file}")
        texture.CreateInput("sourceColorSpace", _TYPES.Token).Set("sRGB")
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, _TYPES.Token).Set("clamp")
        texture.CreateInput("st", _TYPES.Float2).ConnectToSource(reader.CreateOutput("result", _TYPES.Float2))
        colour = texture.CreateOutput("rgb", _TYPES.Float3)
    else:
        reader = shader("UsdPrimvarReader_float3")
        reader.CreateInput("varname", _TYPES.String).Set("displayColor")
        colour = reader.CreateOutput("result", _TYPES.Float3)
    surface.CreateInput(shown, _TYPES.Color3f).ConnectToSource(colour)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)


def free_path(shown: dict[Sdf.Path, str], name: str) -> Sdf.Path:
    """Reserve a path below /World/z_up for a name of any characters, in a dictionary of those that are taken."""
    stem = Tf.MakeValidIdentifier(name if name[:1].isalpha() else f"_{name}")  # 006 would become _06
    path, numbers = _BASE.AppendChild(stem), itertools.count(2)
    while path in shown:
        path = _BASE.AppendChild(f"{stem}_{next(numbers)}")
    shown[path] = name
    return path


def add_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: trimesh.Trimesh, matrix: Float[np.ndarray, "4 4"]) -> UsdGeom.Mesh:
    """Add triangles with smooth normals, and texture coordinates or colours for each vertex."""
    prim = UsdGeom.Mesh.Define(stage, path)
    _place(prim, matrix)
    points = np.asarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.faces, np.int32).ravel()))
    prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.array(mesh.vertex_normals, np.float32)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    kind, primvars = UsdGeom.Tokens.vertex, UsdGeom.PrimvarsAPI(prim)
    visual: Any = mesh.visual
    if isinstance(visual, TextureVisuals):
        uv = Vt.Vec2fArray.FromNumpy(np.array(visual.uv, np.float32))
        primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, kind).Set(uv)
    else:
        colours = np.asarray(visual.vertex_colors, np.float32)[:, :3] / 255  # linear, as USD has them
        prim.CreateDisplayColorPrimvar(kind).Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colours)))
    return prim


def add_camera(stage: Usd.Stage, path: Sdf.Path, camera: Camera) -> None:
    """Add a pinhole camera with exactly its K: an off-centre principal point becomes a shift of the film."""
    prim, K = UsdGeom.Camera.Define(stage, path), camera.intrinsics
    if K[0, 1]:
        raise InvalidInput(f"skew of camera {shown(camera.name)} (K[0][1])", K[0, 1], "0: USD's cameras have none")
    _place(prim, camera.T_world_camera.matrix() @ OPENCV_TO_GLTF)
    focal = _FILM * K[0, 0] / camera.width
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_FILM)
    prim.CreateVerticalApertureAttr(focal * camera.height / K[1, 1])
    prim.CreateHorizontalApertureOffsetAttr(focal * (camera.width / 2 - K[0, 2]) / K[0, 0])
    prim.CreateVerticalApertureOffsetAttr(focal * (K[1, 2] - camera.height / 2) / K[1, 1])
    prim.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING_M))


def add_light(stage: Usd.Stage, shown: dict[Sdf.Path, str], light: Light) -> None:
    """Add the parallel and the ambient light, under which a white matte surface sends out 0.75 and 0.25.

    A distant light of angle 0 has the illuminance of its intensity: 0.75 pi. A dome of radiance 0.25 lights everything
    evenly.

    Deviation: in some renderers objects shade each other from the dome's light; here they do not.
    """
    distant = UsdLux.DistantLight.Define(stage, free_path(shown, "light"))
    _place(distant, light_matrix(light))
    distant.CreateAngleAttr(0.0)  # hard shadows
    distant.CreateIntensityAttr(DIFFUSE * np.pi)
    distant.CreateNormalizeAttr(True)
    UsdLux.DomeLight.Define(stage, free_path(shown, "ambient light")).CreateIntensityAttr(AMBIENT)


def _place(prim: UsdGeom.Xformable, matrix: Float[np.ndarray, "4 4"]) -> None:
    prim.AddTransformOp().Set(Gf.Matrix4d(np.asarray(matrix, float).T.tolist()))  # of rows of points, from the left


def scene_usdz(
    scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField, *, has_light: bool = True
) -> bytes:
    """Encode a scene under its light, with its textures in one file; see `add_light` and `add_camera`.

    Args:
        scene: its state and cameras.
        shapes: of each object by name, a mesh, which keeps its texture, or a field, which becomes a mesh with its
            albedo on the vertices.
        table: whose albedo becomes the table's texture.
        has_light: False to leave the light out; AR Quick Look on Apple's devices takes no lights.

    Raises:
        InvalidInput: if nothing in a field is solid.
    """
    light = scene.state.light if has_light else None
    return _content(scene_meshes(scene, shapes, table), cameras=scene.cameras, light=light)


def field_usd(field: KiloOSF, name: str, light: Light | None = None, *, is_packed: bool = True) -> bytes:
    """Encode the surface of a field with vertex colours.

    Args:
        field: of the object.
        name: of the mesh.
        light: toward it, in the field's frame: its radiance is baked in and sent out, so that nothing lights it a
            second time. None for the albedo, to be lit by whoever opens it.
        is_packed: as .usdz; else as the .usdc that lies in it.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    return _content(field_meshes(field, name, light), is_unlit=light is not None, is_packed=is_packed)


def _content(
    scene: trimesh.Scene,
    *,
    cameras: tuple[Camera, ...] = (),
    light: Light | None = None,
    is_unlit: bool = False,
    is_packed: bool = True,
) -> bytes:
    """Encode meshes, cameras and light, through a folder: USD's library writes to the disk alone."""
    with tempfile.TemporaryDirectory(prefix="osf-usd-") as folder:
        layer = Path(folder) / "scene.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, _WORLD).GetPrim())
        _place(UsdGeom.Xform.Define(stage, _BASE), Y_UP)
        shown: dict[Sdf.Path, str] = {}  # the exact names, by path
        for node in scene.graph.nodes_geometry:
            matrix, geometry = scene.graph.get(node)
            mesh = scene.geometry[geometry]
            prim = add_mesh(stage, free_path(shown, node), mesh, matrix)
            bind_material(stage, prim, mesh, layer.parent, is_unlit=is_unlit)
        for camera in cameras:
            add_camera(stage, free_path(shown, camera_node(camera)), camera)
        if light is not None:
            add_light(stage, shown, light)
        for path, name in shown.items():
            stage.GetPrimAtPath(path).SetDisplayName(name)
        stage.GetRootLayer().Save()
        if not is_packed:
            return layer.read_bytes()
        package = layer.with_suffix(".usdz")
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package))
        return package.read_bytes()
