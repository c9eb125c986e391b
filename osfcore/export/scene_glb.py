"""A scene as binary glTF: objects, table, pusher, cameras and the light, for Blender, game engines and browsers."""

from __future__ import annotations

from collections.abc import Mapping

from osfcore.export.gltf import glb
from osfcore.export.scene_meshes import scene_meshes
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.io.scene_file import Scene
from osfcore.objects.asset import TexturedMesh


def scene_glb(scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField) -> bytes:
    """The scene under its light; see `osfcore.export.gltf` for axes, colours, light and cameras.

    Nodes bear the names that `scene_meshes` gives, "light", and "camera NAME".

    Args:
        scene: its state and cameras.
        shapes: of each object by name, a mesh, which keeps its texture, or a field, which becomes a mesh with its
            albedo on the vertices.
        table: whose albedo becomes the table's texture.

    Raises:
        InvalidInput: if nothing in a field is solid.
    """
    return glb(scene_meshes(scene, shapes, table), cameras=scene.cameras, light=scene.state.light)
