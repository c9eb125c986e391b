"""Scenes and fields as files of Universal Scene Description, for Omniverse, Houdini, Maya, Blender and Apple's devices.

Axes: z up, in metres, as here. One prim, /World, holds everything. Names of prims are made of letters, digits and
underscores; the exact ones are their display names.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pxr import Sdf, Usd, UsdGeom, UsdUtils

from osfcore.export.field_mesh import field_meshes
from osfcore.export.scene_meshes import scene_meshes
from osfcore.export.usd.materials import Materials
from osfcore.export.usd.prims import Names, add_camera, add_light, add_mesh
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.geometry.light import Light
from osfcore.io.scene_file import Scene
from osfcore.objects.asset import TexturedMesh

if TYPE_CHECKING:
    import trimesh

    from osfcore.geometry.cameras import Camera


def scene_usdz(scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField) -> bytes:
    """A scene under its light, with its textures in one file; see `add_light` and `add_camera`.

    Args:
        scene: its state and cameras.
        shapes: of each object by name, a mesh, which keeps its texture, or a field, which becomes a mesh with its
            albedo on the vertices.
        table: whose albedo becomes the table's texture.

    Raises:
        InvalidInput: if nothing in a field is solid.
    """
    return _content(scene_meshes(scene, shapes, table), cameras=scene.cameras, light=scene.state.light)


def field_usd(field: KiloOSF, name: str, light: Light | None = None, *, is_packed: bool = True) -> bytes:
    """The surface of a field with vertex colours.

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
    """The file; USD's library writes to the disk alone."""
    with tempfile.TemporaryDirectory(prefix="osf-usd-") as folder:
        layer = Path(folder) / "scene.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        world = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        names, materials = Names(), Materials(stage, layer.parent, is_unlit=is_unlit)
        for node in scene.graph.nodes_geometry:
            matrix, geometry = scene.graph.get(node)
            mesh = scene.geometry[geometry]
            prim = add_mesh(stage, names.take(node), mesh, matrix)
            materials.bind(prim, mesh)
        for camera in cameras:
            add_camera(stage, names.take(f"camera {camera.name}"), camera)
        if light is not None:
            add_light(stage, names, light)
        names.show(stage)
        stage.GetRootLayer().Save()
        if not is_packed:
            return layer.read_bytes()
        package = layer.with_suffix(".usdz")
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package))
        return package.read_bytes()
