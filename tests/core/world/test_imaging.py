"""Imaging: optics, ray tracer, shot, traced mesh, traced table, wood, pusher body."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_CENTRE_Z_M, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.world.imaging import (
    BACKGROUND_RADIANCE,
    NO_HIT,
    TABLE_ALBEDO,
    Body,
    Lamp,
    Picture,
    RayTracer,
    Shot,
    TableSurface,
    TracedMesh,
    into_frame,
    lambert,
    masks_of,
    pusher_mesh,
    wooden_texture,
)
from tests.core.world.boxes import box_asset

# Optics


ALBEDO = np.array([[0.2, 0.5, 0.8]])
shares = st.floats(0, 1)


@given(ambient=shares, diffuse=shares, cosine=st.floats(-1, 1), visible=st.sampled_from([0.0, 1.0]))
def test_radiance_is_linear_in_ambient_and_diffuse(ambient, diffuse, cosine, visible):
    args = (ALBEDO, np.array([cosine]), np.array([visible]))
    whole = lambert(*args, Lamp(ambient, diffuse))
    parts = ambient * lambert(*args, Lamp(1, 0)) + diffuse * lambert(*args, Lamp(0, 1))
    np.testing.assert_allclose(whole, parts, atol=1e-12)


def test_shadow_removes_the_whole_diffuse_term():
    shadowed = lambert(ALBEDO, np.array([1.0]), np.array([0.0]), Lamp())
    np.testing.assert_allclose(shadowed, ALBEDO * Lamp().ambient, atol=1e-12)


def test_light_from_behind_adds_nothing():
    behind = lambert(ALBEDO, np.array([-0.5]), np.array([1.0]), Lamp())
    np.testing.assert_allclose(behind, ALBEDO * Lamp().ambient, atol=1e-12)


def test_white_under_full_light_is_one():
    np.testing.assert_allclose(lambert(np.ones((1, 3)), np.ones(1), np.ones(1), Lamp()), 1, atol=1e-12)


@given(intensity=st.floats(0, 3), cosine=st.floats(-1, 1), visible=st.sampled_from([0.0, 1.0]))
def test_intensity_and_colour_are_factors_on_the_whole_radiance(intensity, cosine, visible):
    args = (ALBEDO, np.array([cosine]), np.array([visible]))
    colour = (1.0, 0.5, 0.25)
    lit = lambert(*args, Lamp(intensity=intensity, colour=colour))
    np.testing.assert_allclose(lit, intensity * np.array(colour) * lambert(*args, Lamp()), atol=1e-12)


def test_albedo_keeps_its_precision_under_any_lamp():
    args = (ALBEDO.astype(np.float32), np.ones(1, np.float32), np.ones(1, np.float32))
    assert lambert(*args, Lamp(0.1, 0.9, 0.7, (1.0, 0.9, 0.8))).dtype == np.float32


def test_a_table_without_texture_is_the_same_everywhere():
    points = np.array([[0.0, 0.0], [0.5, -0.59]], np.float32)
    np.testing.assert_array_equal(TableSurface().albedo_at(points, 0.01), np.float32([TABLE_ALBEDO] * 2))


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


@pytest.mark.parametrize("texture", [np.full((4, 4, 3), 1.5), np.full((4, 4, 3), np.nan), np.ones((4, 4))])
@pytest.mark.wrong_arrays
def test_a_texture_that_is_no_albedo_is_refused(texture):
    with pytest.raises(InvalidInput, match="texture"):
        TableSurface(texture=texture)


# Ray tracer


HEIGHT, HALF = 0.04, 0.02
BOX = box_asset("box", (2 * HALF, 2 * HALF, HEIGHT))
NO_POSES = Pose(np.zeros((0, 3)), np.zeros((0, 4)))


def above(size: int = 512, x: float = 0.0, height: float = 1.2, fov_y_deg: float = 40.0) -> Camera:
    return Camera.look_at("above", (x, 0, height), (x, 0, 0), size=size, fov_y_deg=fov_y_deg)


def box_state(light: Light, position=(0.0, 0.0, HEIGHT / 2), pusher=None) -> SceneState:
    return SceneState(("box",), Pose(np.array([position]), np.array([[1.0, 0, 0, 0]])), light, pusher)


def tracer(lamp: Lamp | None = None) -> RayTracer:
    return RayTracer({"box": TracedMesh(BOX.mesh)}, lamp=lamp)


def table_points(camera: Camera) -> np.ndarray:
    """Where the rays through pixel centres meet the table [m]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    directions = camera.ray_directions(np.stack([x, y], axis=-1))
    origin = camera.T_world_camera.position
    return origin + directions * (-origin[2] / directions[..., 2:])


def table_radiance(elevation_deg: float) -> np.ndarray:
    return np.array(TABLE_ALBEDO) * (0.25 + 0.75 * np.sin(np.deg2rad(elevation_deg)))


@pytest.mark.parametrize("elevation_deg", [80.0, 30.0, 5.0])
def test_shadow_tip_lies_where_trigonometry_says(elevation_deg):
    light = Light.from_angles(0.0, np.deg2rad(elevation_deg))  # from +x: the shadow falls toward -x
    length = HEIGHT / np.tan(np.deg2rad(elevation_deg))
    camera = above(x=-length / 2, height=max(0.5, 1.6 * length))
    (picture,) = tracer().render(box_state(light), (camera,))
    points = table_points(camera)
    on_table = picture.coverage[0] == 0
    dark = (picture.rgb[..., 0] < 0.5 * (table_radiance(elevation_deg)[0] + 0.25 * TABLE_ALBEDO[0])) & on_table
    middle = np.abs(points[..., 1]) < HALF / 2
    pixel_m = np.diff(points[0, :2, 0], axis=0)[0]
    assert points[dark & middle, 0].min() == pytest.approx(-HALF - length, abs=1.5 * abs(pixel_m))
    across = points[dark & (np.abs(points[..., 0] + HALF + length / 2) < length / 4), 1]
    assert across.max() == pytest.approx(HALF, abs=1.5 * abs(pixel_m))


def test_no_shadow_beside_a_box_under_an_overhead_light():
    camera = Camera.look_at("above", (0, 0, 3.0), (0, 0, 0), size=512, fov_y_deg=8)
    (picture,) = tracer().render(box_state(Light(np.array([0, 0, 1.0]))), (camera,))
    points = table_points(camera)
    beside = (np.abs(points[..., :2]).max(axis=-1) > HALF * 3 / (3 - HEIGHT) + 0.002) & (picture.coverage[0] == 0)
    np.testing.assert_allclose(picture.rgb[beside], np.broadcast_to(table_radiance(90), (beside.sum(), 3)), atol=1e-5)


@pytest.mark.parametrize("elevation_deg", [5.0, 10.0, 45.0, 90.0])
def test_open_table_has_no_false_shadow(elevation_deg):
    state = SceneState((), NO_POSES, Light.from_angles(0.7, np.deg2rad(elevation_deg)), None)
    for picture, camera in zip(RayTracer({}).render(state, default_cameras(64)), default_cameras(64), strict=True):
        inside = np.isfinite(picture.depth) & (np.abs(table_points(camera)[..., :2]).max(axis=-1) < 0.58)
        np.testing.assert_allclose(
            picture.rgb[inside], np.broadcast_to(table_radiance(elevation_deg), (inside.sum(), 3)), atol=1e-5
        )


def test_table_radiance_does_not_depend_on_position_and_field_of_view_of_the_camera():
    light = Light.from_angles(2.0, np.deg2rad(20))
    probe = np.array([[-0.1, 0.05, 0.0], [0.03, -0.06, 0.0], [0.1, 0.1, 0.0]])  # lit, in shadow, lit
    values = []
    for camera in (above(), above(256, height=2.0, fov_y_deg=20), *default_cameras(512)[1:3]):
        (picture,) = tracer().render(box_state(light), (camera,))
        x, y = np.floor(camera.project(probe)).astype(int).T
        values.append(picture.rgb[y, x])
    assert values[0][1, 0] < 0.6 * values[0][0, 0]
    for value in values[1:]:
        np.testing.assert_allclose(value, values[0], atol=1e-5)


def test_images_are_linear_in_ambient_and_diffuse():
    state = box_state(Light.from_angles(1.0, np.deg2rad(40)), pusher=np.array([0.1, 0.0, PUSHER_CENTRE_Z_M]))
    camera = default_cameras(96)[:1]
    lamps = (Lamp(1, 0), Lamp(0, 1), Lamp(0.3, 0.6))
    ambient, diffuse, both = (tracer(lamp).render(state, camera)[0] for lamp in lamps)
    lit = np.isfinite(both.depth)  # the background shines by itself
    np.testing.assert_allclose(both.rgb[lit], (0.3 * ambient.rgb + 0.6 * diffuse.rgb)[lit], atol=2e-2)
    inner = lit & (both.coverage.max(axis=0) > 0.999)
    np.testing.assert_allclose(both.rgb[inner], (0.3 * ambient.rgb + 0.6 * diffuse.rgb)[inner], atol=1e-6)


def test_intensity_and_colour_scale_whatever_the_lamp_reaches():
    state = box_state(Light.from_angles(1.0, np.deg2rad(40)), pusher=np.array([0.1, 0.0, PUSHER_CENTRE_Z_M]))
    camera, colour = default_cameras(96)[:1], (1.0, 0.85, 0.65)
    (usual,), (warm,) = (tracer(lamp).render(state, camera) for lamp in (Lamp(), Lamp(intensity=1.5, colour=colour)))
    pure = usual.coverage.max(axis=0) > 0.999
    pure |= np.all(np.abs(usual.rgb - table_radiance(40)) < 1e-5, axis=-1)
    np.testing.assert_allclose(warm.rgb[pure], 1.5 * np.array(colour) * usual.rgb[pure], atol=1e-5)
    beyond = np.isinf(usual.depth)
    np.testing.assert_array_equal(warm.rgb[beyond], usual.rgb[beyond])


def test_box_top_has_lambert_radiance_and_true_depth():
    light = Light.from_angles(0.3, np.deg2rad(50))
    (picture,) = tracer().render(box_state(light), (above(128),))
    centre = picture.rgb[64, 64]
    np.testing.assert_allclose(centre, 204 / 255 * (0.25 + 0.75 * np.sin(np.deg2rad(50))), atol=1e-3)
    assert picture.depth[64, 64] == pytest.approx(1.2 - HEIGHT, abs=1e-4)


def test_background_lies_beyond_the_table():
    state = SceneState((), NO_POSES, Light(np.array([0, 0, 1.0])), None)
    (picture,) = RayTracer({}).render(state, default_cameras(64)[:1])
    np.testing.assert_allclose(picture.rgb[0, 32], BACKGROUND_RADIANCE, atol=1e-6)
    assert np.isinf(picture.depth[0, 32])


def test_pusher_casts_a_shadow_on_an_object():
    light = Light.from_angles(0.0, np.deg2rad(30))
    with_pusher = box_state(light, pusher=np.array([0.08, 0.0, PUSHER_CENTRE_Z_M]))
    camera = (default_cameras(128)[1],)
    shadowed, free = tracer().render(with_pusher, camera)[0], tracer().render(box_state(light), camera)[0]
    box = (free.coverage[0] > 0.99) & (shadowed.coverage[0] > 0.99)
    assert np.mean(shadowed.rgb[box]) < np.mean(free.rgb[box]) - 0.02


def test_masks_are_disjoint_and_leave_out_what_is_hidden():
    poses = Pose(np.array([[0.0, 0, HEIGHT / 2], [-0.06, 0, HEIGHT / 2]]), np.array([[1.0, 0, 0, 0]] * 2))
    state = SceneState(("box", "far"), poses, Light(np.array([0, 0, 1.0])), None)
    both = RayTracer({"box": TracedMesh(BOX.mesh), "far": TracedMesh(BOX.mesh)})
    low = Camera.look_at("low", (0.5, 0, 0.03), (0, 0, 0.02), size=128, fov_y_deg=20)
    (picture,) = both.render(state, (low,))
    masks = masks_of(picture, 2)
    assert not np.any(masks[0] & masks[1])
    assert masks[0].sum() > 100
    assert masks[1].sum() < 0.2 * masks[0].sum()


def test_order_of_objects_changes_nothing():
    poses = Pose(
        np.array([[0.0, 0, HEIGHT / 2], [-0.05, 0.03, HEIGHT / 2]]),
        quaternion_exp(np.array([[0, 0, 0.3], [0, 0, 1.0]])),
    )
    meshes = {"a": TracedMesh(BOX.mesh), "b": TracedMesh(box_asset("b", (0.04, 0.02, HEIGHT), colour=90).mesh)}
    light = Light.from_angles(0.5, 0.4)
    ab = SceneState(("a", "b"), poses, light, None)
    ba = SceneState(("b", "a"), poses[[1, 0]], light, None)
    first, second = (RayTracer(meshes).render(s, default_cameras(96)[:2]) for s in (ab, ba))
    for x, y in zip(first, second, strict=True):
        np.testing.assert_array_equal(x.rgb, y.rgb)
        np.testing.assert_array_equal(x.coverage, y.coverage[::-1])


def test_views_in_threads_equal_views_one_by_one():
    state = box_state(Light.from_angles(0.5, 0.4))
    meshes = {"box": TracedMesh(BOX.mesh)}
    with ThreadPoolExecutor(2) as executor:
        threaded = RayTracer(meshes, executor=executor).render(state, default_cameras(64))
    for x, y in zip(threaded, RayTracer(meshes).render(state, default_cameras(64)), strict=True):
        np.testing.assert_array_equal(x.rgb, y.rgb)


@pytest.mark.slow
@pytest.mark.parametrize("size", [16, 95])
def test_default_quality_is_within_38_db_of_supersampling(library, size):
    names = ("006_mustard_bottle", "003_cracker_box", "035_power_drill")
    assets = {name: library.load(name) for name in names}
    positions = np.array([[0.05, 0.1, 0.0955], [-0.12, -0.05, 0.1065], [0.12, -0.1, 0.0285]])
    turns = quaternion_exp(np.array([[0, 0, 0.2], [0, 0, 0.7], [0, 0, 2.0]]))
    meshes = RayTracer({name: TracedMesh(asset.mesh) for name, asset in assets.items()})
    cameras = (*default_cameras(size), goal_camera(size))
    for azimuth, elevation in ((0.7, 30), (3.0, 8), (-1.5, 75)):
        light = Light.from_angles(azimuth, np.deg2rad(elevation))
        state = SceneState(names, Pose(positions, turns), light, np.array([0.0, -0.15, PUSHER_CENTRE_Z_M]))
        default = meshes.render(state, cameras)
        exact = meshes.render(state, cameras, samples=8, sharp=True)
        for picture, truth in zip(default, exact, strict=True):
            mask = masks_of(truth, 3).any(axis=0)
            psnr = -10 * np.log10(np.mean((picture.rgb - truth.rgb)[mask] ** 2))
            assert psnr >= 38
            differing = (masks_of(picture, 3) != masks_of(truth, 3)).sum()
            assert differing <= max(3, 0.03 * mask.sum())  # pixels that are covered by half


# Shot


CAMERA = Camera.look_at("above", (0, 0, 1.2), (0, 0, 0), size=400)
UP, LEVEL = np.array([0, 0, 1], np.float32), np.array([1.0, 0, 0, 0])


def shot(*bodies: Body, samples: int = 3) -> Shot:
    return Shot(bodies, UP, CAMERA, Lamp(), None, samples, False)


def test_samples_fill_the_chosen_pixels_evenly():
    pixels = np.zeros((400, 400), bool)
    pixels[7, 3] = pixels[20, 30] = True
    (samples,) = shot(samples=2).sampled(pixels)
    assert samples.rows.tolist() == [7, 20]
    np.testing.assert_allclose(samples.points[:4], [[3.25, 7.25], [3.75, 7.25], [3.25, 7.75], [3.75, 7.75]], atol=1e-12)
    np.testing.assert_allclose(samples.means(samples.points), [[3.5, 7.5], [30.5, 20.5]], atol=1e-12)


def test_many_pixels_come_in_several_parts_and_none_twice():
    parts = list(shot().sampled(np.ones((400, 400), bool)))
    assert len(parts) > 1
    seen = np.concatenate([400 * part.rows + part.columns for part in parts])
    np.testing.assert_array_equal(seen, np.arange(400 * 400))


def test_directions_reach_the_depth_one():
    points = np.random.default_rng(0).uniform(0, 400, (5, 2)).astype(np.float32)
    directions = shot().directions(points)
    inverse = CAMERA.T_world_camera.inverse()
    np.testing.assert_allclose(inverse.apply(shot().origin + directions)[:, 2], 1, atol=1e-6)
    np.testing.assert_allclose(CAMERA.project(shot().origin + directions), points, atol=1e-3)


@pytest.mark.parametrize("receiver", [None, 0])
def test_light_is_stopped_by_bodies(receiver):
    box = Body(TracedMesh(box_asset("box", (0.04, 0.04, 0.04)).mesh), Pose(np.array([0.1, 0, 0.3]), LEVEL))
    points = np.array([[0.1, 0, 0], [0.1, 0, 0.33], [0.13, 0, 0]], np.float32)  # below, above, beside
    np.testing.assert_array_equal(shot(box).lit(points, receiver), [0, 1, 1])


# Traced mesh


SIZE = np.array([0.1, 0.06, 0.04])
MESH = TracedMesh(box_asset("box", tuple(SIZE)).mesh)


def slab_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to an axis-aligned box by the slab method, the closed form."""
    with np.errstate(divide="ignore"):
        near, far = np.sort(np.stack([(-SIZE / 2 - origins) / directions, (SIZE / 2 - origins) / directions]), axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, NO_HIT)


def test_intersections_and_occlusion_agree_with_the_slab_method():
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(2000, 3))
    origins = (0.5 * origins / np.linalg.norm(origins, axis=1, keepdims=True)).astype(np.float32)
    directions = (rng.uniform(-0.06, 0.06, (2000, 3)) - origins).astype(np.float32)
    distance, faces, _ = MESH.intersect(origins, directions)
    expected = slab_distance(origins.astype(float), directions.astype(float))
    graze = np.abs(expected - distance) > 1e-4
    assert graze.mean() < 0.002
    np.testing.assert_array_equal(MESH.occludes(origins, directions)[~graze], (expected < NO_HIT)[~graze])
    assert np.all((faces >= 0) == (distance < NO_HIT))


def test_normals_face_the_ray():
    origins = np.array([[0.5, 0, 0], [0, 0, 0]], np.float32)  # from outside, and from inside the box
    directions = np.array([[-1, 0, 0], [1, 0, 0]], np.float32)
    _, faces, barycentric = MESH.intersect(origins, directions)
    normals = MESH.surface(faces, barycentric, directions).normals
    np.testing.assert_allclose(normals, [[1, 0, 0], [-1, 0, 0]], atol=1e-6)


def test_screen_box_holds_every_covered_pixel():
    rng = np.random.default_rng(1)
    camera = default_cameras(128)[0]
    for _ in range(20):
        pose = Pose(np.array([*rng.uniform(-0.3, 0.3, 2), 0.1]), quaternion_exp(rng.normal(size=3)))
        T_camera_object = camera.T_world_camera.inverse() @ pose
        box = MESH.screen_box(T_camera_object, camera.intrinsics, 128, 128)
        assert box is not None
        corners = np.stack(np.meshgrid(*MESH.bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
        pixels = np.clip(camera.project(pose.apply(corners)), 0, 128)
        assert np.all(pixels >= np.array(box[:2]) - 1e-6)
        assert np.all(pixels <= np.array(box[2:]) + 1e-6)


def test_screen_box_is_none_behind_the_camera():
    camera = default_cameras(64)[0]
    behind = camera.T_world_camera @ Pose(np.array([0, 0, -1.0]), Pose.identity().quaternion)
    assert MESH.screen_box(camera.T_world_camera.inverse() @ behind, camera.intrinsics, 64, 64) is None


def test_rays_move_into_the_object_frame():
    pose = Pose(np.array([0.1, 0.2, 0.3]), quaternion_exp(np.array([0.4, -0.2, 0.9])))
    points = np.random.default_rng(2).normal(size=(5, 3)).astype(np.float32)
    local, _ = into_frame(pose, points, points)
    np.testing.assert_allclose(local, pose.inverse().apply(points), atol=1e-6)


@pytest.mark.parametrize("footprint_m", [0.0, 0.002, 0.05, 10.0])
def test_albedo_of_one_colour_is_that_colour_at_every_level(footprint_m):
    uv = np.random.default_rng(3).uniform(size=(700, 2)).astype(np.float32)
    np.testing.assert_allclose(MESH.albedo(uv, footprint_m), 204 / 255, atol=1e-6)


# Traced table


TABLE_BOX = TracedMesh(box_asset("box", (0.08, 0.06, 0.1)).mesh)
OVERHEAD = Light(np.array([0, 0, 1.0]))
LOW = Light.from_angles(0.7, np.deg2rad(25))
EMPTY = SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), OVERHEAD, None)
PUSHER = np.array([0.2, -0.1, PUSHER_CENTRE_Z_M])
PROBES = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 2))


def with_box(light: Light) -> SceneState:
    return SceneState(
        ("box",), Pose(np.array([[0.0, 0, 0.05]]), quaternion_exp(np.array([[0, 0, 0.4]]))), light, PUSHER
    )


def pictures(state: SceneState, cameras: tuple[Camera, ...], **given) -> tuple[Picture, ...]:
    quality = {key: given.pop(key) for key in ("samples", "sharp") if key in given}
    return RayTracer({"box": TABLE_BOX}, **given).render(state, cameras, **quality)


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours that change smoothly over the table."""
    return np.stack([0.5 + 0.3 * np.sin(9 * x), 0.5 + 0.3 * np.cos(7 * y), 0.5 + 0.2 * np.sin(6 * (x + y))], axis=-1)


def texture_of(colours, side: int = 512) -> TableSurface:
    centres = ((np.arange(side) + 0.5) / side - 0.5) * TABLE_SIDE_M
    return TableSurface(texture=colours(*np.meshgrid(centres, -centres)).astype(np.float32))


@pytest.mark.parametrize("light", [OVERHEAD, LOW])
def test_open_table_is_its_texture_times_the_irradiance(light):
    state = SceneState((), EMPTY.poses, light, None)
    cameras = (*default_cameras(256), goal_camera(256))
    for camera, picture in zip(cameras, pictures(state, cameras, table=texture_of(waves)), strict=True):
        x, y = np.floor(camera.project(np.column_stack([PROBES, np.zeros(40)]))).astype(int).T
        irradiance = 0.25 + 0.75 * light.direction[2]
        inside = (np.stack([x, y]).min(axis=0) >= 0) & (np.stack([x, y]).max(axis=0) < 256)
        assert inside.sum() >= 20
        seen = picture.rgb[y[inside], x[inside]]
        np.testing.assert_allclose(
            seen, irradiance * waves(*PROBES[inside].T), atol=0.02
        )  # probes are no pixel centres


def test_a_texture_of_one_colour_is_a_table_of_one_colour():
    plain = TableSurface(texture=np.full((8, 8, 3), TABLE_ALBEDO, np.float32))
    cameras = default_cameras(96)[:2]
    for mine, usual in zip(
        pictures(with_box(LOW), cameras, table=plain), pictures(with_box(LOW), cameras), strict=True
    ):
        np.testing.assert_allclose(mine.rgb, usual.rgb, atol=1e-6)
        np.testing.assert_array_equal(mine.depth, usual.depth)
        np.testing.assert_array_equal(mine.coverage, usual.coverage)


@pytest.mark.parametrize("surface", [TableSurface((0.3, 0.4, 0.5)), texture_of(waves)])
def test_shadow_on_any_table_is_the_ambient_share_of_its_light(surface):
    camera, lamp = (goal_camera(128),), Lamp(0.1, 0.9)
    (shaded,) = pictures(with_box(LOW), camera, table=surface, lamp=lamp)
    (open_,) = pictures(SceneState((), EMPTY.poses, LOW, None), camera, table=surface, lamp=lamp)
    dark = shaded.coverage.sum(axis=0) == 0
    ratio = (shaded.rgb / open_.rgb)[dark]
    umbra = ratio.max(axis=1) < 0.5
    assert umbra.sum() > 100
    expected = 0.1 / (0.1 + 0.9 * LOW.direction[2])
    np.testing.assert_allclose(np.median(ratio[umbra], axis=0), expected, rtol=1e-3)
    np.testing.assert_allclose(np.median(ratio[~umbra], axis=0), 1, rtol=1e-3)


@pytest.mark.parametrize("size", [48, pytest.param(128, marks=pytest.mark.slow)])
def test_a_wooden_table_is_within_36_db_of_supersampling(size):
    wood = TableSurface(texture=wooden_texture(np.random.default_rng(0), 1024))
    cameras = (default_cameras(size)[1], goal_camera(size))
    default = pictures(with_box(LOW), cameras, table=wood)
    exact = pictures(with_box(LOW), cameras, table=wood, samples=10, sharp=True)
    for picture, truth in zip(default, exact, strict=True):
        assert -10 * np.log10(np.mean((picture.rgb - truth.rgb) ** 2)) >= 36


def test_finest_patterns_turn_grey():
    grid = np.indices((1024, 1024)).sum(axis=0)[..., None] % 2 * np.ones(3, np.float32)
    camera = goal_camera(64)
    (picture,) = pictures(EMPTY, (camera,), table=TableSurface(texture=grid))
    inside = picture.rgb[24:40, 24:40]
    np.testing.assert_allclose(inside, 0.5, atol=0.02)


def test_the_background_has_no_texture():
    camera = (default_cameras(64)[0],)
    (usual,), (wooden,) = (pictures(EMPTY, camera, table=table) for table in (None, texture_of(waves)))
    beyond = np.isinf(usual.depth)
    assert beyond.any()
    np.testing.assert_array_equal(wooden.rgb[beyond], usual.rgb[beyond])


# Wood


@pytest.fixture(scope="module")
def wood():
    return wooden_texture(np.random.default_rng(0), 512)


def test_wood_is_an_albedo_as_bright_as_the_usual_table(wood):
    assert wood.shape == (512, 512, 3)
    assert wood.dtype == np.float32
    assert wood.min() > 0
    assert wood.max() < 1
    np.testing.assert_allclose(wood.mean(axis=(0, 1)), TABLE_ALBEDO, atol=1e-3)


def test_the_same_generator_draws_the_same_wood(wood):
    np.testing.assert_array_equal(wood, wooden_texture(np.random.default_rng(0), 512))
    assert np.abs(wood - wooden_texture(np.random.default_rng(1), 512)).mean() > 0.02


def test_grain_runs_along_the_boards(wood):
    along, across = (np.abs(np.diff(wood, axis=axis)).mean() for axis in (1, 0))
    assert across > 4 * along
    assert 0.05 < wood.std() < 0.15


def test_boards_are_parted_by_dark_joints(wood):
    rows = wood.mean(axis=(1, 2))
    assert ((rows < 0.6 * rows.mean()) & (np.roll(rows, -1) > 0.8 * rows.mean())).sum() == 10


# Pusher body


def test_pusher_is_a_closed_cylinder_of_the_stated_size():
    mesh = pusher_mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    solid.merge_vertices(merge_norm=True, merge_tex=True)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(np.pi * PUSHER_RADIUS_M**2 * PUSHER_HEIGHT_M, rel=2e-3)
    np.testing.assert_allclose(solid.extents, [2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M], rtol=1e-5)
    np.testing.assert_allclose(solid.bounds.mean(axis=0), 0, atol=1e-7)


def test_normals_are_unit_and_outward_and_the_wall_is_round():
    mesh = pusher_mesh()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    corners = mesh.vertices[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("ij,ij->i", flat, mesh.normals[mesh.faces[:, 0]]) > 0)


def test_colour_is_the_stated_albedo():
    np.testing.assert_allclose(pusher_mesh().texture[0, 0] / 255, PUSHER_ALBEDO, atol=1 / 255)
