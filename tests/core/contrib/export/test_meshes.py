"""Exported scenes as trimesh and plain JSON read them: geometry, colours, cameras and light."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from osfcore.contrib.export.meshes import field_glb, glb, scene_glb
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import Scene
from osfcore.objects.mesh import read_mesh
from tests.support.ellipsoid import ALBEDO, HALF

MUSTARD, GELATIN = "006_mustard_bottle", "009_gelatin_box"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from glTF's axes to ours


def tree_of(content):
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


def read_back(content):
    return trimesh.load_scene(io.BytesIO(content), file_type="glb")


def pose_in(scene, node):
    """`T_world_node` in our axes."""
    matrix = scene.graph.get(node)[0]
    return np.block([[Z_UP @ matrix[:3, :3], (Z_UP @ matrix[:3, 3])[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.fixture(scope="module")
def content(scene, shapes, one_thread):
    return scene_glb(scene, shapes, FieldLibrary(None).load_table())


def test_everything_stands_where_the_scene_says_with_y_up_and_its_texture(scene, content, library):
    read, mesh = read_back(content), library.load(MUSTARD).mesh
    assert set(read.geometry) == {"table", "pusher", *scene.state.names}
    for name in scene.state.names:
        np.testing.assert_allclose(pose_in(read, name), scene.state.pose(name).matrix(), atol=1e-6)
    np.testing.assert_allclose(read.geometry[MUSTARD].vertices, mesh.vertices, atol=1e-6)
    top = scene.state.pose(MUSTARD).apply(mesh.vertices)[:, 2].max()
    np.testing.assert_allclose(read.bounds[:, 1], [0, top], atol=2e-3)
    np.testing.assert_allclose(read.geometry["table"].extents, [1.2, 1.2, 0], atol=1e-6)
    image = np.asarray(read.geometry[MUSTARD].visual.material.baseColorTexture, float)
    assert np.abs(image - mesh.texture).mean() < 4  # of 255; JPEG
    tree = tree_of(content)
    materials = [tree["materials"][p["material"]]["name"] for m in tree["meshes"] for p in m["primitives"]]
    assert sorted(materials) == sorted(read.geometry)  # open3d joins meshes whose materials have one name


@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.2, 1)))
def test_any_light_has_a_rigid_node_that_shines_away_from_it(position):
    light, scene = Light(np.array(position)), trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.1, 0.1, 0.1)), node_name="box")
    content = glb(scene, light=light)
    tree = tree_of(content)
    (sun,) = tree["extensions"]["KHR_lights_punctual"]["lights"]
    assert "KHR_lights_punctual" in tree["extensionsUsed"]
    assert (sun["type"], sun["color"]) == ("directional", [1, 1, 1])
    assert sun["intensity"] / np.pi == pytest.approx(0.75)
    (node,) = (n for n in tree["nodes"] if n.get("extensions") == {"KHR_lights_punctual": {"light": 0}})
    assert node["extras"]["ambient"] == 0.25
    matrix = pose_in(read_back(content), node["name"])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(matrix[:3, :3]) > 0
    np.testing.assert_allclose(matrix[:3, 2], light.direction, atol=1e-6)


def test_cameras_see_points_where_ours_do(scene, content):
    tree = tree_of(content)
    (root,) = (tree["nodes"][number] for number in tree["scenes"][0]["nodes"])
    np.testing.assert_allclose(np.array(root["matrix"]).reshape(4, 4).T[:3, :3], Z_UP.T, atol=1e-9)
    assert {f"camera {c.name}" for c in scene.cameras} <= {tree["nodes"][n]["name"] for n in root["children"]}
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
    for number, camera in enumerate(scene.cameras):
        (node,) = (n for n in tree["nodes"] if n.get("camera") == number)
        matrix = np.array(node["matrix"]).reshape(4, 4).T  # trimesh reads the first camera alone
        local = (points - matrix[:3, 3]) @ matrix[:3, :3]
        perspective = tree["cameras"][number]["perspective"]
        focal = 1 / np.tan(perspective["yfov"] / 2)
        x, y = local[:, 0] / -local[:, 2] * focal / perspective["aspectRatio"], local[:, 1] / -local[:, 2] * focal
        pixels = np.stack([(1 + x) / 2 * camera.width, (1 - y) / 2 * camera.height], axis=1)
        np.testing.assert_allclose(pixels, camera.project(points), atol=1e-4)
        assert tree["cameras"][number]["extras"]["K"] == camera.intrinsics.tolist()


def test_the_table_s_texture_lies_as_its_albedo_does(light):
    table = FieldLibrary(None).load_table()
    albedo = np.zeros_like(table.albedo)
    albedo[-1, 0] = 1  # at x = 0.6, y = -0.6
    empty = Scene(SceneState((), Pose.identity(0), light, None), ())
    mesh = read_back(scene_glb(empty, {}, replace(table, albedo=albedo))).geometry["table"]
    colours = trimesh.visual.color.uv_to_interpolated_color(mesh.visual.uv, mesh.visual.material.baseColorTexture)
    bright = mesh.vertices[np.argmax(colours[:, :3].sum(axis=1))]
    np.testing.assert_allclose(bright, [0.6, -0.6, 0], atol=1e-6)


@pytest.mark.parametrize("is_lit", [False, True])
def test_a_field_s_surface_has_its_colours(is_lit, light, solid, assert_solid, one_thread):
    content = field_glb(solid, "solid", light if is_lit else None)
    mesh = read_back(content).geometry["solid"]
    assert_solid(mesh.vertices, np.asarray(mesh.visual.vertex_attributes["color"])[:, :3] / 255, is_lit)
    (material,) = tree_of(content)["materials"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert ("KHR_materials_unlit" in material.get("extensions", {})) == is_lit


def test_a_field_that_is_exported_and_read_again_keeps_its_shape_and_colours(solid, tmp_path, one_thread):
    (tmp_path / "solid.glb").write_bytes(field_glb(solid, "solid"))
    mesh = read_mesh(tmp_path / "solid.glb")
    height, width = mesh.texture.shape[:2]
    texels = np.stack([(1 - mesh.uv[:, 1]) * height, mesh.uv[:, 0] * width]).astype(int)
    assert np.linalg.norm(mesh.vertices / HALF, axis=1) == pytest.approx(1, abs=0.05)
    error = mesh.texture[*texels] / 255 - np.array(ALBEDO)
    assert np.sqrt((error**2).mean()) < 0.03


def test_the_surface_of_a_trained_field_is_that_of_the_scanned_mesh(library, one_thread):
    surface = read_back(field_glb(FieldLibrary(None).load(GELATIN), GELATIN)).geometry[GELATIN]
    mesh = library.load(GELATIN).mesh
    scanned = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    np.testing.assert_allclose(surface.bounds, scanned.bounds, atol=3e-3)
    a, b = (trimesh.sample.sample_surface(m, 20_000, seed=0)[0] for m in (surface, scanned))
    chamfer = (KDTree(a).query(b)[0].mean() + KDTree(b).query(a)[0].mean()) / 2
    assert chamfer < 2e-3
