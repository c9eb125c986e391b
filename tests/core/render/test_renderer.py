"""Renderer: scene renderer, launch, packing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName
from osfcore.fields.kiloosf import MOST_HIDDEN, network_size
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.render.kernels import render_batch
from osfcore.render.reference import render_reference
from osfcore.render.renderer import SceneRenderer, pack, screen_boxes
from osfcore.render.types import EXACT, MASK_OPACITY, MOST_OBJECTS, OUTPUTS, PLANNING, Quality, SceneBatch
from tests.core.render.scenes import (
    HIDDEN,
    UPRIGHT,
    ball,
    block,
    fog,
    plain_table,
    random_field,
    random_scene,
    state,
    view,
    wooden_table,
)

# Scene renderer


CAMERAS = {
    "usual": view((0.45, 0.1, 0.35), size=24, fov_y_deg=40),
    "close": view((0.16, -0.05, 0.12), size=24, fov_y_deg=60),
    "inside": view((0.02, 0.01, 0.06), (0.1, 0.0, 0.0), 24, 90),
    "away": view((0.4, 0, 0.3), (1.0, 0, 0.5), 24, 60),
    "below": view((0.3, 0, -0.2), (0, 0, 0.03), 24, 60),
    "flat": view((0.5, 0, 0.03), (0, 0, 0.03), 24, 40),
}


def batch_of(names, scenes: int, seed: int = 0, pusher: bool = True) -> SceneBatch:
    rng = np.random.default_rng(seed)
    count = len(names)
    positions = np.concatenate(
        [rng.uniform(-0.1, 0.1, (scenes, count, 2)), rng.uniform(0.03, 0.08, (scenes, count, 1))], 2
    )
    lights = np.stack([Light.random(rng).direction for _ in range(scenes)])
    centre = np.concatenate([rng.uniform(-0.1, 0.1, (scenes, 2)), np.full((scenes, 1), PUSHER_CENTRE_Z_M)], axis=1)
    return SceneBatch(
        names, positions, quaternion_exp(rng.normal(size=(scenes, count, 3))), lights, centre if pusher else None
    )


def same(a, b, atol: float = 0.0) -> None:
    for name in ("rgb", "opacity", "depth"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=atol, err_msg=name)
    clear = np.abs(a.opacity - MASK_OPACITY) > 1e-3
    np.testing.assert_array_equal(a.masks[clear], b.masks[clear])


# Seeds are chosen so that one, two and four objects, pushers and lights down to 10 deg all occur.
@pytest.mark.parametrize("seed", [1, 2, 6, 9, 11])
def test_exact_is_the_reference(seed):
    fields, scene = random_scene(seed)
    table = None if seed % 3 == 0 else wooden_table(seed=seed)
    camera = view(np.random.default_rng(seed).normal(size=3) * 0.1 + [0.35, 0, 0.3], size=20, fov_y_deg=50)
    fast = SceneRenderer(fields, table).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    same(fast, render_reference(fields, table, scene, camera, outputs=OUTPUTS), 1e-3)
    assert fast.rgb.dtype == fast.opacity.dtype == fast.depth.dtype == np.float32


@pytest.mark.parametrize("name", CAMERAS)
def test_exact_is_the_reference_from_odd_places(name):
    """A camera close by, within an object, looking away, below the table, level with it."""
    fields, scene = random_scene(9)
    scene = replace(scene, pusher=np.array([0.05, -0.05, PUSHER_CENTRE_Z_M]))
    fast = SceneRenderer(fields, wooden_table()).render(SceneBatch.of(scene), [CAMERAS[name]], outputs=OUTPUTS)
    same(fast, render_reference(fields, wooden_table(), scene, CAMERAS[name], outputs=OUTPUTS), 1e-3)


@pytest.mark.parametrize("light", [(1, 0.2, np.tan(np.deg2rad(10))), (0.3, 0, 1)])
def test_objects_that_sink_into_the_table_shade_it_as_in_the_reference(light):
    """Candidates of a search do; the part below shows and shades nothing."""
    fields = {"a": block(albedo=(0.9, 0.2, 0.2)), "b": ball()}
    tilted = quaternion_exp(np.array([0.5, 0.4, 0.1]))
    scene = state({"a": ((0, 0.05, 0.01), tilted), "b": ((0.02, -0.08, -0.02), UPRIGHT)}, light)
    camera = view((0.3, 0.1, 0.4), size=32, fov_y_deg=60)
    fast = SceneRenderer(fields, plain_table()).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    same(fast, render_reference(fields, plain_table(), scene, camera, outputs=OUTPUTS), 1e-3)


def test_several_rays_a_pixel_are_those_of_the_reference():
    fields, scene = random_scene(9)
    table = plain_table(half_side=0.15)  # whose edge is in view
    quality = Quality(samples_per_side=2)
    fast = SceneRenderer(fields, table).render(
        SceneBatch.of(scene), [CAMERAS["usual"]], quality=quality, outputs=OUTPUTS
    )
    slow = render_reference(fields, table, scene, CAMERAS["usual"], quality=quality, outputs=OUTPUTS)
    np.testing.assert_allclose(fast.rgb, slow.rgb, atol=1e-3)
    np.testing.assert_allclose(fast.opacity, slow.opacity, atol=1e-3)
    np.testing.assert_allclose(fast.depth, slow.depth, atol=5e-3)  # the mean over a pixel's rays, less exactly
    one = SceneRenderer(fields, table).render(SceneBatch.of(scene), [CAMERAS["usual"]])
    assert np.abs(one.rgb - fast.rgb).max() > 0.05


def test_several_rays_a_pixel_are_the_mean_of_a_larger_image():
    fields, scene = random_scene(0)
    renderer, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    camera = view(size=32)
    fine = renderer.render(batch, [camera.resized(64, 64)], outputs=OUTPUTS)
    coarse = renderer.render(batch, [camera], quality=Quality(samples_per_side=2), outputs=OUTPUTS)
    mean = fine.rgb.reshape(1, 1, 32, 2, 32, 2, 3).mean(axis=(3, 5))
    opacity = fine.opacity.reshape(1, 1, -1, 32, 2, 32, 2).mean(axis=(4, 6))
    np.testing.assert_allclose(coarse.opacity, opacity, atol=1e-4)
    # The plain table is drawn with one ray where a pixel lies wholly on it: there its colour is as good as linear.
    on_object = opacity.sum(axis=2) > 1e-3
    np.testing.assert_allclose(coarse.rgb[on_object], mean[on_object], atol=1e-3)
    np.testing.assert_allclose(coarse.rgb, mean, atol=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_planning_stays_above_40_db(seed):
    """Against the exact path, which the tests above tie to the reference; with hard edges, as trained fields have."""
    rng = np.random.default_rng(seed)
    fields = {
        "a": block(rng.uniform(0.02, 0.05, 3), voxel=0.002, albedo=tuple(rng.uniform(0.2, 0.9, 3))),
        "b": ball(rng.uniform(0.02, 0.05), voxel=0.002, albedo=tuple(rng.uniform(0.2, 0.9, 3))),
        "c": block(rng.uniform(0.02, 0.05, 3), voxel=0.002),
    }
    renderer, batch = SceneRenderer(fields, wooden_table()), batch_of(tuple(fields), 1, seed)
    camera = Camera.look_at("0", (0.65, 0, 0.55), (0, 0, 0.04), size=128)
    exact = renderer.render(batch, [camera]).rgb
    error = np.mean((renderer.render(batch, [camera], quality=PLANNING).rgb - exact) ** 2)
    assert -10 * np.log10(error) > 40


def test_planning_of_random_fields_is_near_the_reference():
    fields, scene = random_scene(1)
    camera = view(size=32)
    fast = SceneRenderer(fields, wooden_table()).render(SceneBatch.of(scene), [camera], quality=PLANNING)
    slow = render_reference(fields, wooden_table(), scene, camera)
    assert -10 * np.log10(np.mean((fast.rgb - slow.rgb) ** 2)) > 30  # fog and noise, the worst there is


@pytest.mark.parametrize("quality", [EXACT, PLANNING])
@pytest.mark.parametrize("seed", range(8))
def test_the_order_of_objects_changes_nothing(seed, quality):
    fields, scene = random_scene(seed, count=4)
    order = np.random.default_rng(seed).permutation(4)
    names = tuple(scene.names[i] for i in order)
    shuffled = replace(scene, names=names, poses=scene.poses[order])
    renderer = SceneRenderer(fields, wooden_table())
    a, b = (renderer.render(SceneBatch.of(s), [view()], quality=quality, outputs=OUTPUTS) for s in (scene, shuffled))
    np.testing.assert_allclose(a.rgb, b.rgb, atol=1e-6)
    np.testing.assert_allclose(a.opacity[:, :, order], b.opacity, atol=1e-6)
    np.testing.assert_allclose(a.depth, b.depth, atol=1e-6)


@pytest.mark.parametrize("quality", [EXACT, PLANNING])
@pytest.mark.parametrize("pusher", [False, True])
def test_a_batch_is_its_scenes_and_cameras_one_by_one(quality, pusher):
    fields, _ = random_scene(4, count=3)
    renderer = SceneRenderer(fields, wooden_table())
    batch = batch_of(tuple(fields), 5, pusher=pusher)
    batch = replace(batch, lights=batch.lights[[0, 1, 0, 2, 1]])  # some share their empty table
    cameras = [CAMERAS["usual"], CAMERAS["close"], CAMERAS["away"]]
    whole = renderer.render(batch, cameras, quality=quality, outputs=OUTPUTS)
    assert whole.rgb.shape == (5, 3, 24, 24, 3)
    for b in range(5):
        parts = (a[b : b + 1] for a in (batch.positions, batch.quaternions, batch.lights))
        one = SceneBatch(batch.names, *parts, batch.pusher[b : b + 1] if pusher else None)
        for v, camera in enumerate(cameras):
            single = renderer.render(one, [camera], quality=quality, outputs=OUTPUTS)
            for name in ("rgb", "opacity", "masks", "depth"):
                np.testing.assert_array_equal(getattr(whole, name)[b, v], getattr(single, name)[0, 0], err_msg=name)


def test_the_same_object_may_stand_in_a_scene_twice():
    fields = {"ball": ball()}
    two = SceneBatch(("ball", "ball"), np.array([[[0, -0.1, 0.05], [0, 0.1, 0.05]]]), np.tile(UPRIGHT, (1, 2, 1)),
                     np.array([[0, 0, 1.0]]), None)  # fmt: skip
    rendered = SceneRenderer(fields, plain_table()).render(two, [view((0.5, 0, 0.4))], outputs=OUTPUTS)
    left, right = rendered.opacity[0, 0]
    assert left.sum() > 10
    np.testing.assert_allclose(left, right[:, ::-1], atol=1e-3)
    np.testing.assert_allclose(rendered.rgb[0, 0], rendered.rgb[0, 0, :, ::-1], atol=2e-3)


def test_opacities_masks_and_what_lies_behind_add_up():
    fields, scene = random_scene(2)
    scene = replace(scene, pusher=None)  # which shows, but is no object
    rendered = SceneRenderer(fields, None).render(SceneBatch.of(scene), [view()], outputs=OUTPUTS)
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
    scene = state({"near": (0.1, 0, 0.05), "far": (-0.1, 0, 0.05)})
    camera = view((1, 0, 0.05), (0, 0, 0.05), 32, 8)
    rendered = SceneRenderer(fields, plain_table()).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    near, far = rendered.masks[0, 0]
    assert near[16, 16]
    assert not far[16, 16]
    assert far.any()
    np.testing.assert_allclose(rendered.depth[0, 0, 16, 16], 1 - 0.13, atol=3e-3)
    # Interpenetrating: what is in front wins sample by sample.
    inside = state({"near": (0, 0, 0.05), "far": (0, 0, 0.05)})
    rendered = SceneRenderer(fields, None).render(SceneBatch.of(inside), [camera], outputs=OUTPUTS)
    assert rendered.masks[0, 0, 1, 16, 16]
    assert rendered.opacity[0, 0, 0, 16, 16] < 0.05


def test_objects_out_of_sight_leave_the_picture_alone():
    fields = {"seen": ball(), "gone": block()}
    camera, table = view((0.5, 0, 0.4)), plain_table()
    for place in ((0.9, 0, 0.4), (0, 5.0, 0.05), (0, 0, -3.0), (0, 0, 40.0), (1e5, 1e5, 0.1)):  # behind, beside, far
        scene = state({"seen": (0, 0, 0.05), "gone": place}, (0.3, -0.2, 0.9))
        rendered = SceneRenderer(fields, table).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
        alone = SceneRenderer(fields, table).render(
            SceneBatch.of(state({"seen": (0, 0, 0.05)}, (0.3, -0.2, 0.9))), [camera], outputs=OUTPUTS
        )
        np.testing.assert_allclose(rendered.rgb, alone.rgb, atol=1e-5)
        assert not rendered.opacity[0, 0, 1].any()


def test_a_camera_far_away_sees_what_a_long_lens_sees():
    """Distances of many thousand voxels, where float32 is coarse, lead neither out of the grid nor to garbage."""
    fields = {"ball": ball()}
    for distance in (50.0, 2000.0):
        camera = view((distance, 0, 0), (0, 0, 0), 24, np.rad2deg(2 * np.arctan(0.08 / distance)))
        rendered = SceneRenderer(fields, None).render(
            SceneBatch.of(state({"ball": (0, 0, 0)})), [camera], outputs=OUTPUTS
        )
        assert np.all(np.isfinite(rendered.rgb))
        assert abs(rendered.masks.sum() / (np.pi * (12 * 0.05 / 0.08) ** 2) - 1) < 0.25


def test_a_light_on_the_horizon_or_below_gives_ambient_only_to_the_table():
    fields = {"ball": ball()}
    for light in ((1.0, 0, 0), (0.6, 0, -0.8)):
        batch = SceneBatch(("ball",), np.array([[[0, 0, 0.05]]]), np.array([[UPRIGHT]]), np.array([light]), None)
        rendered = SceneRenderer(fields, plain_table()).render(batch, [view((0.3, 0.1, 0.4))], outputs=OUTPUTS)
        np.testing.assert_allclose(rendered.rgb[0, 0][rendered.opacity[0, 0, 0] < 1e-6], 0.125, atol=1e-4)


def test_an_empty_scene_is_the_table_or_black():
    empty = SceneBatch.of(state({}))
    black = SceneRenderer({}, None).render(empty, [view()], outputs=OUTPUTS)
    assert not black.rgb.any()
    assert not black.depth.any()
    assert black.opacity.shape == black.masks.shape == (1, 1, 0, 32, 32)
    assert SceneRenderer({"ball": ball()}, plain_table()).render(empty, [view()]).rgb.min() > 0.05


def test_scenes_and_the_pusher_come_and_go_without_leaving_a_trace():
    """Packs are kept between calls, and dropped when there are many."""
    fields = {f"object{i}": ball(0.02 + 0.002 * i) for i in range(12)}
    renderer = SceneRenderer(fields, plain_table())
    assert renderer.names == tuple(fields)
    first = None
    for _ in range(2):
        for i in range(12):
            for pusher in (None, (0.1, 0, PUSHER_CENTRE_Z_M)):
                rendered = renderer.render(
                    SceneBatch.of(state({f"object{i}": (0, 0, 0.05)}, pusher=pusher)), [view(size=16)]
                )
                if i == 0 and pusher is None:
                    first = rendered.rgb if first is None else first
                    np.testing.assert_array_equal(rendered.rgb, first)


def test_as_many_objects_as_allowed():
    fields = {"ball": ball(0.02)}

    def batch(count):
        positions = np.stack([np.linspace(-0.25, 0.25, count), np.zeros(count), np.full(count, 0.03)], axis=1)[None]
        return SceneBatch(("ball",) * count, positions, np.tile(UPRIGHT, (1, count, 1)), np.array([[0, 0, 1.0]]),
                          np.array([[0, 0.1, PUSHER_CENTRE_Z_M]]))  # fmt: skip

    rendered = SceneRenderer(fields, plain_table()).render(
        batch(MOST_OBJECTS), [view((0, -0.6, 0.4), size=128)], outputs=OUTPUTS
    )
    assert np.all(rendered.masks[0, 0].any(axis=(1, 2)))
    with pytest.raises(InvalidInput, match=f"number of objects is 24, but it must be at most {MOST_OBJECTS}"):
        batch(MOST_OBJECTS + 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": np.zeros((2, 3))}, "positions of a batch is shape"),
        (
            {"positions": np.full((2, 1, 3), np.nan)},
            "largest of the positions of a batch is nan, but it must be finite",
        ),
        ({"positions": np.full((2, 1, 3), 1e7)}, r"positions of a batch is 1e\+07, .* below 1e\+06 in size"),
        ({"positions": np.full((2, 1, 3), 1e300)}, "positions of a batch"),
        ({"quaternions": np.zeros((2, 1, 4))}, "norms of the quaternions of a batch"),
        ({"quaternions": np.zeros((2, 2, 4))}, "quaternions of a batch is shape"),
        ({"lights": np.full((2, 3), 0.1)}, "norms of the lights"),
        ({"lights": np.zeros((3, 3))}, "batch is shape"),
        ({"pusher": np.zeros((1, 3))}, "pusher of a batch"),
        ({"names": ("ball", "ball")}, "positions of a batch"),
    ],
)
def test_batches_that_make_no_sense_are_told(change, message):
    good = {"names": ("ball",), "positions": np.zeros((2, 1, 3)), "quaternions": np.tile(UPRIGHT, (2, 1, 1)),
            "lights": np.array([[0, 0, 1.0]] * 2), "pusher": None}  # fmt: skip
    SceneBatch(**good)
    with pytest.raises(InvalidInput, match=message):
        SceneBatch(**good | change)


def test_requests_that_make_no_sense_are_told():
    renderer, batch = SceneRenderer({"ball": ball()}, None), SceneBatch.of(state({"ball": (0, 0, 0)}))
    with pytest.raises(InvalidInput, match="outputs is normals, rays, but it must be depth, masks, opacity, rgb"):
        renderer.render(batch, [view()], outputs={"rays", "normals", "rgb"})
    with pytest.raises(InvalidInput, match="image sizes.*one size"):
        renderer.render(batch, [view(size=16), view(size=32)])
    with pytest.raises(InvalidInput, match="image sizes"):
        renderer.render(batch, [])
    with pytest.raises(UnknownName, match="no field named 'mug'; known: ball"):
        renderer.render(SceneBatch.of(state({"mug": (0, 0, 0)})), [view()])
    other = SceneRenderer({"ball": ball(), "fog": replace(fog(), hidden=7)}, None)
    with pytest.raises(InvalidInput, match="widths of the fields' networks"):
        other.render(SceneBatch.of(state({"ball": (0, 0, 0), "fog": (0, 0, 0)})), [view()])


def test_images_need_not_be_square():
    camera = view(size=48).resized(40, 24)
    fields, scene = random_scene(9)
    rendered = SceneRenderer(fields, wooden_table()).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    assert rendered.rgb.shape == (1, 1, 24, 40, 3)
    same(rendered, render_reference(fields, wooden_table(), scene, camera, outputs=OUTPUTS), 1e-3)


def test_what_was_not_asked_for_is_none_and_asking_changes_no_colour():
    fields, scene = random_scene(3)
    renderer, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    everything = renderer.render(batch, [view()], outputs=OUTPUTS)
    for names in ({"rgb"}, {"depth"}, {"masks"}, {"opacity"}, set()):
        rendered = renderer.render(batch, [view()], outputs=names)
        np.testing.assert_array_equal(rendered.rgb, everything.rgb)
        for name in ("opacity", "masks", "depth"):
            assert (getattr(rendered, name) is not None) == (name in names)
            if name in names:
                np.testing.assert_array_equal(getattr(rendered, name), getattr(everything, name))


@pytest.mark.parametrize("quality", [EXACT, PLANNING, Quality(samples_per_side=2)])
def test_only_some_pixels_are_those_of_the_whole_image_and_the_rest_is_empty(quality):
    fields, scene = random_scene(2)
    renderer, batch = SceneRenderer(fields, wooden_table()), batch_of(scene.names, 2)
    cameras = [CAMERAS["usual"], CAMERAS["close"]]
    only = np.random.default_rng(0).random((2, 24, 24)) < 0.3
    whole = renderer.render(batch, cameras, quality=quality, outputs=OUTPUTS)
    some = renderer.render(batch, cameras, quality=quality, outputs=OUTPUTS, only=only)
    for name in ("rgb", "depth", "opacity", "masks"):
        a, b = getattr(some, name), getattr(whole, name)
        if name in ("opacity", "masks"):
            a, b = np.moveaxis(a, 2, -1), np.moveaxis(b, 2, -1)
        assert b[:, ~only].any()
        np.testing.assert_array_equal(a[:, only], b[:, only], err_msg=name)
        assert not a[:, ~only].any()


def test_no_pixels_at_all_and_all_of_them():
    fields, scene = random_scene(2)
    renderer, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    nothing, everything = (renderer.render(batch, [view()], only=np.full((1, 32, 32), some)) for some in (False, True))
    assert not nothing.rgb.any()
    np.testing.assert_array_equal(everything.rgb, renderer.render(batch, [view()]).rgb)


@pytest.mark.parametrize("shape", [(32, 32), (2, 32, 32), (1, 24, 32), (1, 32, 32, 3)])
@pytest.mark.wrong_arrays
def test_pixels_of_another_shape_are_refused(shape):
    fields, scene = random_scene(2)
    with pytest.raises(InvalidInput, match="shape of the pixels to look at"):
        SceneRenderer(fields, None).render(SceneBatch.of(scene), [view()], only=np.ones(shape, bool))


# Launch


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


# Packing


def test_every_field_is_found_where_the_starts_say():
    rng = np.random.default_rng(0)
    fields = [random_field(rng), ball(), random_field(rng), block()]
    packed = pack(fields)
    assert packed.hidden == HIDDEN
    rows = packed.rows.reshape(-1, 8)
    networks = packed.networks.reshape(-1, network_size(HIDDEN))
    for field, starts, shape, scale, extent, ambient in zip(
        fields, packed.starts, packed.shapes, packed.scales, packed.extents, packed.ambient, strict=True
    ):
        corners, first_row, blocks, cells, first_network = starts
        grid, macro, cell = shape.reshape(3, 3)
        np.testing.assert_array_equal(grid, field.index.shape)
        index = packed.index[corners : corners + np.prod(grid)].reshape(grid)
        np.testing.assert_array_equal(rows[first_row + index], field.rows[field.index])
        np.testing.assert_array_equal(packed.density[corners : corners + np.prod(grid)].reshape(grid), field.density)
        np.testing.assert_array_equal(packed.macro[blocks : blocks + np.prod(macro)].reshape(macro), field.macro)
        numbers = packed.cells[cells : cells + np.prod(cell)].reshape(cell)
        np.testing.assert_array_equal(networks[first_network + numbers], field.networks[field.cells])
        np.testing.assert_allclose(scale, [*field.origin, field.voxel], atol=1e-12)
        np.testing.assert_array_equal(ambient, field.ambient)
        # Density is interpolated, so it reaches one voxel beyond the last occupied corner.
        np.testing.assert_allclose(extent[:3], field.extent[0] - field.voxel, atol=1e-6)
        np.testing.assert_allclose(extent[3:], field.extent[1] + field.voxel, atol=1e-6)


def test_fields_of_different_widths_do_not_go_together():
    other = replace(ball(), hidden=4, networks=np.zeros((1, network_size(4)), np.float32))
    with pytest.raises(InvalidInput, match=r"widths of the fields' networks is \[4, 8\]"):
        pack([ball(), other])


def test_networks_wider_than_the_renderer_has_room_for_are_refused():
    width = MOST_HIDDEN + 1
    wide = replace(ball(), hidden=width, networks=np.zeros((1, network_size(width)), np.float32))
    with pytest.raises(InvalidInput, match="width of the fields' networks is 65, but it must be at most 64"):
        pack([wide])
