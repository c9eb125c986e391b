"""Ray-traced pictures under a lamp at a finite distance, against closed forms and the field renderer."""

import numpy as np
import pytest

from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import Quality, SceneBatch
from osfcore.world.imaging import TABLE_ALBEDO, RayTracer, TracedMesh, masks_of
from tests.core.world.boxes import box_asset, slab_spans, table_points
from tests.support.rendered_scenes import block, table_of

HALF = np.array([0.03, 0.02, 0.05])
BOX = TracedMesh(box_asset("box", tuple(2 * HALF)).mesh)
TURN = quaternion_exp(np.array([0, 0, 0.4]))
BARE = SpotLamp(np.array([0.2, 0.1, 0.35]), np.zeros(3), 80, 90)
ABOVE = Camera.look_at("above", (0, 0, 1.2), (0, 0, 0), size=256, fov_y_deg=30)


def boxes(*places, pusher=None, light=(0, 0, 1.0)) -> SceneState:
    """Boxes turned about the vertical, at places."""
    poses = Pose(np.array(places, float).reshape(-1, 3), np.tile(TURN, (len(places), 1)))
    return SceneState(tuple(f"box {i}" for i in range(len(places))), poses, Light(np.array(light)), pusher)


def traced(state: SceneState, camera: Camera, spot: SpotLamp | None):
    return RayTracer(dict.fromkeys(state.names, BOX), spot=spot).render(state, (camera,))[0]


def open_irradiance(points: np.ndarray, spot: SpotLamp) -> np.ndarray:
    return 0.25 + 0.75 * spot.toward(points)[..., 2] * spot.falloff(points) * spot.spot_factor(points)


@pytest.mark.parametrize("spot", [BARE, SpotLamp(np.array([0, 0, 0.3]), np.array([0.1, 0.0, 0]), 15, 15)])
@pytest.mark.parametrize("camera", [ABOVE, goal_camera(128)])
def test_the_empty_table_falls_off_and_has_the_cones_edge(spot, camera):
    picture, points = traced(boxes(), camera, spot), table_points(camera)
    expected = np.array(TABLE_ALBEDO) * open_irradiance(points, spot)[..., None]
    corners = [open_irradiance(points + [dx, dy, 0], spot) for dx in (-0.004, 0.004) for dy in (-0.004, 0.004)]
    smooth = (np.max(corners, axis=0) - np.min(corners, axis=0) < 0.1) & (np.abs(points[..., :2]).max(axis=-1) < 0.59)
    assert smooth.mean() > 0.6
    np.testing.assert_allclose(picture.rgb[smooth], expected[smooth], atol=2e-3)


@pytest.mark.parametrize("lamp", [(-0.1, 0.25, 0.2), (-0.25, -0.1, 0.5)])
def test_the_shadow_of_a_box_is_its_perspective_projection(lamp):
    spot, centre = SpotLamp(np.array(lamp), np.zeros(3), 80, 90), np.array([0.01, 0.0, 0.05])
    picture, points = traced(boxes(centre), ABOVE, spot), table_points(ABOVE)
    on_table = picture.coverage[0] == 0
    into = Pose(centre, TURN).inverse()
    start = into.apply(points)
    enter, leave = slab_spans(HALF, start, into.apply(spot.position) - start)
    dark = np.maximum(enter, 0) < np.minimum(leave, 1)  # the way to the lamp passes through the box
    bright = TABLE_ALBEDO[0] * open_irradiance(points, spot)
    shaded = picture.rgb[..., 0] < (bright + 0.25 * TABLE_ALBEDO[0]) / 2
    assert (dark & on_table).sum() > 200
    assert (shaded ^ dark)[on_table].sum() < 0.01 * (dark & on_table).sum()
    edge = np.abs(picture.rgb[..., 0] - np.where(dark, 0.25 * TABLE_ALBEDO[0], bright)) > 2e-3
    assert (edge & on_table).sum() < 0.2 * (dark & on_table).sum()  # pixels on the outline


def test_what_lies_beyond_the_lamp_casts_no_shadow():
    low = SpotLamp(np.array([0, 0, 0.2]), np.zeros(3), 60, 70)
    camera = Camera.look_at("side", (0.4, 0, 0.1), (0, 0, 0), size=64, fov_y_deg=20)
    empty, beyond, between = (traced(boxes(*places), camera, low) for places in ([], [(0, 0, 0.3)], [(0, 0, 0.1)]))
    np.testing.assert_allclose(beyond.rgb, empty.rgb, atol=1e-6)
    assert between.rgb[40, 32, 0] < 0.3 * empty.rgb[40, 32, 0]


def test_a_lamp_200_m_away_is_the_distant_light():
    light = np.array([0.4, -0.3, 0.5])
    state = boxes((0.03, 0, 0.05), (-0.06, 0.05, 0.05), pusher=np.array([0, -0.1, PUSHER_CENTRE_Z_M]), light=light)
    far = SpotLamp(200 * light / np.linalg.norm(light), np.zeros(3), 10, 20)
    for camera in (default_cameras(96)[0], goal_camera(96)):
        near, distant = (traced(state, camera, spot) for spot in (far, None))
        assert np.mean(np.abs(near.rgb - distant.rgb).max(axis=-1) > 5e-3) < 2e-3  # samples on outlines of shadows
        np.testing.assert_allclose(near.rgb, distant.rgb, atol=0.05)
        np.testing.assert_array_equal(near.coverage, distant.coverage)


@pytest.mark.parametrize("lamp", [(0.3, 0.1, 0.45), (-0.2, 0.25, 0.3)])
def test_the_field_renderer_draws_the_shadows_that_rays_draw(lamp):
    """The same boxes as fields and as meshes."""
    spot = SpotLamp(np.array(lamp), np.zeros(3), 60, 75)
    places = [(0.05, 0.02, 0.05), (-0.06, -0.03, 0.05)]
    state, camera = boxes(*places), goal_camera(128)
    picture, empty = traced(state, camera, spot), traced(boxes(), camera, spot)
    table = table_of(np.tile(np.float32(TABLE_ALBEDO), (2, 2, 1)), 0.6)
    field = block(HALF, voxel=0.002, albedo=(0.8, 0.8, 0.8))
    renderer = SceneRenderer(dict.fromkeys(state.names, field), table)
    quality = Quality(samples_per_side=2)
    ours, bare = (
        renderer.render(SceneBatch.of(s, spot), (camera,), quality=quality).rgb[0, 0] for s in (state, boxes())
    )
    on_table = ~masks_of(picture, 2).any(axis=0) & (picture.coverage.sum(axis=0) == 0) & np.isfinite(picture.depth)
    theirs, mine = (np.sum(b - a, axis=-1) > 0.15 for a, b in ((picture.rgb, empty.rgb), (ours, bare)))
    assert (theirs & on_table).sum() > 100
    assert (theirs & mine & on_table).sum() / ((theirs | mine) & on_table).sum() > 0.9
    assert -10 * np.log10(np.mean((ours - picture.rgb)[np.isfinite(picture.depth)] ** 2)) > 30
