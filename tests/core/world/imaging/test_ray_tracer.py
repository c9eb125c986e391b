from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.world.imaging import BACKGROUND_RADIANCE, TABLE_ALBEDO, Lamp, RayTracer, TracedMesh, masks_of
from tests.core.world.boxes import box_asset

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
