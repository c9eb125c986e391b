"""Scenes and fields as binary glTF."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Float32
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals

from osfcore.dynamics.shapes import field_mesh
from osfcore.estimation.camera_response import linear_of_srgb
from osfcore.fields.kiloosf import STEP_VOXELS, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.table import TableField
from osfcore.fields.volume_rendering import render_weights
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light
from osfcore.geometry.poses import Pose, orthogonal_basis
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.io.image_file import to_uint8
from osfcore.io.scene_file import Scene
from osfcore.objects.asset import TexturedMesh, light_mesh
from osfcore.objects.mesh import MAX_TEXTURE_SIDE

# Binary glTF from scenes with z up, with what trimesh's exporter leaves out: several cameras, a light, materials.
#
# Axes: glTF has y up; all that is exported hangs below one node that turns z up to y up, so that viewers show the
# table level and each node below keeps the coordinates that it has here [m].
#
# Colours: a texel of 200 here is shown as 200 by a screen, and stays so. glTF takes textures for sRGB and vertex
# colours for linear: textures are kept as they are, vertex colours are decoded from sRGB.

TABLE_FRAME = "z_up"  # the node above all others
LIGHT_NODE = "light"
LIGHTS_EXTENSION, UNLIT_EXTENSION = "KHR_lights_punctual", "KHR_materials_unlit"
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
OPENCV_TO_GLTF = np.diag([1.0, -1, -1, 1])  # cameras of glTF and USD look along -z with y up
_NEAR_M = 0.01
_MATTE = {"metallicFactor": 0.0, "roughnessFactor": 1.0}  # glTF's default is polished metal


def glb(
    scene: trimesh.Scene, *, cameras: tuple[Camera, ...] = (), light: Light | None = None, is_unlit: bool = False
) -> bytes:
    """Encode a scene with z up as binary glTF with y up.

    The light is a directional one of KHR_lights_punctual, white, of intensity 0.75 pi. In viewers that divide by pi, as
    the extension says, a white matte surface that faces it sends out 0.75, our diffuse share. glTF has no ambient
    light; our share of 0.25 stands in the extras of the light's node.

    Args:
        scene: nodes are in metres, z up; it is changed.
        cameras: glTF assumes square pixels and the principal point in the middle; the exact K, width and height are in
            the extras of each camera.
        light: None for none.
        is_unlit: colours are shown as they are.
    """
    graph, base = scene.graph, scene.graph.base_frame
    placed = [(node, *graph.get(node)) for node in graph.nodes_geometry]
    graph.update(frame_from=base, frame_to=TABLE_FRAME, matrix=Y_UP)
    for node, matrix, geometry in placed:
        graph.update(frame_from=TABLE_FRAME, frame_to=node, matrix=matrix, geometry=geometry)
    for camera in cameras:
        matrix = camera.T_world_camera.matrix() @ OPENCV_TO_GLTF
        graph.update(frame_from=TABLE_FRAME, frame_to=camera_node(camera), matrix=matrix)
    if light is not None:
        extras = {"gltf_extensions": {LIGHTS_EXTENSION: {"light": 0}}, "ambient": AMBIENT, "diffuse": DIFFUSE}
        graph.update(frame_from=TABLE_FRAME, frame_to=LIGHT_NODE, matrix=light_matrix(light), metadata=extras)
        sun = {"type": "directional", "name": LIGHT_NODE, "color": [1.0, 1.0, 1.0], "intensity": DIFFUSE * np.pi}
        scene.metadata["gltf_extensions"] = {LIGHTS_EXTENSION: {"lights": [sun]}}

    def complete(tree: dict[str, Any]) -> dict[str, Any]:
        _add_cameras(tree, cameras)
        _add_materials(tree, is_unlit=is_unlit)
        return tree

    return bytes(export_glb(scene, include_normals=True, tree_postprocessor=complete))


def camera_node(camera: Camera) -> str:
    """Name a camera's node: an object may have the camera's own name."""
    return f"camera {camera.name}"


def light_matrix(light: Light) -> Float[np.ndarray, "4 4"]:
    """Return `T_world_node` of a light that shines along -z of its node."""
    right, up = orthogonal_basis(light.direction)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, light.direction, light.position], axis=1)
    return matrix


def _add_cameras(tree: dict[str, Any], cameras: tuple[Camera, ...]) -> None:
    """Add the cameras, with their intrinsics, to the nodes that bear their names."""
    nodes = {node["name"]: node for node in tree["nodes"]}
    for number, camera in enumerate(cameras):
        perspective = {"yfov": camera.fov_y_rad, "aspectRatio": camera.width / camera.height, "znear": _NEAR_M}
        extras = {"K": camera.intrinsics.tolist(), "width": camera.width, "height": camera.height}
        entry = {"type": "perspective", "name": camera.name, "perspective": perspective, "extras": extras}
        tree.setdefault("cameras", []).append(entry)
        nodes[camera_node(camera)]["camera"] = number


def _add_materials(tree: dict[str, Any], *, is_unlit: bool) -> None:
    """Give each mesh a material of its name: some readers join meshes whose materials are called alike.

    Meshes with vertex colours have none yet; without one they would be polished metal.
    """
    bare: dict[str, Any] = {"pbrMetallicRoughness": _MATTE}
    if is_unlit:
        bare["extensions"] = {UNLIT_EXTENSION: {}}
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", ()), UNLIT_EXTENSION]
    given, tree["materials"] = tree.get("materials", []), []
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            material = given[primitive["material"]] if "material" in primitive else bare
            primitive["material"] = len(tree["materials"])
            tree["materials"].append({**material, "name": mesh["name"]})


# One place and one colour for each point of a field's surface, for formats without scattering functions.

_BEFORE_VOXELS, _BEHIND_VOXELS = 2.0, 4.0  # limits of the search for the surface
_LEAST_WEIGHT = 1e-6
_AT_ONCE = 32768  # points


@torch.no_grad()
def baked(
    field: KiloOSF, points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], light: Light | None
) -> tuple[Float32[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"]]:
    """Bake the surface as cameras see it that look straight at each point, along -n.

        x = p - t n,   c = rho(x, l, -n),   t = sum_i w_i t_i / sum_i w_i,   t_i from -2 to 4 voxels    (eqs. 1, 3)

    A trained field holds its own shadows, but not those of other objects.

    Deviation from eq. 3: the radiance is taken at the expected depth, not integrated along the ray.

    Args:
        field: of the object.
        points: p, on its surface, in its frame [m].
        normals: n, unit, outward.
        light: toward it, in the field's frame; None for one that falls along each point's own normal, under which
            ambient + diffuse = 1: c is then the albedo, as in `osfcore.photo.pose_loss`.

    Returns:
        Points x in the field's frame [m], and linear radiance c in [0, 1].
    """
    query = KiloQuery(field)
    t = torch.arange(-_BEFORE_VOXELS, _BEHIND_VOXELS, STEP_VOXELS) * query.voxel
    parts = [np.zeros((2, 0, 3), np.float32)]
    for start in range(0, len(points), _AT_ONCE):
        p, n = (torch.as_tensor(a[start : start + _AT_ONCE], dtype=torch.float32) for a in (points, normals))
        x = p[:, None] - t[:, None] * n[:, None]
        taus = query.density(x.reshape(-1, 3)).view(x.shape[:2]) * STEP_VOXELS * query.voxel
        weights = render_weights(taus) + _LEAST_WEIGHT  # where nothing is dense, p is nearly the mean
        depth = (weights * t).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True)
        toward = n if light is None else torch.as_tensor(light.direction, dtype=torch.float32).expand_as(n)
        seen = p - depth * n
        scatter = query(seen, toward, -n)
        parts.append(torch.stack([seen, (scatter.ambient + scatter.direct).clamp(0, 1)]).numpy())
    places, colours = np.concatenate(parts, axis=1)
    return places, colours


def coloured_mesh(field: KiloOSF, light: Light | None = None) -> trimesh.Trimesh:
    """Mesh a field's surface by marching cubes, in its frame [m], with a colour for each vertex.

    Args:
        field: of the object.
        light: colours are the radiance under it, seen along the normal; None for the albedo.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    vertices, faces = field_mesh(field)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    _, colours = baked(field, vertices, np.array(mesh.vertex_normals), light)
    mesh.visual = ColorVisuals(mesh, vertex_colors=to_uint8(linear_of_srgb(colours)))
    return mesh


def field_meshes(field: KiloOSF, name: str, light: Light | None = None) -> trimesh.Scene:
    """Name the coloured mesh, for exporters; arguments and errors as of `field_glb`."""
    scene = trimesh.Scene()
    scene.add_geometry(coloured_mesh(field, light), node_name=name, geom_name=name)
    return scene


def field_glb(field: KiloOSF, name: str, light: Light | None = None) -> bytes:
    """Encode a field's surface as binary glTF with vertex colours.

    Args:
        field: of the object.
        name: of the mesh.
        light: toward it, in the field's frame: its radiance is baked in and the material unlit, so that no viewer
            lights it a second time. None for the albedo, to be lit by whoever opens it.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    return glb(field_meshes(field, name, light), is_unlit=light is not None)


# A scene as meshes: objects, table, pusher.

TABLE_NODE, PUSHER_NODE = "table", "pusher"


def scene_meshes(scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField) -> trimesh.Scene:
    """Place all meshes of a scene, z up [m].

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
    parts = {TABLE_NODE: (_table_mesh(table), Pose.identity())}
    if scene.state.pusher is not None:
        parts[PUSHER_NODE] = _pusher_mesh(), Pose(scene.state.pusher, Pose.identity().quaternion)
    for name in scene.state.names:
        shape, node = shapes[name], f"object {name}" if name in (TABLE_NODE, PUSHER_NODE) else name
        mesh = coloured_mesh(shape) if isinstance(shape, KiloOSF) else light_mesh(shape, MAX_TEXTURE_SIDE)
        parts[node] = mesh, scene.state.pose(name)
    meshes = trimesh.Scene()
    for node, (mesh, pose) in parts.items():
        meshes.add_geometry(mesh, node_name=node, geom_name=node, transform=pose.matrix())
    return meshes


def _table_mesh(table: TableField) -> trimesh.Trimesh:
    """Build two triangles; the albedo's outermost points lie on the table's edge, half a texel inside the texture."""
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
    mesh = trimesh.creation.cylinder(PUSHER_RADIUS_M, PUSHER_HEIGHT_M, sections=48)
    mesh.unmerge_vertices()  # its edges are sharp
    colours = np.tile(to_uint8(linear_of_srgb(np.array(PUSHER_ALBEDO))), (len(mesh.vertices), 1))
    mesh.visual = ColorVisuals(mesh, vertex_colors=colours)
    return mesh


def scene_glb(
    scene: Scene, shapes: Mapping[str, TexturedMesh | KiloOSF], table: TableField, *, has_light: bool = True
) -> bytes:
    """Encode a scene with its cameras and light as binary glTF, for Blender, game engines and browsers.

    Nodes bear the names that `scene_meshes` gives, "light", and "camera NAME".

    Args:
        scene: its state and cameras.
        shapes: of each object by name, a mesh, which keeps its texture, or a field, which becomes a mesh with its
            albedo on the vertices.
        table: whose albedo becomes the table's texture.
        has_light: False to leave the light out.

    Raises:
        InvalidInput: if nothing in a field is solid.
    """
    light = scene.state.light if has_light else None
    return glb(scene_meshes(scene, shapes, table), cameras=scene.cameras, light=light)
