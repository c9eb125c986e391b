"""Exported scenes as Pixar's library reads them: geometry, colours, cameras and light; its own checks find nothing."""

import io
from dataclasses import replace
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image
from pxr import Ar, Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation

from osfcore.contrib.export.usd import field_usd, scene_usdz
from osfcore.errors import InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera, default_cameras
from osfcore.io.scene_file import Scene
from tests.support.errors import about

MUSTARD = "006_mustard_bottle"
OFF_CENTRE = Camera(
    "off centre", default_cameras()[1].T_world_camera, np.array([[90.0, 0, 40], [0, 80, 20], [0, 0, 1]]), 96, 64
)
CAMERAS = (*default_cameras(64), OFF_CENTRE)


def opened(content, folder, suffix=".usdz"):
    path = folder / f"content{suffix}"
    path.write_bytes(content)
    return Usd.Stage.Open(str(path))


def shown_as(stage, name):
    (prim,) = (prim for prim in stage.Traverse() if prim.GetDisplayName() == name)
    return prim


def pose_of(prim):
    """`T_world_prim`, of the world with z up; USD's matrices act on rows."""
    world = prim.GetStage().GetPrimAtPath("/World/z_up")
    return np.array(UsdGeom.XformCache().ComputeRelativeTransform(prim, world)[0]).T


def shown_with_y_up(points):
    return points[:, [0, 2, 1]] * [1, 1, -1]


@pytest.fixture(scope="module")
def stage(scene, shapes, one_thread, tmp_path_factory):
    content = scene_usdz(Scene(scene.state, CAMERAS), shapes, FieldLibrary(None).load_table())
    return opened(content, tmp_path_factory.mktemp("usd"))


def assert_faultless(stage):
    """Pixar's own checks find nothing."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [e.GetErrorAsString() for e in UsdValidation.ValidationContext(validators).Validate(stage)] == []


def test_everything_stands_where_the_scene_says(scene, stage, library):
    assert_faultless(stage)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/World"
    for name in scene.state.names:
        np.testing.assert_allclose(pose_of(shown_as(stage, name)), scene.state.pose(name).matrix(), atol=1e-9)
    mesh, read = library.load(MUSTARD).mesh, UsdGeom.Mesh(shown_as(stage, MUSTARD))
    np.testing.assert_allclose(read.GetPointsAttr().Get(), mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(np.reshape(read.GetFaceVertexIndicesAttr().Get(), (-1, 3)), mesh.faces)
    np.testing.assert_allclose(read.GetNormalsAttr().Get(), mesh.normals, atol=1e-6)
    table = UsdGeom.Mesh(shown_as(stage, "table")).GetExtentAttr().Get()
    np.testing.assert_allclose(table, [[-0.6, -0.6, 0], [0.6, 0.6, 0]], atol=1e-6)
    np.testing.assert_allclose(pose_of(shown_as(stage, "pusher"))[:3, 3], scene.state.pusher, atol=1e-9)


def test_the_light_is_the_parallel_and_the_ambient_one(stage, light):
    distant = UsdLux.DistantLight(shown_as(stage, "light"))
    np.testing.assert_allclose(pose_of(distant.GetPrim())[:3, 2], light.direction, atol=1e-9)
    assert distant.GetIntensityAttr().Get() / np.pi == pytest.approx(0.75)
    assert distant.GetAngleAttr().Get() == 0
    (dome,) = (prim for prim in stage.Traverse() if prim.IsA(UsdLux.DomeLight))
    assert UsdLux.DomeLight(dome).GetIntensityAttr().Get() == 0.25


def test_without_light_it_is_what_apples_devices_take(scene, shapes, tmp_path, one_thread):
    """By the rules of `usdchecker --arkit` for types of prims, up axis and files."""
    content = scene_usdz(Scene(scene.state, CAMERAS), shapes, FieldLibrary(None).load_table(), has_light=False)
    stage = opened(content, tmp_path)
    assert_faultless(stage)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert {prim.GetTypeName() for prim in stage.Traverse()} == {"Xform", "Mesh", "Material", "Shader", "Camera"}
    assert {name.rpartition(".")[2] for name in ZipFile(io.BytesIO(content)).namelist()} == {"usdc", "jpg"}


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_cameras_see_points_where_ours_do(stage, camera):
    prim = shown_as(stage, f"camera {camera.name}")
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
    seen = np.array([matrix.Transform(Gf.Vec3d(*point)) for point in shown_with_y_up(points).tolist()])
    pixels = np.stack([(1 + seen[:, 0]) / 2 * camera.width, (1 - seen[:, 1]) / 2 * camera.height], axis=1)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-3)


def test_a_camera_with_skew_is_refused_since_usd_has_none(scene, shapes, one_thread):
    skewed = replace(OFF_CENTRE, intrinsics=OFF_CENTRE.intrinsics + [[0, 2.0, 0], [0, 0, 0], [0, 0, 0]])
    with pytest.raises(InvalidInput, check=about("skew of camera off centre")):
        scene_usdz(Scene(scene.state, (skewed,)), shapes, FieldLibrary(None).load_table())


def source_of(prim, name):
    """The shader that an input of a mesh's material comes from."""
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0]
    return UsdShade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source.GetPrim())


def test_the_texture_is_kept_and_stands_upright(stage, library):
    prim = shown_as(stage, MUSTARD)
    texture = source_of(prim, "diffuseColor")
    assert texture.GetInput("sourceColorSpace").Get() == "sRGB"
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(texture.GetInput("file").Get().resolvedPath))
    image = np.asarray(Image.open(io.BytesIO(asset.GetBuffer())), float)
    mesh = library.load(MUSTARD).mesh
    assert np.abs(image - mesh.texture).mean() < 4  # of 255; JPEG
    np.testing.assert_allclose(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get(), mesh.uv, atol=1e-6)


@pytest.mark.parametrize(
    ("is_lit", "colour", "suffix"), [(False, "diffuseColor", ".usdz"), (True, "emissiveColor", ".usdc")]
)
def test_a_field_s_surface_has_its_colours(is_lit, colour, suffix, light, solid, assert_solid, tmp_path, one_thread):
    content = field_usd(solid, "006 solid", light if is_lit else None, is_packed=suffix == ".usdz")
    stage = opened(content, tmp_path, suffix)
    assert_faultless(stage)
    prim = shown_as(stage, "006 solid")
    mesh = UsdGeom.Mesh(prim)
    assert_solid(np.array(mesh.GetPointsAttr().Get()), np.array(mesh.GetDisplayColorPrimvar().Get()), is_lit)
    assert source_of(prim, colour).GetInput("varname").Get() == "displayColor"
