from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName
from osfcore.fields.kiloosf import MOST_HIDDEN, network_size
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.render.kernels import render_batch
from osfcore.render.reference import render_on_device
from osfcore.render.renderer import SceneRenderer, screen_boxes
from osfcore.render.types import EXACT, MASK_OPACITY, MOST_OBJECTS, OUTPUTS, PLANNING, Quality, SceneBatch
from tests.support.errors import about
from tests.support.rendered_scenes import (
    UPRIGHT,
    ball,
    block,
    both,
    fog,
    plain_table,
    random_scene,
    state,
    view,
    wooden_table,
)

CAMERAS = {
    "usual": view((0.45, 0.1, 0.35), size=24, fov_y_deg=40),
    "close": view((0.16, -0.05, 0.12), size=24, fov_y_deg=60),
    "inside": view((0.02, 0.01, 0.06), (0.1, 0.0, 0.0), 24, 90),
    "away": view((0.4, 0, 0.3), (1.0, 0, 0.5), 24, 60),
    "below": view((0.3, 0, -0.2), (0, 0, 0.03), 24, 60),
    "flat": view((0.5, 0, 0.03), (0, 0, 0.03), 24, 40),
    "not square": view(size=48).resized(40, 24),
}


def drawn(fields, table, scene, *cameras, quality=EXACT, spot=None):
    return SceneRenderer(fields, table).render(SceneBatch.of(scene, spot), cameras, quality=quality, outputs=OUTPUTS)


def random_lamp(seed: int) -> SpotLamp:
    rng = np.random.default_rng(seed)
    place = Light.from_angles(rng.uniform(-np.pi, np.pi), np.arcsin(rng.uniform(0.3, 1.0))).direction
    inner = rng.uniform(10, 40)
    aim = np.array([*rng.uniform(-0.05, 0.05, 2), 0])
    return SpotLamp(rng.uniform(0.3, 0.8) * place, aim, inner, inner + rng.uniform(0, 30))


def same(slow, fast, atol: float = 1e-3) -> None:
    for name in ("rgb", "opacity", "depth"):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=atol, err_msg=name)
    clear = np.abs(slow.opacity - MASK_OPACITY) > 1e-3
    np.testing.assert_array_equal(fast.masks[clear], slow.masks[clear])


# Seeds are chosen so that one, two and four objects, pushers and lights down to 10 deg all occur.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "spot"), [*((seed, None) for seed in (1, 2, 6, 9, 11)), *((seed, random_lamp(seed)) for seed in (1, 6, 9))]
)
def test_exact_is_the_reference(seed, spot):
    fields, scene = random_scene(seed)
    table = None if seed % 3 == 0 else wooden_table(seed=seed)
    camera = view(np.random.default_rng(seed).normal(size=3) * 0.1 + [0.35, 0, 0.3], size=16, fov_y_deg=50)
    slow, fast = both(fields, table, scene, camera, spot=spot)
    same(slow, fast, 2e-3 if spot else 1e-3)
    assert fast.rgb.dtype == fast.opacity.dtype == fast.depth.dtype == np.float32
    there = render_on_device(fields, table, SceneBatch.of(scene, spot), [camera], "cpu", EXACT, OUTPUTS)
    np.testing.assert_allclose(there.rgb, fast.rgb, atol=2e-3)


@pytest.mark.parametrize("name", CAMERAS)
def test_exact_is_the_reference_from_odd_places(name):
    """A camera close by, within an object, looking away, below the table, level with it."""
    fields, scene = random_scene(9)
    scene = replace(scene, pusher=np.array([0.05, -0.05, PUSHER_CENTRE_Z_M]))
    same(*both(fields, wooden_table(), scene, CAMERAS[name]))


@pytest.mark.parametrize("light", [(1, 0.2, np.tan(np.deg2rad(10))), (0.3, 0, 1)])
def test_objects_that_sink_into_the_table_shade_it_as_in_the_reference(light):
    """Candidates of a search do; the part below shows and shades nothing."""
    fields = {"a": block(albedo=(0.9, 0.2, 0.2)), "b": ball()}
    tilted = quaternion_exp(np.array([0.5, 0.4, 0.1]))
    scene = state({"a": ((0, 0.05, 0.01), tilted), "b": ((0.02, -0.08, -0.02), UPRIGHT)}, light)
    same(*both(fields, plain_table(), scene, view((0.3, 0.1, 0.4), size=24, fov_y_deg=60)))


def test_several_rays_a_pixel_are_those_of_the_reference():
    fields, scene = random_scene(9)
    table = plain_table(half_side=0.15)  # whose edge is in view
    slow, fast = both(fields, table, scene, CAMERAS["usual"], Quality(samples_per_side=2))
    np.testing.assert_allclose(fast.rgb, slow.rgb, atol=1e-3)
    np.testing.assert_allclose(fast.opacity, slow.opacity, atol=1e-3)
    np.testing.assert_allclose(fast.depth, slow.depth, atol=5e-3)  # the mean over a pixel's rays, less exactly
    assert np.abs(drawn(fields, table, scene, CAMERAS["usual"]).rgb - fast.rgb).max() > 0.05


@pytest.mark.parametrize("seed", range(3))
def test_planning_stays_above_40_db(seed):
    """Against the exact path, which the tests above tie to the reference; with hard edges, as trained fields have."""
    rng = np.random.default_rng(seed)
    fields = {
        "a": block(rng.uniform(0.02, 0.05, 3), voxel=0.002, albedo=tuple(rng.uniform(0.2, 0.9, 3))),
        "b": ball(rng.uniform(0.02, 0.05), voxel=0.002, albedo=tuple(rng.uniform(0.2, 0.9, 3))),
        "c": block(rng.uniform(0.02, 0.05, 3), voxel=0.002),
    }
    places = np.concatenate([rng.uniform(-0.1, 0.1, (3, 2)), rng.uniform(0.03, 0.08, (3, 1))], axis=1)
    poses = {name: (place, quaternion_exp(rng.normal(size=3))) for name, place in zip(fields, places, strict=True)}
    scene = state(poses, pusher=(0.05, -0.08, PUSHER_CENTRE_Z_M))
    camera = Camera.look_at("0", (0.65, 0, 0.55), (0, 0, 0.04), size=128)
    for spot in (None, random_lamp(seed)):
        exact, planned = (
            drawn(fields, wooden_table(), scene, camera, quality=quality, spot=spot).rgb
            for quality in (EXACT, PLANNING)
        )
        assert -10 * np.log10(np.mean((planned - exact) ** 2)) > 40


@pytest.mark.parametrize("quality", [EXACT, PLANNING])
@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_objects_changes_nothing(seed, quality):
    fields, scene = random_scene(seed, count=4)
    order = np.random.default_rng(seed).permutation(4)
    shuffled = replace(scene, names=tuple(scene.names[i] for i in order), poses=scene.poses[order])
    a, b = (drawn(fields, wooden_table(), s, view(), quality=quality) for s in (scene, shuffled))
    np.testing.assert_allclose(a.rgb, b.rgb, atol=1e-6)
    np.testing.assert_allclose(a.opacity[:, :, order], b.opacity, atol=1e-6)
    np.testing.assert_allclose(a.depth, b.depth, atol=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), near=st.booleans(), has_pusher=st.booleans())
def test_a_scene_of_a_batch_looks_as_it_does_alone(seed, near, has_pusher):
    """Whatever it has in common with others: objects, light, nothing; one that moves shades one that does not."""
    rng = np.random.default_rng(seed)
    scenes, names = 4, ("a", "b", "c")
    fields = {"a": ball(), "b": block(), "c": block((0.05, 0.02, 0.1))}
    poses = rng.uniform(-0.12, 0.12, (2, 3, 3)) + [0, 0, 0.13]  # each object in one of two places
    turns = np.array([[quaternion_exp(rng.normal(size=3)) for _ in names] for _ in range(2)])
    which = (rng.uniform(size=(scenes, 3)) < 0.3).astype(int)
    lights = np.array([[0.5, 0.1, 0.86], [-0.8, 0.3, 0.52]])[(rng.uniform(size=scenes) < 0.2).astype(int)]
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    pusher = np.array([[0.1, -0.1, PUSHER_CENTRE_Z_M], [-0.1, 0.1, PUSHER_CENTRE_Z_M]])[which[:, 0]]
    spots = tuple(
        SpotLamp(np.array([0.1, 0.2, 0.5 + 0.1 * place]), np.array([0.1 * aim, 0, 0]), 30 - 10 * inner, 40 + 20 * outer)
        for place, aim, inner, outer in rng.uniform(size=(scenes, 4)) < 0.3
    )
    quality = PLANNING if rng.random() < 0.5 else EXACT

    def batch(rows: slice) -> SceneBatch:
        places, quaternions = poses[which, np.arange(3)], turns[which, np.arange(3)]
        return SceneBatch(names, places[rows], quaternions[rows], lights[rows], pusher[rows] if has_pusher else None,
                          spots[rows] if near else None)  # fmt: skip

    renderer = SceneRenderer(fields, plain_table())
    cameras = [view((0.3, 0.2, 0.6), (0, 0, 0), 16, 60), view((-0.4, 0.1, 0.3), (0, 0, 0), 16, 60)]
    only = rng.uniform(size=(2, 16, 16)) < 0.9
    together = renderer.render(batch(slice(None)), cameras, quality=quality, outputs=OUTPUTS, only=only)
    for number in range(scenes):
        row = slice(number, number + 1)
        for v, camera in enumerate(cameras):
            alone = renderer.render(batch(row), [camera], quality=quality, outputs=OUTPUTS, only=only[v : v + 1])
            for output in ("rgb", "opacity", "masks", "depth"):
                np.testing.assert_array_equal(getattr(together, output)[row, v], getattr(alone, output)[:, 0])


def test_opacities_masks_and_what_lies_behind_add_up():
    fields, scene = random_scene(2)
    rendered = drawn(fields, None, replace(scene, pusher=None), view())  # the pusher shows, but is no object
    total = rendered.opacity.sum(axis=2)
    assert rendered.opacity.min() >= 0
    assert total.max() <= 1 + 1e-5
    assert np.all(rendered.masks.sum(axis=2) <= 1)
    np.testing.assert_array_equal(rendered.masks, rendered.opacity >= MASK_OPACITY)
    assert rendered.rgb[total < 1e-6].max() < 1e-5
    assert not rendered.depth[total < 1e-6].any()
    assert np.all(rendered.depth[total > 0.01] > 0)


def test_the_nearer_object_hides_the_other():
    fields = {"near": block((0.03, 0.03, 0.03)), "far": ball(0.05)}
    camera = view((1, 0, 0.05), (0, 0, 0.05), 32, 8)
    rendered = drawn(fields, plain_table(), state({"near": (0.1, 0, 0.05), "far": (-0.1, 0, 0.05)}), camera)
    near, far = rendered.masks[0, 0]
    assert near[16, 16]
    assert not far[16, 16]
    assert far.any()
    np.testing.assert_allclose(rendered.depth[0, 0, 16, 16], 1 - 0.13, atol=3e-3)
    # Interpenetrating: what is in front wins sample by sample.
    rendered = drawn(fields, None, state({"near": (0, 0, 0.05), "far": (0, 0, 0.05)}), camera)
    assert rendered.masks[0, 0, 1, 16, 16]
    assert rendered.opacity[0, 0, 0, 16, 16] < 0.05


def test_objects_out_of_sight_leave_the_picture_alone():
    fields, camera, table = {"seen": ball(), "gone": block()}, view((0.5, 0, 0.4)), plain_table()
    seen = {"seen": (0, 0, 0.05)}
    alone = drawn(fields, table, state(seen, (0.3, -0.2, 0.9)), camera)
    for place in ((0.9, 0, 0.4), (0, 5.0, 0.05), (0, 0, -3.0), (0, 0, 40.0), (1e5, 1e5, 0.1)):  # behind, beside, far
        rendered = drawn(fields, table, state(seen | {"gone": place}, (0.3, -0.2, 0.9)), camera)
        np.testing.assert_allclose(rendered.rgb, alone.rgb, atol=1e-5)
        assert not rendered.opacity[0, 0, 1].any()


def test_a_camera_far_away_sees_what_a_long_lens_sees():
    """Distances of many thousand voxels, where float32 is coarse, lead neither out of the grid nor to garbage."""
    for distance in (50.0, 2000.0):
        camera = view((distance, 0, 0), (0, 0, 0), 24, np.rad2deg(2 * np.arctan(0.08 / distance)))
        rendered = drawn({"ball": ball()}, None, state({"ball": (0, 0, 0)}), camera)
        assert np.all(np.isfinite(rendered.rgb))
        assert abs(rendered.masks.sum() / (np.pi * (12 * 0.05 / 0.08) ** 2) - 1) < 0.25


def test_a_light_on_the_horizon_or_below_gives_ambient_only_to_the_table():
    for light in ((1.0, 0, 0), (0.6, 0, -0.8)):
        batch = SceneBatch(("ball",), np.array([[[0, 0, 0.05]]]), np.array([[UPRIGHT]]), np.array([light]), None)
        renderer = SceneRenderer({"ball": ball()}, plain_table())
        rendered = renderer.render(batch, [view((0.3, 0.1, 0.4))], outputs=OUTPUTS)
        np.testing.assert_allclose(rendered.rgb[0, 0][rendered.opacity[0, 0, 0] < 1e-6], 0.125, atol=1e-4)


def test_scenes_and_the_pusher_come_and_go_without_leaving_a_trace():
    """Packs are kept between calls, and dropped when there are many."""
    renderer = SceneRenderer({f"object{i}": ball(0.02 + 0.002 * i) for i in range(12)}, plain_table())
    scenes = [state({name: (0, 0, 0.05)}, pusher=p) for name in renderer.names for p in (None, (0.1, 0, 0.07))]
    first, again = (
        [renderer.render(SceneBatch.of(s), [view(size=16)]).rgb for s in (scenes[0], *rest)]
        for rest in (scenes, scenes[::-1])
    )
    np.testing.assert_array_equal(first[1:], again[:0:-1])


def test_as_many_objects_as_allowed():
    def batch(count):
        positions = np.stack([np.linspace(-0.25, 0.25, count), np.zeros(count), np.full(count, 0.03)], axis=1)[None]
        return SceneBatch(("ball",) * count, positions, np.tile(UPRIGHT, (1, count, 1)), np.array([[0, 0, 1.0]]),
                          np.array([[0, 0.1, PUSHER_CENTRE_Z_M]]))  # fmt: skip

    renderer = SceneRenderer({"ball": ball(0.02)}, plain_table())
    rendered = renderer.render(batch(MOST_OBJECTS), [view((0, -0.6, 0.4), size=128)], outputs=OUTPUTS)
    assert np.all(rendered.masks[0, 0].any(axis=(1, 2)))
    with pytest.raises(InvalidInput):
        batch(MOST_OBJECTS + 1)


def test_batches_that_make_no_sense_are_refused():
    good = {"names": ("ball",), "positions": np.zeros((2, 1, 3)), "quaternions": np.tile(UPRIGHT, (2, 1, 1)),
            "lights": np.array([[0, 0, 1.0]] * 2), "pusher": None}  # fmt: skip
    SceneBatch(**good)
    for name, values in {
        "positions": (np.zeros((2, 3)), np.full((2, 1, 3), np.nan), np.full((2, 1, 3), 1e7)),
        "quaternions": (np.zeros((2, 1, 4)), np.zeros((2, 2, 4))),
        "lights": (np.full((2, 3), 0.1), np.zeros((2, 4))),
        "pusher": (np.zeros((1, 3)),),
    }.items():
        for value in values:
            with pytest.raises(InvalidInput, check=about(name)):
                SceneBatch(**good | {name: value})


@pytest.mark.wrong_arrays
def test_requests_that_make_no_sense_are_refused():
    wide = replace(ball(), hidden=MOST_HIDDEN + 1, networks=np.zeros((1, network_size(MOST_HIDDEN + 1)), np.float32))
    renderer = SceneRenderer({"ball": ball(), "fog": replace(fog(), hidden=7), "wide": wide}, None)
    batch = SceneBatch.of(state({"ball": (0, 0, 0)}))
    with pytest.raises(InvalidInput, check=about("outputs")):
        renderer.render(batch, [view()], outputs={"rays", "normals", "rgb"})
    for cameras in ([view(size=16), view(size=32)], []):
        with pytest.raises(InvalidInput, check=about("cameras")):
            renderer.render(batch, cameras)
    for shape in ((32, 32), (2, 32, 32), (1, 24, 32), (1, 32, 32, 3)):
        with pytest.raises(InvalidInput, check=about("pixels")):
            renderer.render(batch, [view()], only=np.ones(shape, bool))
    with pytest.raises(UnknownName, check=about("mug")):
        renderer.render(SceneBatch.of(state({"mug": (0, 0, 0)})), [view()])
    for names in (("ball", "fog"), ("wide",)):
        with pytest.raises(InvalidInput, check=about("networks")):
            renderer.render(SceneBatch.of(state(dict.fromkeys(names, (0, 0, 0)))), [view()])


def test_what_was_not_asked_for_is_none_and_asking_changes_no_colour():
    fields, scene = random_scene(3)
    renderer, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    everything = renderer.render(batch, [view(size=16)], outputs=OUTPUTS)
    for names in ({"rgb"}, {"depth"}, {"masks"}, {"opacity"}, set()):
        rendered = renderer.render(batch, [view(size=16)], outputs=names)
        np.testing.assert_array_equal(rendered.rgb, everything.rgb)
        for name in ("opacity", "masks", "depth"):
            assert (getattr(rendered, name) is not None) == (name in names)
            if name in names:
                np.testing.assert_array_equal(getattr(rendered, name), getattr(everything, name))


@pytest.mark.parametrize("quality", [EXACT, Quality(samples_per_side=2)])
def test_only_some_pixels_are_those_of_the_whole_image_and_the_rest_is_empty(quality):
    fields, scene = random_scene(2)
    renderer, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    cameras = [CAMERAS["usual"], CAMERAS["close"]]
    whole = renderer.render(batch, cameras, quality=quality, outputs=OUTPUTS)
    for only in (np.random.default_rng(0).random((2, 24, 24)) < 0.3, np.zeros((2, 24, 24), bool)):
        some = renderer.render(batch, cameras, quality=quality, outputs=OUTPUTS, only=only)
        for name in ("rgb", "depth", "opacity", "masks"):
            a, b = getattr(some, name), getattr(whole, name)
            if name in ("opacity", "masks"):
                a, b = np.moveaxis(a, 2, -1), np.moveaxis(b, 2, -1)
            np.testing.assert_array_equal(a[:, only], b[:, only], err_msg=name)
            assert not a[:, ~only].any()


# Boxes on the screen


CORNERS = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1


@given(seed=st.integers(0, 10**6))
def test_a_screen_box_holds_every_pixel_that_the_box_touches(seed):
    """Boxes in front of, around, beside, half behind and behind the camera."""
    rng = np.random.default_rng(seed)
    place, target = rng.normal(size=3), rng.normal(size=3) * 0.1
    camera = Camera.look_at("view", place, target, size=32, fov_y_deg=rng.uniform(20, 120))
    half, pose = rng.uniform(0.01, 0.4, 3), Pose(rng.normal(size=3) * 0.7, quaternion_exp(rng.normal(size=3)))
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


def test_a_screen_box_is_tight_and_never_reaches_beyond_the_screen_whatever_the_numbers():
    """Compiled code would write there."""
    camera = view((0, 0, 1), (0, 0, 0), 64, 53.13)  # half a metre to each side at the distance of 1 m
    left, right, top, bottom = screen_boxes((CORNERS * [0.25, 0.25, 0])[None, None], camera)[0][0, 0]
    np.testing.assert_allclose([left, right, top, bottom], [16, 48, 16, 48], atol=1)
    for value in (np.inf, 1e308, np.nan):
        points = np.full((1, 1, 8, 3), value)
        points[0, 0, 0] = 0
        with np.errstate(all="ignore"):
            left, right, top, bottom = screen_boxes(points, camera)[0][0, 0]
        assert 0 <= left <= right <= 64
        assert 0 <= top <= bottom <= 64


@pytest.mark.parametrize(
    "light",
    [
        *(Light.from_angles(*np.deg2rad(angles)) for angles in ((0, 6), (100, 30), (250, 6), (100, 85))),
        *((0.3, 0.1, 0.3), (0.12, 0.1, 0.12), (-0.2, 0.15, 0.05), (0.0, 0.05, 0.16)),
    ],
)
def test_no_shadow_is_cut_off(light):
    """A scene whose second, transparent object makes every pixel be looked at shows the same shadows."""
    spot = SpotLamp(np.array(light), np.zeros(3), 89, 90) if isinstance(light, tuple) else None
    direction = (0.3, 0.2, 0.9) if spot else light.direction
    fields = {"block": block(), "glass": block((0.7, 0.7, 0.1), voxel=0.1, g=-7.0)}
    camera, tilt = view((0.3, 0.2, 0.6), (0, 0, 0), 48, 70), quaternion_exp(np.array([0.3, 0.5, 0]))
    for height in (0.06, 0.01):
        poses, glass = {"block": ((0.05, 0, height), tilt)}, {"glass": ((0, 0, 0), UPRIGHT)}
        scenes = (state(p, direction, (-0.1, 0.1, PUSHER_CENTRE_Z_M)) for p in (poses, poses | glass))
        one, two = (drawn(fields, plain_table(half_side=2.0), scene, camera, spot=spot).rgb for scene in scenes)
        np.testing.assert_allclose(one, two, atol=1e-5 if spot else 1e-6)


def test_no_batch_makes_the_compiler_work_again():
    """Every way of building a batch leads to arrays of one layout: compiling anew takes half a minute."""
    fields, spot = {"a": ball(), "b": block()}, SpotLamp(np.array([0, 0.1, 0.5]), np.zeros(3), 30, 40)
    for table in (None, plain_table()):
        renderer = SceneRenderer(fields, table)
        for count, scenes in ((0, 1), (1, 2), (2, 1), (2, 2)):
            positions = np.asfortranarray(np.full((scenes, count, 3), 0.1, np.float32))
            quaternions = np.broadcast_to(UPRIGHT, (scenes, count, 4))
            lights = np.broadcast_to([0, 0, 1.0], (scenes, 3))
            for pusher in (None, np.zeros((scenes, 3))):
                for spots in (None, (spot,) * scenes):
                    batch = SceneBatch(("a", "b")[:count], positions, quaternions, lights, pusher, spots)
                    for cameras in ([view(size=16)], [view(size=16).resized(16, 20)] * 2):
                        renderer.render(batch, cameras, quality=PLANNING, outputs=OUTPUTS)
                        renderer.render(batch, cameras)
    assert len(render_batch.signatures) == 2  # distant lights, near lamps
