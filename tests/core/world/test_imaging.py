from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_CENTRE_Z_M, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.world.imaging import (
    BACKGROUND_RADIANCE,
    TABLE_ALBEDO,
    Lamp,
    Picture,
    RayTracer,
    TableSurface,
    TracedMesh,
    highlight,
    lambert,
    masks_of,
    pusher_mesh,
    wooden_texture,
)
from tests.core.world.boxes import box_asset, slab_spans, table_points
from tests.support.errors import about

HEIGHT, HALF = 0.04, 0.02
BOX = TracedMesh(box_asset("box", (2 * HALF, 2 * HALF, HEIGHT)).mesh)
OVERHEAD, LOW = Light(np.array([0, 0, 1.0])), Light.from_angles(0.7, np.deg2rad(25))
PUSHER = np.array([0.1, 0.0, PUSHER_CENTRE_Z_M])


def scene(light: Light, *places, pusher=None, turn: float = 0.0) -> SceneState:
    """Boxes on the table, all turned about the vertical, under a light."""
    quaternions = np.tile(quaternion_exp(np.array([0, 0, turn])), (len(places), 1))
    positions = np.array([(*place, HEIGHT / 2) for place in places]).reshape(-1, 3)
    return SceneState(tuple("abc"[: len(places)]), Pose(positions, quaternions), light, pusher)


def pictures(state: SceneState, cameras: tuple[Camera, ...], *, samples=None, sharp=False, **given) -> list[Picture]:
    tracer = RayTracer(dict.fromkeys(state.names, BOX), **given)
    return tracer.render(state, cameras, samples=samples, sharp=sharp)


def above(size: int = 512, x: float = 0.0, height: float = 1.2, fov_y_deg: float = 40.0) -> Camera:
    return Camera.look_at("above", (x, 0, height), (x, 0, 0), size=size, fov_y_deg=fov_y_deg)


def table_radiance(elevation_deg: float) -> np.ndarray:
    return np.array(TABLE_ALBEDO) * (0.25 + 0.75 * np.sin(np.deg2rad(elevation_deg)))


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((picture - truth) ** 2)))


# Shading

shares = st.floats(0, 1)


@given(shares, shares, st.floats(0, 3), st.floats(-1, 1), st.sampled_from([0.0, 1.0]))
def test_radiance_is_linear_in_each_strength_of_the_lamp(ambient, diffuse, intensity, cosine, visible):
    args, colour = (np.array([[0.2, 0.5, 0.8]]), np.array([cosine]), np.array([visible])), (1.0, 0.5, 0.25)
    parts = ambient * lambert(*args, Lamp(1, 0)) + diffuse * lambert(*args, Lamp(0, 1))
    whole = lambert(*args, Lamp(ambient, diffuse, intensity, colour))
    np.testing.assert_allclose(whole, intensity * np.array(colour) * parts, atol=1e-12)


def test_white_under_full_light_is_one_and_shadow_and_backs_get_the_ambient_share_alone():
    white = np.ones((3, 3), np.float32)
    found = lambert(white, np.float32([1, 1, -0.5]), np.float32([1, 0, 1]), Lamp())
    np.testing.assert_allclose(found[:, 0], [1, 0.25, 0.25], atol=1e-7)
    assert lambert(white, white[0], white[0], Lamp(0.1, 0.9, 0.7, (1.0, 0.9, 0.8))).dtype == np.float32


# Textures


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours that change smoothly over the table."""
    return np.stack([0.5 + 0.3 * np.sin(9 * x), 0.5 + 0.3 * np.cos(7 * y), 0.5 + 0.2 * np.sin(6 * (x + y))], axis=-1)


def texture_of(colours, side: int = 512) -> TableSurface:
    centres = ((np.arange(side) + 0.5) / side - 0.5) * TABLE_SIDE_M
    return TableSurface(texture=colours(*np.meshgrid(centres, -centres)).astype(np.float32))


def test_a_texture_lies_with_its_first_row_at_greatest_y_and_its_first_column_at_least_x():
    texture = np.zeros((4, 4, 3), np.float32)
    texture[..., 0] = np.linspace(0, 1, 4)  # red grows with x
    texture[..., 1] = np.linspace(0, 1, 4)[:, None]  # green grows toward -y
    at = TableSurface(texture=texture).albedo_at
    far = TABLE_SIDE_M / 2
    corners = np.array([[-far, far], [far, far], [-far, -far], [far, -far]], np.float32)
    np.testing.assert_allclose(at(corners)[:, :2], [[0, 0], [1, 0], [0, 1], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(at(np.zeros((1, 2), np.float32)), [[0.5, 0.5, 0]], atol=1e-2)


def test_texels_smaller_than_the_footprint_are_averaged():
    texture = np.indices((64, 64)).sum(axis=0)[..., None] % 2 * np.ones(3, np.float32)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (700, 2)).astype(np.float32)
    surface = TableSurface(texture=texture)
    np.testing.assert_allclose(surface.albedo_at(points, 2 * TABLE_SIDE_M / 64), 0.5, atol=1e-6)
    assert surface.albedo_at(points).std() > 0.15
    assert surface.albedo_at(points[:0]).shape == (0, 3)
    for footprint_m in (0.0, 0.002, 10.0):  # an object of one colour has it at every level
        np.testing.assert_allclose(BOX.albedo(points + 0.5, footprint_m), 204 / 255, atol=1e-6)


@pytest.mark.parametrize("texture", [np.full((4, 4, 3), 1.5), np.full((4, 4, 3), np.nan), np.ones((4, 4))])
@pytest.mark.wrong_arrays
def test_a_texture_that_is_no_albedo_is_refused(texture):
    with pytest.raises(InvalidInput, check=about("texture")):
        TableSurface(texture=texture)


def test_wood_is_an_albedo_like_the_usual_table_in_boards_with_grain():
    wood = wooden_texture(np.random.default_rng(0), 512)
    np.testing.assert_array_equal(wood, wooden_texture(np.random.default_rng(0), 512))
    assert 0 < wood.min() < wood.max() < 1
    np.testing.assert_allclose(wood.mean(axis=(0, 1)), TABLE_ALBEDO, atol=1e-3)
    along, across = (np.abs(np.diff(wood, axis=axis)).mean() for axis in (1, 0))
    assert across > 4 * along
    rows = wood.mean(axis=(1, 2))
    assert ((rows < 0.6 * rows.mean()) & (np.roll(rows, -1) > 0.8 * rows.mean())).sum() == 10  # joints


# Meshes


def test_intersections_and_occlusion_agree_with_the_slab_method():
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(2000, 3))
    origins = (0.5 * origins / np.linalg.norm(origins, axis=1, keepdims=True)).astype(np.float32)
    directions = (rng.uniform(-0.04, 0.04, (2000, 3)) - origins).astype(np.float32)
    distance, faces, _ = BOX.intersect(origins, directions)
    half = np.array([HALF, HALF, HEIGHT / 2])
    enter, leave = slab_spans(half, origins.astype(float), directions.astype(float))
    expected = np.where((enter <= leave) & (enter > 0), enter, np.inf)
    graze = ~np.isclose(distance, expected, rtol=0, atol=1e-4)
    assert graze.mean() < 0.002
    np.testing.assert_array_equal(BOX.occludes(origins, directions)[~graze], (expected < np.inf)[~graze])
    assert np.all((faces >= 0) == (distance < np.inf))


def test_pusher_is_a_closed_cylinder_of_the_stated_size_and_colour():
    mesh = pusher_mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    solid.merge_vertices(merge_norm=True, merge_tex=True)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(np.pi * PUSHER_RADIUS_M**2 * PUSHER_HEIGHT_M, rel=2e-3)
    np.testing.assert_allclose(solid.extents, [2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M], rtol=1e-5)
    np.testing.assert_allclose(solid.bounds.mean(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    corners = mesh.vertices[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("ij,ij->i", flat, mesh.normals[mesh.faces[:, 0]]) > 0)
    np.testing.assert_allclose(mesh.texture[0, 0] / 255, PUSHER_ALBEDO, atol=1 / 255)


# Pictures


@pytest.mark.parametrize("elevation_deg", [80.0, 30.0, 5.0])
def test_shadow_tip_lies_where_trigonometry_says(elevation_deg):
    light = Light.from_angles(0.0, np.deg2rad(elevation_deg))  # from +x: the shadow falls toward -x
    length = HEIGHT / np.tan(np.deg2rad(elevation_deg))
    camera = above(x=-length / 2, height=max(0.5, 1.6 * length))
    (picture,) = pictures(scene(light, (0, 0)), (camera,))
    points = table_points(camera)
    on_table = picture.coverage[0] == 0
    dark = (picture.rgb[..., 0] < 0.5 * (table_radiance(elevation_deg)[0] + 0.25 * TABLE_ALBEDO[0])) & on_table
    middle = np.abs(points[..., 1]) < HALF / 2
    pixel_m = np.diff(points[0, :2, 0], axis=0)[0]
    assert points[dark & middle, 0].min() == pytest.approx(-HALF - length, abs=1.5 * abs(pixel_m))
    across = points[dark & (np.abs(points[..., 0] + HALF + length / 2) < length / 4), 1]
    assert across.max() == pytest.approx(HALF, abs=1.5 * abs(pixel_m))


def test_a_box_under_an_overhead_light_has_no_shadow_beside_it_and_lambert_s_top_at_its_true_depth():
    camera = above(256, height=3.0, fov_y_deg=8)
    (picture,) = pictures(scene(OVERHEAD, (0, 0)), (camera,))
    beside = np.abs(table_points(camera)[..., :2]).max(axis=-1) > HALF * 3 / (3 - HEIGHT) + 0.002
    beside &= picture.coverage[0] == 0
    np.testing.assert_allclose(picture.rgb[beside], np.broadcast_to(table_radiance(90), (beside.sum(), 3)), atol=1e-5)
    np.testing.assert_allclose(picture.rgb[128, 128], 204 / 255, atol=1e-3)
    assert picture.depth[128, 128] == pytest.approx(3.0 - HEIGHT, abs=1e-4)


@pytest.mark.parametrize("elevation_deg", [5.0, 45.0])
def test_open_table_has_no_false_shadow_and_the_background_lies_beyond_it(elevation_deg):
    cameras, state = default_cameras(64), scene(Light.from_angles(0.7, np.deg2rad(elevation_deg)))
    for picture, camera in zip(pictures(state, cameras), cameras, strict=True):
        inside = np.isfinite(picture.depth) & (np.abs(table_points(camera)[..., :2]).max(axis=-1) < 0.58)
        expected = np.broadcast_to(table_radiance(elevation_deg), (inside.sum(), 3))
        np.testing.assert_allclose(picture.rgb[inside], expected, atol=1e-5)
        assert np.isinf(picture.depth[0, 32])
        np.testing.assert_allclose(picture.rgb[0, 32], BACKGROUND_RADIANCE, atol=1e-6)


def test_a_highlight_is_brightest_where_the_normal_halves_the_angle_from_light_to_eye():
    """Around that normal it falls off by the cosine to the power of 32, and in shadow there is none."""
    light, eye = np.array([0.6, 0, 0.8]), np.array([-0.6, 0, 0.8])
    tilts = np.linspace(-0.5, 0.5, 11)
    normals = np.stack([np.sin(tilts), np.zeros(11), np.cos(tilts)], axis=1)
    found = highlight(normals, np.tile(-3 * eye, (11, 1)), light, np.ones(11), Lamp(intensity=2, specular=0.3))
    np.testing.assert_allclose(found[:, 0], 0.6 * np.cos(tilts) ** 32, atol=1e-9)
    assert not highlight(normals, np.tile(-eye, (11, 1)), light, np.zeros(11), Lamp(specular=0.3)).any()


def test_pictures_are_linear_in_the_lamp_where_it_reaches():
    state, camera = scene(Light.from_angles(1.0, np.deg2rad(40)), (0, 0), pusher=PUSHER), default_cameras(96)[:1]
    lamps = (Lamp(), Lamp(1, 0), Lamp(0, 1), Lamp(0.3, 0.6, 1.5, (1.0, 0.85, 0.65)))
    usual, ambient, diffuse, both = (pictures(state, camera, lamp=lamp)[0] for lamp in lamps)
    expected = 1.5 * np.array([1.0, 0.85, 0.65]) * (0.3 * ambient.rgb + 0.6 * diffuse.rgb)
    inner = both.coverage.max(axis=0) > 0.999
    np.testing.assert_allclose(both.rgb[inner], expected[inner], atol=1e-5)
    open_table = np.all(np.abs(usual.rgb - table_radiance(40)) < 1e-5, axis=-1)
    assert open_table.sum() > 1000
    np.testing.assert_allclose(both.rgb[open_table], expected[open_table], atol=1e-5)
    beyond = np.isinf(usual.depth)
    np.testing.assert_array_equal(both.rgb[beyond], usual.rgb[beyond])  # the background shines by itself


def test_masks_are_disjoint_and_leave_out_what_is_hidden():
    low = Camera.look_at("low", (0.5, 0, 0.03), (0, 0, 0.02), size=128, fov_y_deg=20)
    near, far = masks_of(pictures(scene(OVERHEAD, (0, 0), (-0.06, 0)), (low,))[0], 2)
    assert not np.any(near & far)
    assert near.sum() > 100
    assert far.sum() < 0.2 * near.sum()


def test_a_box_behind_the_camera_is_not_seen_and_one_that_reaches_behind_it_is():
    away = Camera.look_at("away", (0.3, 0, 0.1), (1, 0, 0.05), size=32)
    close = Camera.look_at("close", (-0.01, 0, HEIGHT + 0.005), (0.02, 0, 0), size=32)
    hidden, seen = (pictures(scene(OVERHEAD, (0, 0)), (camera,))[0].coverage for camera in (away, close))
    assert hidden.max() == 0
    assert seen.mean() > 0.5


def test_order_of_objects_and_threads_change_nothing():
    state, cameras = scene(LOW, (0.0, 0), (-0.05, 0.03), turn=0.3), default_cameras(64)
    swapped = SceneState(("b", "a"), state.poses[[1, 0]], state.light, None)
    meshes = {"a": BOX, "b": TracedMesh(box_asset("b", (0.04, 0.02, HEIGHT), colour=90).mesh)}
    first, second = (RayTracer(meshes).render(s, cameras) for s in (state, swapped))
    with ThreadPoolExecutor(2) as executor:
        threaded = RayTracer(meshes, executor=executor).render(state, cameras)
    for x, y, z in zip(first, second, threaded, strict=True):
        np.testing.assert_array_equal(x.rgb, y.rgb)
        np.testing.assert_array_equal(x.coverage, y.coverage[::-1])
        np.testing.assert_array_equal(x.rgb, z.rgb)


@pytest.mark.slow
@pytest.mark.parametrize("size", [16, 95])
def test_default_quality_is_within_38_db_of_supersampling(library, size):
    names = ("006_mustard_bottle", "003_cracker_box", "035_power_drill")
    positions = np.array([[0.05, 0.1, 0.0955], [-0.12, -0.05, 0.1065], [0.12, -0.1, 0.0285]])
    turns = quaternion_exp(np.array([[0, 0, 0.2], [0, 0, 0.7], [0, 0, 2.0]]))
    tracer = RayTracer({name: TracedMesh(library.load(name).mesh) for name in names})
    cameras = (*default_cameras(size), goal_camera(size))
    for azimuth, elevation in ((0.7, 30), (3.0, 8), (-1.5, 75)):
        light = Light.from_angles(azimuth, np.deg2rad(elevation))
        state = SceneState(names, Pose(positions, turns), light, np.array([0.0, -0.15, PUSHER_CENTRE_Z_M]))
        exact = tracer.render(state, cameras, samples=8, sharp=True)
        for picture, truth in zip(tracer.render(state, cameras), exact, strict=True):
            mask = masks_of(truth, 3).any(axis=0)
            assert psnr(picture.rgb[mask], truth.rgb[mask]) >= 38
            differing = (masks_of(picture, 3) != masks_of(truth, 3)).sum()
            assert differing <= max(3, 0.03 * mask.sum())  # pixels that are covered by half


# Pictures of a textured table


def test_open_table_is_its_texture_times_the_irradiance_and_the_background_has_none():
    probes = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 2))
    cameras = (*default_cameras(256)[:2], goal_camera(256))
    for camera, picture in zip(cameras, pictures(scene(LOW), cameras, table=texture_of(waves)), strict=True):
        x, y = np.floor(camera.project(np.column_stack([probes, np.zeros(40)]))).astype(int).T
        inside = (np.stack([x, y]).min(axis=0) >= 0) & (np.stack([x, y]).max(axis=0) < 256)
        assert inside.sum() >= 20
        expected = (0.25 + 0.75 * LOW.direction[2]) * waves(*probes[inside].T)
        np.testing.assert_allclose(picture.rgb[y[inside], x[inside]], expected, atol=0.02)  # probes are no centres
        beyond = picture.rgb[np.isinf(picture.depth)]
        np.testing.assert_allclose(beyond, np.broadcast_to(BACKGROUND_RADIANCE, beyond.shape), atol=1e-6)


@pytest.mark.parametrize("surface", [TableSurface((0.3, 0.4, 0.5)), texture_of(waves)])
def test_shadow_on_any_table_is_the_ambient_share_of_its_light(surface):
    given = {"table": surface, "lamp": Lamp(0.1, 0.9)}
    (shaded,), (open_,) = (pictures(s, (goal_camera(128),), **given) for s in (scene(LOW, (0, 0)), scene(LOW)))
    ratio = (shaded.rgb / open_.rgb)[shaded.coverage.sum(axis=0) == 0]
    umbra = ratio.max(axis=1) < 0.5
    assert umbra.sum() > 50
    np.testing.assert_allclose(np.median(ratio[umbra], axis=0), 0.1 / (0.1 + 0.9 * LOW.direction[2]), rtol=1e-3)
    np.testing.assert_allclose(np.median(ratio[~umbra], axis=0), 1, rtol=1e-3)


def test_a_wooden_table_is_within_36_db_of_supersampling_and_finest_patterns_turn_grey():
    wood = TableSurface(texture=wooden_texture(np.random.default_rng(0), 1024))
    cameras, state = (default_cameras(48)[1], goal_camera(48)), scene(LOW, (0, 0), turn=0.4)
    near = {"spot": SpotLamp(np.array([0.2, 0.1, 0.35]), np.array([0.02, 0, 0]), 20, 35)}
    for lit in ({}, near | {"lamp": Lamp(0.1, 0.8, 1.2, (1, 0.9, 0.8))}):
        exact = pictures(state, cameras, table=wood, samples=10, sharp=True, **lit)
        for picture, truth in zip(pictures(state, cameras, table=wood, **lit), exact, strict=True):
            assert psnr(picture.rgb, truth.rgb) >= 36
    grid = TableSurface(texture=np.indices((1024, 1024)).sum(axis=0)[..., None] % 2 * np.ones(3, np.float32))
    (picture,) = pictures(scene(OVERHEAD), (goal_camera(64),), table=grid)
    np.testing.assert_allclose(picture.rgb[24:40, 24:40], 0.5, atol=0.02)
