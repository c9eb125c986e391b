"""Binary glTF from scenes with z up, with what trimesh's exporter leaves out: several cameras, a light, materials.

Axes: glTF has y up; all that is exported hangs below one node that turns z up to y up, so that viewers show the table
level and each node below keeps the coordinates that it has here [m].

Colours: a texel of 200 here is shown as 200 by a screen, and stays so. glTF takes textures for sRGB and vertex colours
for linear: textures are kept as they are, vertex colours are decoded from sRGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light
from osfcore.geometry.poses import orthogonal_basis

if TYPE_CHECKING:
    import trimesh

TABLE_FRAME = "z_up"  # the node under which everything hangs
LIGHT_NODE = "light"
LIGHTS_EXTENSION, UNLIT_EXTENSION = "KHR_lights_punctual", "KHR_materials_unlit"
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_OPENCV_TO_GLTF = np.diag([1.0, -1, -1, 1])  # glTF's cameras look along -z with y up
_NEAR_M = 0.01
_MATTE = {"metallicFactor": 0.0, "roughnessFactor": 1.0}  # glTF's default is polished metal


def glb(
    scene: trimesh.Scene, *, cameras: tuple[Camera, ...] = (), light: Light | None = None, is_unlit: bool = False
) -> bytes:
    """A scene with z up as binary glTF with y up.

    The light is a directional one of KHR_lights_punctual, white, of intensity 0.75 pi: a white matte surface that
    faces it then sends out 0.75, our diffuse share, in viewers that divide by pi as the extension says. glTF has no
    ambient light; our share of 0.25 stands in the extras of the light's node.

    Args:
        scene: nodes are in metres, z up; it is changed.
        cameras: with square pixels and the principal point in the middle as far as glTF can tell; the exact K, width
            and height are in the extras of each camera.
        light: None for none.
        is_unlit: colours are shown as they are.
    """
    from trimesh.exchange.gltf import export_glb

    graph, base = scene.graph, scene.graph.base_frame
    placed = [(node, *graph.get(node)) for node in graph.nodes_geometry]
    graph.update(frame_from=base, frame_to=TABLE_FRAME, matrix=_Y_UP)
    for node, matrix, geometry in placed:
        graph.update(frame_from=TABLE_FRAME, frame_to=node, matrix=matrix, geometry=geometry)
    for camera in cameras:
        matrix = camera.T_world_camera.matrix() @ _OPENCV_TO_GLTF
        graph.update(frame_from=TABLE_FRAME, frame_to=camera_node(camera), matrix=matrix)
    if light is not None:
        _add_light(scene, light)

    def complete(tree: dict[str, Any]) -> dict[str, Any]:
        _add_cameras(tree, cameras)
        _add_materials(tree, is_unlit=is_unlit)
        return tree

    return bytes(export_glb(scene, include_normals=True, tree_postprocessor=complete))


def camera_node(camera: Camera) -> str:
    """The name of a camera's node: that of an object may be the camera's own."""
    return f"camera {camera.name}"


def _add_light(scene: trimesh.Scene, light: Light) -> None:
    right, up = orthogonal_basis(light.direction)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, light.direction, light.position], axis=1)  # it shines along -z of its node
    extras = {"gltf_extensions": {LIGHTS_EXTENSION: {"light": 0}}, "ambient": AMBIENT, "diffuse": DIFFUSE}
    scene.graph.update(frame_from=TABLE_FRAME, frame_to=LIGHT_NODE, matrix=matrix, metadata=extras)
    sun = {"type": "directional", "name": LIGHT_NODE, "color": [1.0, 1.0, 1.0], "intensity": DIFFUSE * np.pi}
    scene.metadata["gltf_extensions"] = {LIGHTS_EXTENSION: {"lights": [sun]}}


def _add_cameras(tree: dict[str, Any], cameras: tuple[Camera, ...]) -> None:
    if cameras:
        tree["cameras"] = [_camera(camera) for camera in cameras]
    numbers = {camera_node(camera): number for number, camera in enumerate(cameras)}
    for node in tree["nodes"]:
        if node["name"] in numbers:
            node["camera"] = numbers[node["name"]]


def _camera(camera: Camera) -> Mapping[str, Any]:
    perspective = {"yfov": camera.fov_y_rad, "aspectRatio": camera.width / camera.height, "znear": _NEAR_M}
    extras = {"K": camera.intrinsics.tolist(), "width": camera.width, "height": camera.height}
    return {"type": "perspective", "name": camera.name, "perspective": perspective, "extras": extras}


def _add_materials(tree: dict[str, Any], *, is_unlit: bool) -> None:
    """Meshes with vertex colours come without a material, and would be polished metal."""
    bare = [p for mesh in tree["meshes"] for p in mesh["primitives"] if "material" not in p]
    if not bare:
        return
    materials = tree.setdefault("materials", [])
    for primitive in bare:
        primitive["material"] = len(materials)
    material: dict[str, Any] = {"name": "vertex colours", "pbrMetallicRoughness": _MATTE}
    if is_unlit:
        material["extensions"] = {UNLIT_EXTENSION: {}}
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", ()), UNLIT_EXTENSION]
    materials.append(material)
