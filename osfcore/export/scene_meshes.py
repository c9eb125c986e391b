"""A scene as meshes that other programs take: objects, table, pusher."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from osfcore.estimation.photometry.camera_response import linear_of_srgb
from osfcore.export.field_mesh import coloured_mesh
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.io.image_file import to_uint8
from osfcore.io.scene_file import Scene
from osfcore.objects.asset import TexturedMesh
from osfcore.objects.texture import MAX_TEXTURE_SIDE
from osfcore.objects.viewer_mesh import light_mesh

if TYPE_CHECKING:
    import trimesh

TABLE_NODE, PUSHER_NODE = "table", "pusher"


def scene_meshes(scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField) -> trimesh.Scene:
    """Everything where it stands, z up [m].

    Nodes bear the names of the objects; the others are "table" and "pusher", and an object of that name has "object "
    before its own.

    Args:
        scene: its state.
        shapes: of each object by name, a mesh, which keeps its texture, or a field, which becomes a mesh with its
            albedo on the vertices.
        table: whose albedo becomes the table's texture.

    Raises:
        InvalidInput: if nothing in a field is solid.
    """
    import trimesh

    meshes = trimesh.Scene()
    _add(meshes, TABLE_NODE, _table_mesh(table), Pose.identity())
    if scene.state.pusher is not None:
        upright = Pose(scene.state.pusher, Pose.identity().quaternion)
        _add(meshes, PUSHER_NODE, _pusher_mesh(), upright)
    for name in scene.state.names:
        shape = shapes[name]
        mesh = coloured_mesh(shape) if isinstance(shape, KiloOSF) else light_mesh(shape, MAX_TEXTURE_SIDE)
        _add(meshes, object_node(name), mesh, scene.state.pose(name))
    return meshes


def object_node(name: str) -> str:
    """The name of an object's node."""
    return f"object {name}" if name in (TABLE_NODE, PUSHER_NODE) else name


def _add(scene: trimesh.Scene, node: str, mesh: trimesh.Trimesh, pose: Pose) -> None:
    scene.add_geometry(mesh, node_name=node, geom_name=node, transform=pose.matrix())


def _table_mesh(table: TableField) -> trimesh.Trimesh:
    """Two triangles; the albedo's outermost points lie on the table's edge, half a texel inside the texture."""
    half, inset = table.half_side, 0.5 / len(table.albedo)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices = np.column_stack([half * corners, np.zeros(4)]).astype(np.float32)
    uv = (0.5 + (0.5 - inset) * corners).astype(np.float32)
    colour = table.albedo * (table.ambient + table.direct(np.array([[0.0, 0.0, 1.0]])))  # fully lit, as of objects
    texture = np.ascontiguousarray(to_uint8(colour.swapaxes(0, 1)[::-1]))  # rows of an image run against y
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    return light_mesh(TexturedMesh(vertices, normals, faces, uv, texture), MAX_TEXTURE_SIDE)


def _pusher_mesh() -> trimesh.Trimesh:
    import trimesh
    from trimesh.visual import ColorVisuals

    mesh = trimesh.creation.cylinder(PUSHER_RADIUS_M, PUSHER_HEIGHT_M, sections=48)
    mesh.unmerge_vertices()  # its edges are sharp
    colours = np.tile(to_uint8(linear_of_srgb(np.array(PUSHER_ALBEDO))), (len(mesh.vertices), 1))
    mesh.visual = ColorVisuals(mesh, vertex_colors=colours)
    return mesh
