"""Reference: reference, volume rendering, solids."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

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
from osfcore.render import reference
from osfcore.render.reference import (
    accumulate_along_rays,
    final_transmittance,
    pusher_field,
    render_on_device,
    render_reference,
    render_weights,
    solid_field,
    transmittance,
)
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, OUTPUTS, Quality, SceneBatch
from tests.core.render.scenes import (
    UPRIGHT,
    ball,
    block,
    corners_of,
    fog,
    fog_depth,
    plain_table,
    random_scene,
    state,
    view,
    wooden_table,
)

# Closed forms, for both paths: what physics says of simple scenes, neither of them may change.


ABOVE = (0.0, 0.0, 1.0)


def both(fields, table, scene, camera, quality=EXACT):
    """Everything from one camera, from the reference and from the fast path."""
    slow = render_reference(fields, table, scene, camera, quality=quality, outputs=OUTPUTS)
    fast = SceneRenderer(fields, table).render(SceneBatch.of(scene), [camera], quality=quality, outputs=OUTPUTS)
    return slow, fast


def down(height: float = 1.0, size: int = 17, fov_y_deg: float = 20.0, at=(0.0, 0.0)):
    """A camera that looks straight down."""
    return view((*at, height), (*at, 0), size, fov_y_deg)


@pytest.mark.parametrize("g", [-3.0, -1.0, 1.0])
def test_a_uniform_slab_hides_one_minus_exp_of_its_depth(g):
    """A lens of 1 deg makes the rays parallel; fine steps leave the integral exact."""
    field = replace(fog((0.04, 0.04, 0.02), g=g), ambient=np.float32([1.0, 1.0, 1.0]))
    rows = field.rows.copy()
    rows[1:, 1:4], rows[1:, 4:7] = (0.2, 0.5, 0.9), 0  # sends out its albedo, whatever the light
    fields = {"slab": replace(field, rows=rows)}
    camera = view((0, 0, 2.0), (0, 0, 0), 16, 1.0)
    hidden = 1 - np.exp(-fog_depth(field, g, 0.04))
    for rendered in both(fields, None, state({"slab": (0, 0, 0)}), camera, Quality(step_voxels=0.05)):
        np.testing.assert_allclose(rendered.opacity, hidden, atol=1e-3)
        # In the rim colours are mixed with the black of empty space.
        np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], hidden * np.array([0.2, 0.5, 0.9]), atol=0.02)


def test_two_slabs_hide_as_much_as_their_depths_together():
    near, far = fog((0.05, 0.05, 0.01), g=-2.0), fog((0.05, 0.05, 0.02), g=-1.5)
    scene = state({"near": (0, 0, 0.2), "far": (0, 0, 0.05)}, ABOVE)
    a, b = (fog_depth(f, g, h) for f, g, h in ((near, -2.0, 0.02), (far, -1.5, 0.04)))
    camera = view((0, 0, 2.0), (0, 0, 0), 16, 1.0)
    for rendered in both({"near": near, "far": far}, None, scene, camera, Quality(step_voxels=0.05)):
        np.testing.assert_allclose(rendered.opacity[0, 0, 0], 1 - np.exp(-a), atol=1e-3)
        np.testing.assert_allclose(rendered.opacity[0, 0, 1], np.exp(-a) * (1 - np.exp(-b)), atol=1e-3)


def test_a_slab_lets_the_table_through_and_shades_it():
    """Light comes down through the slab, and what the table sends up passes it again."""
    field = fog((0.05, 0.05, 0.01), g=-2.0)
    rows = field.rows.copy()
    rows[1:, 1:4] = 0  # black
    depth = fog_depth(field, -2.0, 0.02)
    expected = np.exp(-depth) * 0.5 * (0.25 + 0.75 * np.exp(-depth))
    scene = state({"slab": (0, 0, 0.1)}, ABOVE)
    quality = Quality(step_voxels=0.05, shadow_voxels=0.05)
    for rendered in both({"slab": replace(field, rows=rows)}, plain_table(), scene, down(2.0, 16, 1.0), quality):
        np.testing.assert_allclose(rendered.rgb, expected, atol=1e-3)


@pytest.mark.parametrize("light", [(0, 0, 1), (1, 0, 1), (0.2, -0.5, 0.3)])
def test_the_empty_table_is_lambert(light):
    light = np.array(light) / np.linalg.norm(light)
    scene, table = state({}, light), plain_table(0.5)
    for rendered in both({}, table, scene, down(1.0, 16, 40.0)):
        np.testing.assert_allclose(rendered.rgb, 0.5 * (0.25 + 0.75 * light[2]), atol=1e-6)
        np.testing.assert_allclose(rendered.depth, 1.0, atol=1e-6)
        assert rendered.opacity.shape == (1, 1, 0, 16, 16)


def test_beyond_the_table_there_is_background():
    table = plain_table(half_side=0.1)
    for rendered in both({}, table, state({}), down(1.0, 16, 60.0)):
        np.testing.assert_allclose(rendered.rgb[0, 0, 0, 0], [0.1, 0.2, 0.3], atol=1e-6)
        assert rendered.depth[0, 0, 0, 0] == 0
        seen = (rendered.depth > 0).mean()
        assert abs(seen - (0.2 / (2 * np.tan(np.deg2rad(30)))) ** 2) < 0.03
    below = view((0.3, 0, -0.5), (0, 0, 0), 16)
    for rendered in both({}, table, state({}), below):
        np.testing.assert_allclose(rendered.rgb[0, 0], np.broadcast_to([0.1, 0.2, 0.3], (16, 16, 3)), atol=1e-6)
        assert not rendered.depth.any()


@pytest.mark.parametrize("elevation_deg", [90, 45, 20])
def test_the_top_of_a_block_is_lambert(elevation_deg):
    sine = np.sin(np.deg2rad(elevation_deg))
    light = (np.cos(np.deg2rad(elevation_deg)), 0, sine)
    fields = {"block": block((0.06, 0.06, 0.04), albedo=(0.8, 0.4, 0.2))}
    for rendered in both(fields, None, state({"block": (0, 0, 0)}, light), view((0, 0, 1), (0, 0, 0), 16, 3.0)):
        expected = np.array([0.8, 0.4, 0.2]) * (0.25 + 0.75 * sine)
        np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], expected, atol=0.02)
        np.testing.assert_allclose(rendered.opacity, 1, atol=1e-3)
        assert rendered.masks.all()


def test_depth_of_the_top_of_a_block_and_of_a_ball():
    """Distances along the camera's axis: flat surfaces across it have one depth all over."""
    camera = view((0, 0, 1), (0, 0, 0), 33, 8.0)
    for rendered in both({"block": block((0.1, 0.1, 0.04), voxel=0.004)}, None, state({"block": (0, 0, 0)}), camera):
        np.testing.assert_allclose(rendered.depth, 0.96, atol=2e-3)
    for rendered in both({"ball": ball(0.06, voxel=0.004)}, None, state({"ball": (0, 0, 0)}), camera):
        across = camera.ray_directions(np.stack(np.meshgrid(*[np.arange(33) + 0.5] * 2), axis=-1))
        b = across[..., 2] * 1.0
        distance = -b - np.sqrt(np.maximum(b**2 - 1 + 0.06**2, 0))
        inner = b**2 - 1 + 0.04**2 > 0
        np.testing.assert_allclose(rendered.depth[0, 0][inner], (-distance * across[..., 2])[inner], atol=2e-3)
        outside = b**2 - 1 + 0.066**2 < 0
        assert outside.any()
        assert not rendered.depth[0, 0][outside].any()


def test_the_silhouette_of_a_ball_has_its_area():
    camera = view((0, 0, 1), (0, 0, 0), 96, 10.0)
    rendered = both({"ball": ball(0.05, voxel=0.003)}, None, state({"ball": (0, 0, 0)}), camera)
    radius_px = 48 * np.tan(np.arcsin(0.05)) / np.tan(np.deg2rad(5))
    for one in rendered:
        assert abs(one.masks.sum() / (np.pi * radius_px**2) - 1) < 0.03


def test_the_shadow_of_the_pusher_is_as_long_as_it_is_high():
    """At 45 deg a cylinder's shadow is its own height long; it hovers, so the shadow begins beside it."""
    scene = state({}, (1, 0, 1), pusher=(0, 0, PUSHER_CENTRE_Z_M))
    camera = down(2.0, 129, 8.0)
    lit, dark = 0.5 * (0.25 + 0.75 * np.sqrt(0.5)), 0.5 * 0.25
    for rendered in both({"unused": ball()}, plain_table(), scene, camera):
        row = rendered.rgb[0, 0, 64, :, 0]
        x = np.linspace(-1, 1, 129) * 128 / 129 * 2 * np.tan(np.deg2rad(4))
        right = x if abs(camera.T_world_camera.matrix()[0, 0] - 1) < 1e-6 else -x
        shaded = row < (lit + dark) / 2
        table = np.abs(rendered.depth[0, 0, 64] - 2.0) < 1e-3
        length = -right[shaded & table].min()
        # The far end of the shadow is the upper rim: its height plus the radius.
        assert abs(length - (PUSHER_CLEARANCE_M + PUSHER_HEIGHT_M + 0.015)) < 0.004
        np.testing.assert_allclose(row[table & (right < -0.03) & (right > -0.11)], dark, atol=2e-3)
        np.testing.assert_allclose(row[table & (right > 0.03)], lit, atol=1e-5)


def test_the_pusher_has_its_known_colour_and_is_no_object():
    scene = state({}, ABOVE, pusher=(0, 0, PUSHER_CENTRE_Z_M))
    for rendered in both({}, plain_table(), scene, down(1.0, 17, 1.0)):
        np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], PUSHER_ALBEDO, atol=0.02)  # facing the light: albedo x 1
        np.testing.assert_allclose(rendered.depth[0, 0, 8, 8], 1 - 0.122, atol=2e-3)
        assert rendered.masks.shape[2] == 0


def test_a_shadow_removes_the_direct_part_of_the_table_and_no_more():
    table = wooden_table()
    hidden = state({"block": (0, 0, 0.3)}, (1, 0, 1))
    camera = view((-0.3, 0, 0.25), (-0.3, 0, 0), 16, 3.0)  # the shadow falls where the block does not hide it
    sharp = {"block": block((0.1, 0.1, 0.05))}
    for rendered, plain in zip(
        both(sharp, table, hidden, camera), both({}, table, state({}, (1, 0, 1)), camera), strict=True
    ):
        ratio = 0.25 / (0.25 + 0.75 * np.sqrt(0.5))
        np.testing.assert_allclose(rendered.rgb, ratio * plain.rgb, atol=1e-4)


def test_a_lone_object_does_not_shade_itself():
    """Its field already holds that: with all else gone, the light's way through it does not count."""
    solid = block((0.05, 0.05, 0.05), albedo=(0.8, 0.8, 0.8))
    normals = solid.rows.copy()
    normals[1:, 4:7] = (0, 0, 0.75)  # as if every point faced up
    fields = {"block": replace(solid, rows=normals)}
    side = view(
        (1, 0, 0), (0, 0, 0), 16, 3.0
    )  # light from above would have to pass the block to reach its side's inside
    for rendered in both(fields, None, state({"block": (0, 0, 0)}, ABOVE), side):
        np.testing.assert_allclose(rendered.rgb[0, 0, 4:12, 4:12], 0.8, atol=5e-3)


def test_objects_shade_each_other_but_not_themselves():
    """A plate above a block takes its direct light; the plate itself keeps its own."""
    fields = {"plate": block((0.08, 0.08, 0.01)), "block": block((0.05, 0.05, 0.03), albedo=(0.8, 0.8, 0.8))}
    scene = state({"plate": (0, 0, 0.25), "block": (0, 0, 0.03)}, ABOVE)
    normals = fields["block"].rows.copy()
    normals[1:, 4:7] = (0, 0, 0.75)
    fields["block"] = replace(fields["block"], rows=normals)
    side = view((1, 0, 0.03), (0, 0, 0.03), 16, 3.0)
    for rendered in both(fields, None, scene, side):
        np.testing.assert_allclose(rendered.rgb[0, 0, 4:12, 4:12], 0.8 * 0.25, atol=5e-3)
    top = view((0, 0, 1), (0, 0, 0.25), 16, 3.0)
    for rendered in both(fields, None, scene, top):
        np.testing.assert_allclose(
            rendered.rgb[0, 0, 4:12, 4:12], np.broadcast_to([0.3, 0.6, 0.8], (8, 8, 3)), atol=0.02
        )


def test_light_and_view_turn_with_the_object():
    """A scene seen after everything was turned about the vertical is the same scene."""
    fields, scene = random_scene(3, count=2)
    half = np.deg2rad(45)  # a quarter turn, which the table does not notice
    spin = np.array([np.cos(half), 0, 0, np.sin(half)])
    turned = replace(
        scene,
        poses=replace(
            scene.poses,
            position=rotate(spin, scene.poses.position),
            quaternion=quaternion_multiply(spin, scene.poses.quaternion),
        ),
        light=Light(rotate(spin, scene.light.position)),
        pusher=None,
    )
    plain = replace(scene, pusher=None)
    before = both(fields, plain_table(), plain, view((0.5, 0.1, 0.3)))
    after = both(
        fields,
        plain_table(),
        turned,
        view(rotate(spin, np.array([0.5, 0.1, 0.3])), rotate(spin, np.array([0, 0, 0.03]))),
    )
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a.rgb, b.rgb, atol=2e-4)
        np.testing.assert_allclose(a.depth, b.depth, atol=2e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_hardly_matters(dtype):
    fields, scene = random_scene(1)
    camera = view((0.3, 0.1, 0.2), size=16)
    exact = render_reference(fields, wooden_table(), scene, camera, outputs=OUTPUTS)
    other = render_reference(fields, wooden_table(), scene, camera, dtype=dtype, outputs=OUTPUTS)
    np.testing.assert_allclose(other.rgb, exact.rgb, atol=1e-4)


def test_the_device_path_is_the_fast_path():
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


def test_devices_that_are_not_there_are_told():
    with pytest.raises(InvalidInput, match="device is tpu, but it must be auto, cpu or cuda"):
        SceneRenderer({}, None, device="tpu")
    if not torch.cuda.is_available():
        with pytest.raises(InvalidInput, match="PyTorch finds no GPU"):
            SceneRenderer({}, None, device="cuda")
        auto = SceneRenderer({}, plain_table(), device="auto").render(SceneBatch.of(state({})), [view(size=16)])
        assert auto.rgb.any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_renders_the_same():
    fields, scene = random_scene(9)
    batch, cameras = SceneBatch.of(scene), [view((0.4, 0, 0.3), size=32)]
    cpu, gpu = (
        SceneRenderer(fields, wooden_table(), device=d).render(batch, cameras, outputs=OUTPUTS) for d in ("cpu", "cuda")
    )
    np.testing.assert_allclose(gpu.rgb, cpu.rgb, atol=1e-3)
    np.testing.assert_allclose(gpu.depth, cpu.depth, atol=1e-3)


def test_what_was_not_asked_for_is_none_and_bad_requests_are_told():
    fields, scene = random_scene(0, count=1)
    rendered = render_reference(fields, None, scene, view(size=16))
    assert (rendered.opacity, rendered.masks, rendered.depth) == (None, None, None)
    with pytest.raises(UnknownName, match="no field named 'object0'; known: none"):
        render_reference({}, None, scene, view(size=16))
    with pytest.raises(InvalidInput, match="outputs is normals.*depth, masks, opacity, rgb"):
        render_reference(fields, None, scene, view(size=16), outputs={"normals"})


def test_an_object_may_be_called_pusher():
    fields = {"pusher": ball(albedo=(0.9, 0.1, 0.1))}
    scene = state({"pusher": ((0, 0.1, 0.05), UPRIGHT)}, ABOVE, pusher=(0, -0.1, PUSHER_CENTRE_Z_M))
    slow, fast = both(fields, plain_table(), scene, view(size=24))
    np.testing.assert_allclose(slow.rgb, fast.rgb, atol=1e-3)
    assert slow.masks.any()


# Volume rendering


TAUS = st.lists(st.floats(0, 20), min_size=1, max_size=30).map(lambda taus: torch.tensor([taus], dtype=torch.float64))


def test_the_worked_example_is_right():
    failed, tried = doctest.testmod(reference, extraglobs={"torch": torch})
    assert (failed, tried) == (0, 8)


@given(TAUS)
def test_what_is_not_scattered_passes(taus):
    torch.testing.assert_close(render_weights(taus).sum(dim=1) + final_transmittance(taus), torch.ones(1).double())
    assert (transmittance(taus).diff(dim=1) <= 1e-12).all()


@given(st.floats(0.01, 30), st.floats(0.1, 2), st.integers(1, 64))
def test_a_homogeneous_medium_follows_beer_and_lambert_however_finely_it_is_sampled(sigma, length, num_samples):
    taus = torch.full((1, num_samples), sigma * length / num_samples, dtype=torch.float64)
    glow = accumulate_along_rays(render_weights(taus), torch.ones(1, num_samples, 1).double())
    np.testing.assert_allclose(glow.item(), 1 - np.exp(-sigma * length), rtol=1e-9)


# Solids


@pytest.mark.parametrize("hidden", [1, 8, 16])
def test_the_pusher_fills_its_cylinder_and_nothing_else(hidden):
    field = pusher_field(hidden)
    places, g = corners_of(field), field.rows[1:, 0]
    depth = np.minimum(PUSHER_RADIUS_M - np.hypot(*places[:, :2].T), PUSHER_HEIGHT_M / 2 - np.abs(places[:, 2]))
    assert np.all(g[depth > 1e-6] > 0)
    assert np.all(g[depth < -field.voxel] <= FLOOR_G)
    np.testing.assert_allclose(field.rows[1:, 1:4], np.broadcast_to(PUSHER_ALBEDO, (len(g), 3)), atol=1e-6)
    assert field.hidden == hidden
    assert not field.networks.any()


def test_the_pusher_looks_as_wide_and_high_as_it_is():
    camera = view((2, 0, PUSHER_CENTRE_Z_M), (0, 0, PUSHER_CENTRE_Z_M), 128, 5.0)
    scene = state({"p": (0, 0, PUSHER_CENTRE_Z_M)})
    rendered = SceneRenderer({"p": pusher_field(8)}, None).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    per_metre = 64 / np.tan(np.deg2rad(2.5)) / 2
    mask = rendered.masks[0, 0, 0]
    assert abs(mask.any(axis=1).sum() - PUSHER_HEIGHT_M * per_metre) < 3
    assert abs(mask.any(axis=0).sum() - 2 * PUSHER_RADIUS_M * per_metre) < 3


def test_the_shell_of_a_solid_is_closed():
    """No corner of the grid's faces is in the shell, whatever the size."""
    for half in ([0.01, 0.02, 0.03], [0.05, 0.05, 0.0501]):
        field = solid_field(lambda x, h=half: (h - np.abs(x)).min(axis=-1), lambda x: x, np.array(half), (1, 1, 1),
                            voxel=0.005, hidden=4)  # fmt: skip
        for axis in range(3):
            assert not np.moveaxis(field.index, axis, 0)[[0, -1]].any()
        assert np.all(field.extent[0] <= -np.array(half) + field.voxel)
