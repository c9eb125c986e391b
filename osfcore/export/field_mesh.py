"""The surface of a field as a mesh with a colour for each vertex."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from osfcore.dynamics.shapes.field_parts import field_mesh
from osfcore.estimation.photometry.camera_response import linear_of_srgb
from osfcore.export.baked import baked
from osfcore.export.gltf import glb
from osfcore.fields.kiloosf import KiloOSF
from osfcore.geometry.light import Light
from osfcore.io.image_file import to_uint8

if TYPE_CHECKING:
    import trimesh


def coloured_mesh(field: KiloOSF, light: Light | None = None) -> trimesh.Trimesh:
    """Where the density is that of a surface (marching cubes), in the field's frame [m].

    Args:
        field: of the object.
        light: colours are the radiance under it, seen along the normal; None for the albedo.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    import trimesh
    from trimesh.visual import ColorVisuals

    vertices, faces = field_mesh(field)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    colours = baked(field, vertices, np.array(mesh.vertex_normals), light).colours
    mesh.visual = ColorVisuals(mesh, vertex_colors=to_uint8(linear_of_srgb(colours)))
    return mesh


def field_meshes(field: KiloOSF, name: str, light: Light | None = None) -> trimesh.Scene:
    """The coloured mesh, named, as exporters take it; arguments and errors as of `field_glb`."""
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(coloured_mesh(field, light), node_name=name, geom_name=name)
    return scene


def field_glb(field: KiloOSF, name: str, light: Light | None = None) -> bytes:
    """A field as binary glTF with vertex colours (see `osfcore.export.gltf` for axes and colours).

    Args:
        field: of the object.
        name: of the mesh.
        light: toward it, in the field's frame: its radiance is baked in and the material unlit, so that no viewer
            lights it a second time. None for the albedo, to be lit by whoever opens it.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    return glb(field_meshes(field, name, light), is_unlit=light is not None)
