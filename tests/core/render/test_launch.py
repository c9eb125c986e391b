import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.render.kernels import render_batch
from osfcore.render.renderer import SceneRenderer, screen_boxes
from osfcore.render.types import EXACT, OUTPUTS, PLANNING, SceneBatch
from tests.core.render.scenes import UPRIGHT, ball, block, plain_table, state, view

CORNERS = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1


@given(seed=st.integers(0, 10**6))
def test_a_screen_box_holds_every_pixel_that_the_box_touches(seed):
    """Boxes in front of, around, beside, half behind and behind the camera."""
    rng = np.random.default_rng(seed)
    camera = Camera.look_at(
        "view", rng.normal(size=3), rng.normal(size=3) * 0.1, size=32, fov_y_deg=rng.uniform(20, 120)
    )
    half, centre = rng.uniform(0.01, 0.4, 3), rng.normal(size=3) * 0.7
    turn = quaternion_exp(rng.normal(size=3))
    pose = Pose(centre, turn)
    left, right, top, bottom = screen_boxes(pose.apply(CORNERS * half)[None, None], camera)[0][0, 0]
    inside = pose.apply(rng.uniform(-1, 1, (500, 3)) * half)
    depth = camera.T_world_camera.inverse().apply(inside)[:, 2]
    u, v = camera.project(inside[depth > 1e-3]).T
    visible = (u >= 0) & (u < 32) & (v >= 0) & (v < 32)
    u, v = np.floor(u[visible]), np.floor(v[visible])
    assert np.all((left <= u) & (u < right) & (top <= v) & (v < bottom))
    assert 0 <= left <= right <= 32
    assert 0 <= top <= bottom <= 32
    if np.all(camera.T_world_camera.inverse().apply(pose.apply(CORNERS * half))[:, 2] < 0):
        assert (right - left) * (bottom - top) == 0


def test_a_screen_box_is_tight():
    camera = view((0, 0, 1), (0, 0, 0), 64, 53.13)  # half a metre to each side at the distance of 1 m
    left, right, top, bottom = screen_boxes((CORNERS * [0.25, 0.25, 0])[None, None], camera)[0][0, 0]
    np.testing.assert_allclose([left, right, top, bottom], [16, 48, 16, 48], atol=1)


@pytest.mark.parametrize("value", [np.inf, 1e308, np.nan])
def test_numbers_beyond_all_bounds_fill_the_screen(value):
    """Rather than point outside of it, where compiled code would write."""
    points = np.full((1, 1, 8, 3), value)
    points[0, 0, 0] = 0
    with np.errstate(all="ignore"):
        left, right, top, bottom = screen_boxes(points, view((0, 0, 1), (0, 0, 0), 32))[0][0, 0]
    assert 0 <= left <= right <= 32
    assert 0 <= top <= bottom <= 32


@pytest.mark.parametrize("azimuth_deg", [0, 100, 250])
@pytest.mark.parametrize("elevation_deg", [6, 30, 85])
def test_no_shadow_is_cut_off(azimuth_deg, elevation_deg):
    """A scene whose second, transparent object makes every pixel be looked at shows the same shadows."""
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    light = (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))
    fields = {"block": block(), "glass": block((0.7, 0.7, 0.1), voxel=0.1, g=-7.0)}
    camera, tilt = view((0.3, 0.2, 0.6), (0, 0, 0), 48, 70), quaternion_exp(np.array([0.3, 0.5, 0]))
    renderer = SceneRenderer(fields, plain_table(half_side=2.0))
    for height in (0.06, 0.01):
        block_pose = ((0.05, 0, height), tilt)
        one = state({"block": block_pose}, light, (-0.1, 0.1, PUSHER_CENTRE_Z_M))
        two = state({"block": block_pose, "glass": ((0, 0, 0), UPRIGHT)}, light, (-0.1, 0.1, PUSHER_CENTRE_Z_M))
        a, b = (renderer.render(SceneBatch.of(s), [camera]).rgb for s in (one, two))
        np.testing.assert_allclose(a, b, atol=1e-6)


@given(seed=st.integers(0, 10**6), near=st.booleans(), has_pusher=st.booleans())
def test_a_scene_of_a_batch_looks_as_it_does_alone(seed, near, has_pusher):
    """Whatever it has in common with others: objects, light, nothing; one that moves shades one that does not."""
    rng = np.random.default_rng(seed)
    scenes, names = 5, ("a", "b", "c")
    fields = {"a": ball(), "b": block(), "c": block((0.05, 0.02, 0.1))}
    poses = rng.uniform(-0.12, 0.12, (2, 3, 3)) + [0, 0, 0.13]  # each object in one of two places
    turns = np.array([[quaternion_exp(rng.normal(size=3)) for _ in names] for _ in range(2)])
    which = (rng.uniform(size=(scenes, 3)) < 0.3).astype(int)
    lights = np.array([[0.5, 0.1, 0.86], [-0.8, 0.3, 0.52]])[(rng.uniform(size=scenes) < 0.2).astype(int)]
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    pusher = np.array([[0.1, -0.1, PUSHER_CENTRE_Z_M], [-0.1, 0.1, PUSHER_CENTRE_Z_M]])[which[:, 0]]
    spots = tuple(SpotLamp(np.array([0.1, 0.2, 0.5 + 0.1 * n]), np.zeros(3), 30, 40) for n in which[:, 1])
    batch = SceneBatch(
        names, poses[which, np.arange(3)], turns[which, np.arange(3)], lights, pusher if has_pusher else None,
        spots if near else None,
    )  # fmt: skip
    renderer = SceneRenderer(fields, plain_table())
    cameras = [view((0.3, 0.2, 0.6), (0, 0, 0), 24, 60), view((-0.4, 0.1, 0.3), (0, 0, 0), 24, 60)]
    only = rng.uniform(size=(2, 24, 24)) < 0.9
    together = renderer.render(batch, cameras, quality=PLANNING, outputs=OUTPUTS, only=only)
    for number in range(scenes):
        row = slice(number, number + 1)
        one = SceneBatch(
            names, batch.positions[row], batch.quaternions[row], batch.lights[row],
            None if batch.pusher is None else batch.pusher[row], None if batch.spots is None else batch.spots[row],
        )  # fmt: skip
        alone = renderer.render(one, cameras, quality=PLANNING, outputs=OUTPUTS, only=only)
        for output in ("rgb", "opacity", "masks", "depth"):
            np.testing.assert_array_equal(getattr(together, output)[row], getattr(alone, output))


def test_no_batch_makes_the_compiler_work_again():
    """Every way of building a batch leads to arrays of one layout: compiling anew takes half a minute."""
    fields, spot = {"a": ball(), "b": block()}, SpotLamp(np.array([0, 0.1, 0.5]), np.zeros(3), 30, 40)
    for table in (None, plain_table()):
        for names in (("a",), ("a", "b"), ()):
            for scenes in (1, 2):
                count = len(names)
                positions = np.asfortranarray(np.full((scenes, count, 3), 0.1, np.float32))
                quaternions = np.broadcast_to(UPRIGHT, (scenes, count, 4))
                lights = np.broadcast_to([0, 0, 1.0], (scenes, 3))
                for pusher in (None, np.zeros((scenes, 3))):
                    for spots in (None, (spot,) * scenes):
                        batch = SceneBatch(names, positions, quaternions, lights, pusher, spots)
                        for quality in (EXACT, PLANNING):
                            for cameras in ([view(size=16)], [view(size=16).resized(16, 20)] * 2):
                                SceneRenderer(fields, table).render(batch, cameras, quality=quality, outputs=OUTPUTS)
                                SceneRenderer(fields, table).render(batch, cameras, quality=quality)
    assert len(render_batch.signatures) == 2  # distant lights, near lamps
