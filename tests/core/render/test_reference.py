"""Closed forms, for both paths: what physics says of simple scenes, neither of them may change."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.errors import InvalidInput, UnknownName
from osfcore.fields.kiloosf import FLOOR_G
from osfcore.geometry.light import Light
from osfcore.geometry.poses import quaternion_multiply, rotate
from osfcore.geometry.workspace import (
    PUSHER_ALBEDO,
    PUSHER_CENTRE_Z_M,
    PUSHER_CLEARANCE_M,
    PUSHER_HEIGHT_M,
    PUSHER_RADIUS_M,
)
from osfcore.render.reference import pusher_field, render_on_device, render_reference, solid_field
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, OUTPUTS, Quality, SceneBatch
from tests.support.rendered_scenes import (
    UPRIGHT,
    ball,
    block,
    both,
    corners_of,
    fog,
    fog_depth,
    plain_table,
    random_scene,
    state,
    view,
    wooden_table,
)

ABOVE = (0.0, 0.0, 1.0)
FINE = Quality(step_voxels=0.05, shadow_voxels=0.05)  # leaves integrals exact


def down(height: float = 1.0, size: int = 17, fov_y_deg: float = 20.0):
    """A camera that looks straight down."""
    return view((0, 0, height), (0, 0, 0), size, fov_y_deg)


def recoloured(field, albedo, normal):
    """The field with one albedo and one dipole everywhere."""
    rows = field.rows.copy()
    rows[1:, 1:4], rows[1:, 4:7] = albedo, normal
    return replace(field, rows=rows)


@pytest.mark.parametrize("g", [-3.0, 1.0])
def test_a_uniform_slab_hides_one_minus_exp_of_its_depth(g):
    field = replace(fog((0.04, 0.04, 0.02), g=g), ambient=np.float32([1.0, 1.0, 1.0]))
    fields = {"slab": recoloured(field, (0.2, 0.5, 0.9), 0)}  # sends out its albedo, whatever the light
    hidden = 1 - np.exp(-fog_depth(field, g, 0.04))
    for rendered in both(fields, None, state({"slab": (0, 0, 0)}), down(2.0, 16, 1.0), FINE):
        np.testing.assert_allclose(rendered.opacity, hidden, atol=1e-3)
        # In the rim colours are mixed with the black of empty space.
        np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], hidden * np.array([0.2, 0.5, 0.9]), atol=0.02)


@pytest.mark.slow
def test_two_slabs_hide_as_much_as_their_depths_together():
    near, far = fog((0.05, 0.05, 0.01), g=-2.0), fog((0.05, 0.05, 0.02), g=-1.5)
    scene = state({"near": (0, 0, 0.2), "far": (0, 0, 0.05)}, ABOVE)
    a, b = fog_depth(near, -2.0, 0.02), fog_depth(far, -1.5, 0.04)
    for rendered in both({"near": near, "far": far}, None, scene, down(2.0, 16, 1.0), FINE):
        np.testing.assert_allclose(rendered.opacity[0, 0, 0], 1 - np.exp(-a), atol=1e-3)
        np.testing.assert_allclose(rendered.opacity[0, 0, 1], np.exp(-a) * (1 - np.exp(-b)), atol=1e-3)


def test_a_slab_lets_the_table_through_and_shades_it():
    """Light comes down through the black slab, and what the table sends up passes it again."""
    field = fog((0.05, 0.05, 0.01), g=-2.0)
    depth = fog_depth(field, -2.0, 0.02)
    expected = np.exp(-depth) * 0.5 * (0.25 + 0.75 * np.exp(-depth))
    scene, fields = state({"slab": (0, 0, 0.1)}, ABOVE), {"slab": recoloured(field, 0, 0)}
    for rendered in both(fields, plain_table(), scene, down(2.0, 16, 1.0), FINE):
        np.testing.assert_allclose(rendered.rgb, expected, atol=1e-3)


@pytest.mark.parametrize("light", [(0, 0, 1), (0.2, -0.5, 0.3)])
def test_the_empty_table_is_lambert(light):
    light = np.array(light) / np.linalg.norm(light)
    for rendered in both({}, plain_table(0.5), state({}, light), down(1.0, 16, 40.0)):
        np.testing.assert_allclose(rendered.rgb, 0.5 * (0.25 + 0.75 * light[2]), atol=1e-6)
        np.testing.assert_allclose(rendered.depth, 1.0, atol=1e-6)
        assert rendered.opacity.shape == rendered.masks.shape == (1, 1, 0, 16, 16)


def test_beyond_the_table_there_is_background():
    table = plain_table(half_side=0.1)
    for rendered in both({}, table, state({}), down(1.0, 16, 60.0)):
        np.testing.assert_allclose(rendered.rgb[0, 0, 0, 0], [0.1, 0.2, 0.3], atol=1e-6)
        assert rendered.depth[0, 0, 0, 0] == 0
        assert abs((rendered.depth > 0).mean() - (0.2 / (2 * np.tan(np.deg2rad(30)))) ** 2) < 0.03
    for rendered in both({}, table, state({}), view((0.3, 0, -0.5), (0, 0, 0), 16)):  # from below
        np.testing.assert_allclose(rendered.rgb[0, 0], np.broadcast_to([0.1, 0.2, 0.3], (16, 16, 3)), atol=1e-6)
        assert not rendered.depth.any()
    for rendered in both({}, None, state({}), down()):
        assert not rendered.rgb.any()
        assert not rendered.depth.any()


@pytest.mark.parametrize("elevation_deg", [90, 20])
def test_the_top_of_a_block_is_lambert_and_flat(elevation_deg):
    sine = np.sin(np.deg2rad(elevation_deg))
    light = (np.cos(np.deg2rad(elevation_deg)), 0, sine)
    fields = {"block": block((0.06, 0.06, 0.04), albedo=(0.8, 0.4, 0.2))}
    for rendered in both(fields, None, state({"block": (0, 0, 0)}, light), down(1.0, 16, 3.0)):
        expected = np.array([0.8, 0.4, 0.2]) * (0.25 + 0.75 * sine)
        np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], expected, atol=0.02)
        np.testing.assert_allclose(rendered.opacity, 1, atol=1e-3)
        np.testing.assert_allclose(rendered.depth, 0.96, atol=2e-3)
        assert rendered.masks.all()


def test_a_ball_has_its_area_and_its_depth():
    camera = down(1.0, 96, 10.0)
    radius_px = 48 * np.tan(np.arcsin(0.05)) / np.tan(np.deg2rad(5))
    across = camera.ray_directions(np.stack(np.meshgrid(*[np.arange(96) + 0.5] * 2), axis=-1))
    b = across[..., 2]
    distance = -b - np.sqrt(np.maximum(b**2 - 1 + 0.05**2, 0))
    inner, outside = b**2 - 1 + 0.033**2 > 0, b**2 - 1 + 0.056**2 < 0
    for rendered in both({"ball": ball(0.05, voxel=0.003)}, None, state({"ball": (0, 0, 0)}), camera):
        assert abs(rendered.masks.sum() / (np.pi * radius_px**2) - 1) < 0.03
        np.testing.assert_allclose(rendered.depth[0, 0][inner], (-distance * b)[inner], atol=2e-3)
        assert not rendered.depth[0, 0][outside].any()


def test_the_shadow_of_the_pusher_is_as_long_as_it_is_high():
    """At 45 deg a cylinder's shadow is its own height long; it hovers, so the shadow begins beside it."""
    scene = state({}, (1, 0, 1), pusher=(0, 0, PUSHER_CENTRE_Z_M))
    camera = down(2.0, 129, 8.0)
    lit, dark = 0.5 * (0.25 + 0.75 * np.sqrt(0.5)), 0.5 * 0.25
    for rendered in both({"unused": ball()}, plain_table(), scene, camera):
        row = rendered.rgb[0, 0, 64, :, 0]
        x = np.linspace(-1, 1, 129) * 128 / 129 * 2 * np.tan(np.deg2rad(4))
        right = x if abs(camera.T_world_camera.matrix()[0, 0] - 1) < 1e-6 else -x
        table = np.abs(rendered.depth[0, 0, 64] - 2.0) < 1e-3
        length = -right[(row < (lit + dark) / 2) & table].min()
        # The far end of the shadow is the upper rim: its height plus the radius.
        assert abs(length - (PUSHER_CLEARANCE_M + PUSHER_HEIGHT_M + 0.015)) < 0.004
        np.testing.assert_allclose(row[table & (right < -0.03) & (right > -0.11)], dark, atol=2e-3)
        np.testing.assert_allclose(row[table & (right > 0.03)], lit, atol=1e-5)
        np.testing.assert_allclose(rendered.depth[0, 0, 64, 64], 2 - 0.122, atol=2e-3)
        assert rendered.masks.shape[2] == 0  # the pusher is no object


def test_objects_shade_each_other_but_not_themselves():
    """A plate above a block takes its direct light; the plate keeps its own, and so does a block without a plate."""
    white = recoloured(block((0.05, 0.05, 0.03)), 0.8, (0, 0, 0.75))  # as if every point faced up
    fields = {"plate": block((0.08, 0.08, 0.01)), "block": white}
    alone, shaded = {"block": (0, 0, 0.03)}, {"block": (0, 0, 0.03), "plate": (0, 0, 0.25)}
    side, top = view((1, 0, 0.03), (0, 0, 0.03), 16, 3.0), view((0, 0, 1), (0, 0, 0.25), 16, 3.0)
    for poses, camera, expected, atol in (
        (alone, side, [0.8] * 3, 5e-3),
        (shaded, side, [0.8 * 0.25] * 3, 5e-3),
        (shaded, top, [0.3, 0.6, 0.8], 0.02),
    ):
        for rendered in both(fields, None, state(poses, ABOVE), camera):
            colours = rendered.rgb[0, 0, 4:12, 4:12]
            np.testing.assert_allclose(colours, np.broadcast_to(expected, (8, 8, 3)), atol=atol)


def test_light_and_view_turn_with_the_object():
    """A scene seen after everything was turned about the vertical is the same scene."""
    fields, scene = random_scene(3, count=2)
    half = np.deg2rad(45)  # a quarter turn, which the table does not notice
    spin, place = np.array([np.cos(half), 0, 0, np.sin(half)]), np.array([0.5, 0.1, 0.3])
    poses = replace(scene.poses, position=rotate(spin, scene.poses.position),
                    quaternion=quaternion_multiply(spin, scene.poses.quaternion))  # fmt: skip
    plain = replace(scene, pusher=None)
    turned = replace(plain, poses=poses, light=Light(rotate(spin, scene.light.position)))
    before = both(fields, plain_table(), plain, view(place, size=24))
    target = rotate(spin, np.array([0, 0, 0.03]))
    after = both(fields, plain_table(), turned, view(rotate(spin, place), target, size=24))
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a.rgb, b.rgb, atol=2e-4)
        np.testing.assert_allclose(a.depth, b.depth, atol=2e-4)


@pytest.mark.slow
def test_precision_and_device_hardly_matter():
    fields, scene = random_scene(9)
    one = SceneBatch.of(scene)
    two = SceneBatch(one.names, *(np.concatenate([a, a + d]) for a, d in ((one.positions, 0.01), (one.quaternions, 0))),
                     np.concatenate([one.lights] * 2), None)  # fmt: skip
    cameras = [view((0.4, 0, 0.3), size=16), view((0, -0.3, 0.4), size=16)]
    ours = render_on_device(fields, wooden_table(), two, cameras, "cpu", EXACT, OUTPUTS)
    fast = SceneRenderer(fields, wooden_table()).render(two, cameras, outputs=OUTPUTS)
    for name in ("rgb", "opacity", "depth"):
        np.testing.assert_allclose(getattr(ours, name), getattr(fast, name), atol=1e-3)
    assert np.array_equal(ours.masks, fast.masks)
    only = np.random.default_rng(0).random((2, 16, 16)) < 0.5
    some = render_on_device(fields, wooden_table(), two, cameras, "cpu", EXACT, OUTPUTS, only)
    np.testing.assert_array_equal(some.rgb[:, only], ours.rgb[:, only])
    assert not some.rgb[:, ~only].any()
    exact = render_reference(fields, wooden_table(), scene, cameras[0])
    single = render_reference(fields, wooden_table(), scene, cameras[0], dtype=torch.float32)
    np.testing.assert_allclose(single.rgb, exact.rgb, atol=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_renders_the_same():
    fields, scene = random_scene(9)
    batch, cameras = SceneBatch.of(scene), [view((0.4, 0, 0.3), size=32)]
    cpu, gpu = (
        SceneRenderer(fields, wooden_table(), device=d).render(batch, cameras, outputs=OUTPUTS) for d in ("cpu", "cuda")
    )
    np.testing.assert_allclose(gpu.rgb, cpu.rgb, atol=1e-3)
    np.testing.assert_allclose(gpu.depth, cpu.depth, atol=1e-3)


def test_what_was_not_asked_for_is_none_and_bad_requests_are_refused():
    fields, scene = random_scene(0, count=1)
    rendered = render_reference(fields, None, scene, view(size=16))
    assert (rendered.opacity, rendered.masks, rendered.depth) == (None, None, None)
    with pytest.raises(UnknownName):
        render_reference({}, None, scene, view(size=16))
    with pytest.raises(InvalidInput):
        render_reference(fields, None, scene, view(size=16), outputs={"normals"})


def test_an_object_may_be_called_pusher():
    fields = {"pusher": ball(albedo=(0.9, 0.1, 0.1))}
    scene = state({"pusher": ((0, 0.1, 0.05), UPRIGHT)}, ABOVE, pusher=(0, -0.1, PUSHER_CENTRE_Z_M))
    slow, fast = both(fields, plain_table(), scene, view(size=24))
    np.testing.assert_allclose(slow.rgb, fast.rgb, atol=1e-3)
    assert slow.masks.any()


# Solids


@pytest.mark.parametrize("hidden", [1, 16])
def test_the_pusher_fills_its_cylinder_and_nothing_else(hidden):
    field = pusher_field(hidden)
    places, g = corners_of(field), field.rows[1:, 0]
    depth = np.minimum(PUSHER_RADIUS_M - np.hypot(*places[:, :2].T), PUSHER_HEIGHT_M / 2 - np.abs(places[:, 2]))
    assert np.all(g[depth > 1e-6] > 0)
    assert np.all(g[depth < -field.voxel] <= FLOOR_G)
    np.testing.assert_allclose(field.rows[1:, 1:4], np.broadcast_to(PUSHER_ALBEDO, (len(g), 3)), atol=1e-6)
    assert field.hidden == hidden
    assert not field.networks.any()


@pytest.mark.parametrize("half", [(0.01, 0.02, 0.03), (0.05, 0.05, 0.0501)])
def test_the_shell_of_a_solid_is_closed(half):
    """No corner of the grid's faces is in the shell, whatever the size."""
    field = solid_field(lambda x: (half - np.abs(x)).min(axis=-1), lambda x: x, np.array(half), (1, 1, 1),
                        voxel=0.005, hidden=4)  # fmt: skip
    for axis in range(3):
        assert not np.moveaxis(field.index, axis, 0)[[0, -1]].any()
    assert np.all(field.extent[0] <= -np.array(half) + field.voxel)
