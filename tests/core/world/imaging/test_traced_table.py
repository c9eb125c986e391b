import numpy as np
import pytest

from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO, Lamp, Picture, RayTracer, TableSurface, TracedMesh, wooden_texture
from tests.core.world.boxes import box_asset

BOX = TracedMesh(box_asset("box", (0.08, 0.06, 0.1)).mesh)
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
    return RayTracer({"box": BOX}, **given).render(state, cameras, **quality)


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
