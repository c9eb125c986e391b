"""Objective."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import huber

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import (
    COLOUR_WEIGHT,
    HUBER,
    LIGHT,
    POSE,
    QUALITY,
    ObjectModels,
    ObjectView,
    ObservedViews,
    RenderedObject,
    SceneParameters,
    crop_camera,
    crop_to_masks,
    crop_to_object,
    crop_to_silhouette,
    fibonacci_sphere,
    loss_of,
    masked_loss,
    photometric_loss,
    render_poses,
    residuals,
    resting_orientations,
    views_of,
    yaw_quaternions,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, orthogonal_basis, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import Observation
from osfcore.objects.asset import Symmetry
from osfcore.render.types import OUTPUTS, SceneBatch
from tests.core.estimation.scenes import BOX, angle, own_views, params_of
from tests.core.render.scenes import UPRIGHT, ball, block, plain_table, state, view

# Parametrization


SEEDS = st.integers(0, 10**6)


def a_guess(rng, count=3, pusher=None) -> SceneParameters:
    quaternions = quaternion_exp(rng.normal(size=(count, 3)))
    names = tuple(f"object{n}" for n in range(count))
    light = Light.random(rng, min_elevation_deg=MIN_LIGHT_ELEVATION_DEG).direction
    return SceneParameters(names, rng.normal(size=(count, 3)), quaternions, light, pusher)


@given(seed=SEEDS, count=st.integers(0, 4))
def test_no_change_is_the_identity(seed, count):
    params = a_guess(np.random.default_rng(seed), count)
    assert params.size == POSE * count + LIGHT
    batch = params.perturbed(np.zeros((2, params.size)))
    assert batch.names == params.names
    for row in range(2):
        np.testing.assert_array_equal(batch.positions[row], params.positions)
        np.testing.assert_allclose(batch.quaternions[row], params.quaternions, atol=1e-15)
        np.testing.assert_allclose(batch.lights[row], params.light, atol=2e-5)  # which may stand at the very lowest


@given(seed=SEEDS, size=st.floats(1e-3, 3))
def test_whatever_the_change_it_leads_to_a_scene(seed, size):
    """Quaternions stay unit and the light stays over the table: a state refuses anything else."""
    rng = np.random.default_rng(seed)
    params = a_guess(rng)
    batch = params.perturbed(size * rng.normal(size=(8, params.size)))
    np.testing.assert_allclose(np.linalg.norm(batch.quaternions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(batch.lights, axis=-1), 1, atol=1e-12)
    for light in batch.lights:
        Light(light)
    params.updated(size * rng.normal(size=params.size)).state()


@pytest.mark.parametrize("elevation_deg", [5.0, 5.5, 20.0])
@pytest.mark.parametrize("push", [-1.0, -0.1, -0.01, 0.01, 0.1, 1.0])
def test_the_light_is_held_above_the_lowest_elevation(elevation_deg, push):
    light = Light.from_angles(0.4, np.deg2rad(elevation_deg)).direction
    params = SceneParameters((), np.zeros((0, 3)), np.zeros((0, 4)), light, None)
    lights = params.perturbed(push * np.array([[1.0, 0], [0, 1], [1, 1], [1, -1]])).lights
    assert np.rad2deg(np.arcsin(lights[:, 2])).min() >= MIN_LIGHT_ELEVATION_DEG


@given(seed=SEEDS)
def test_translations_add_and_rotations_are_about_the_worlds_axes(seed):
    rng = np.random.default_rng(seed)
    params = a_guess(rng, 2)
    change = np.zeros(params.size)
    change[POSE : POSE + 3], change[POSE + 3 : 2 * POSE] = shift, turn = 0.1 * rng.normal(size=(2, 3))
    moved = params.updated(change)
    np.testing.assert_array_equal(moved.positions[0], params.positions[0])
    np.testing.assert_allclose(moved.positions[1], params.positions[1] + shift, atol=1e-12)
    np.testing.assert_allclose(moved.quaternions[0], params.quaternions[0], atol=1e-15)
    wanted = quaternion_multiply(quaternion_exp(turn), params.quaternions[1])
    np.testing.assert_allclose(rotation_angle(moved.quaternions[1], wanted), 0, atol=1e-7)
    np.testing.assert_allclose(
        rotation_angle(moved.quaternions[1], params.quaternions[1]), np.linalg.norm(turn), atol=1e-7
    )


@given(seed=SEEDS)
def test_small_changes_of_the_light_are_angles(seed):
    rng = np.random.default_rng(seed)
    light = Light.random(rng, min_elevation_deg=20).direction
    params = SceneParameters((), np.zeros((0, 3)), np.zeros((0, 4)), light, None)
    change = 0.02 * rng.normal(size=2)
    assert angle(params.updated(change).light, light) == pytest.approx(np.linalg.norm(change), rel=5e-3)


@given(seed=SEEDS)
def test_directions_across_stand_on_each_other(seed):
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    axes = np.stack([direction, *orthogonal_basis(direction)])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_directions_across_the_axes_too():
    for direction in (*np.eye(3), *-np.eye(3)):
        axes = np.stack([direction, *orthogonal_basis(direction)])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_a_guess_is_its_state():
    params = a_guess(np.random.default_rng(0), pusher=np.array([0.1, 0.2, 0.06]))
    again = SceneParameters.of(params.state(), params.pusher)
    for name in ("positions", "quaternions", "light", "pusher"):
        np.testing.assert_allclose(getattr(again, name), getattr(params, name), atol=1e-15)
    assert again.names == params.names
    np.testing.assert_array_equal(again.perturbed(np.zeros((3, again.size))).pusher, np.tile(params.pusher, (3, 1)))
    assert a_guess(np.random.default_rng(0)).perturbed(np.zeros((3, again.size))).pusher is None


# Object models


def test_objects_without_a_field_are_refused(plain):
    plain.check(("ball", "block"))
    plain.check(())
    for ask in (lambda: plain.check(("ball", "mug")), lambda: plain.resting("mug")):
        with pytest.raises(UnknownName, match="no field named 'mug'; known: ball, block"):
            ask()


def test_resting_orientations_are_found_once(plain):
    assert plain.resting("ball") is plain.resting("ball")


def test_one_renderer_shows_the_table_and_the_other_black(plain):
    batch = SceneBatch.of(state({"ball": (0, 0, 0.05)}))
    alone = plain.alone.render(batch, [view()], quality=QUALITY, outputs={"rgb", "opacity"})
    together = plain.together.render(batch, [view()], quality=QUALITY, outputs={"rgb", "opacity"})
    np.testing.assert_array_equal(alone.opacity, together.opacity)
    empty = alone.opacity[0, 0, 0] == 0
    assert empty.any()
    assert not alone.rgb[0, 0][empty].any()
    assert together.rgb[0, 0][empty].min() > 0.02


def test_a_device_that_does_not_exist_is_refused():
    with pytest.raises(InvalidInput):
        ObjectModels({"ball": ball()}, plain_table(), device="abacus")


def test_orientations_that_look_the_same_are_not_turned():
    """About the axis of a body of revolution any angle is none, on the models themselves and on changed ones."""
    bowl = ObjectModels(
        {"ball": ball()}, plain_table(), symmetries={"ball": Symmetry("continuous", axis=(0.0, 0.0, 1.0))}
    )
    upright, about, tilted = np.eye(4)[0], np.eye(4)[3], quaternion_exp(np.array([0.5, 0.0, 0.0]))
    for models in (bowl, bowl.changed(("ball",), lambda field: field, lambda table: table)):
        np.testing.assert_allclose(
            models.turned("ball", upright, np.stack([upright, about, tilted])), [0, 0, 0.5], atol=1e-6
        )
    plain = ObjectModels({"ball": ball()}, plain_table())
    np.testing.assert_allclose(
        plain.turned("ball", upright, np.stack([upright, about, tilted])), [0, np.pi, 0.5], atol=1e-6
    )


# Observed views


ROUNDING = 1e-4  # of a ray's direction, when a camera's corner is moved
CAMERAS = default_cameras(64)[:2]


@pytest.fixture(scope="module")
def params():
    """Above the table, which hides what of a field is below it."""
    return params_of(state({"block": (0.05, 0.03, 0.06), "ball": (-0.07, -0.03, 0.06)}))


@pytest.fixture(scope="module")
def views(plain, params):
    return own_views(plain, params, CAMERAS)


def observation(width=96, height=64, masks=True) -> Observation:
    rng = np.random.default_rng(0)
    cameras = tuple(camera.resized(width, height) for camera in default_cameras()[:2])
    images = rng.uniform(size=(2, height, width, 3))
    chosen = rng.uniform(size=(2, 3, height, width)) < 0.3 if masks else None
    return Observation(cameras, images, ("a", "b", "c"), chosen, np.array([0.1, 0, 0.062]), 0.0)


@given(seed=st.integers(0, 10**6), width=st.integers(16, 200), height=st.integers(16, 200), side=st.integers(16, 200))
def test_a_world_point_projects_to_the_scaled_pixel(seed, width, height, side):
    camera = view().resized(width, height)
    seen = Observation((camera,), np.zeros((1, height, width, 3)), (), None, None, 0.0)
    views = views_of(seen, side)
    small = views.cameras[0]
    assert views.images.shape == (1, small.height, small.width, 3)
    assert max(small.width, small.height) <= max(side, 16)
    point = 0.2 * np.random.default_rng(seed).normal(size=(5, 3))
    scale = small.width / width, small.height / height
    np.testing.assert_allclose(small.project(point), camera.project(point) * scale, rtol=1e-9, atol=1e-9)


def test_images_and_masks_are_means_over_pixels():
    seen = observation()
    views = views_of(seen, 48)
    assert views.images.shape == (2, 32, 48, 3)
    np.testing.assert_allclose(views.images, seen.images.reshape(2, 32, 2, 48, 2, 3).mean(axis=(2, 4)), atol=1e-6)
    np.testing.assert_allclose(views.masks, seen.masks.reshape(2, 3, 32, 2, 48, 2).mean(axis=(3, 5)), atol=1e-6)
    assert views.images.dtype == views.masks.dtype == np.float32


def test_images_are_never_enlarged():
    seen = observation()
    views = views_of(seen, 500)
    np.testing.assert_array_equal(views.images, seen.images.astype(np.float32))
    np.testing.assert_array_equal(views.masks, seen.masks)
    assert [(c.width, c.height) for c in views.cameras] == [(96, 64)] * 2


def test_what_else_was_observed_stays():
    views = views_of(observation(masks=False), 48, samples=2)
    assert views.masks is views.only is None
    np.testing.assert_array_equal(views.pusher, [0.1, 0, 0.062])
    assert views.quality == replace(QUALITY, samples_per_side=2)
    assert views_of(observation(), 48).quality == QUALITY
    flat = views_of(observation(200, 16), 32)  # no side may become shorter than a camera's shortest
    assert flat.images.shape == (2, 16, 32, 3)


def test_no_objects_have_no_masks():
    seen = replace(observation(), names=(), masks=np.zeros((2, 0, 64, 96), bool))
    assert views_of(seen, 48).masks.shape == (2, 0, 32, 48)


@pytest.mark.parametrize("samples", [1, 2])
def test_a_window_shows_the_pixels_of_the_whole(plain, params, samples):
    quality = replace(QUALITY, samples_per_side=samples)
    batch = SceneBatch.of(params.state())
    x, y, width, height = 13, 9, 30, 24
    whole = plain.together.render(batch, CAMERAS, quality=quality, outputs=OUTPUTS)
    windows = [crop_camera(camera, x, y, width, height) for camera in CAMERAS]
    part = plain.together.render(batch, windows, quality=quality, outputs=OUTPUTS)
    for name in ("rgb", "opacity", "depth"):
        cut = getattr(whole, name)
        cut = cut[:, :, y : y + height, x : x + width] if name != "opacity" else cut[..., y : y + height, x : x + width]
        np.testing.assert_allclose(getattr(part, name), cut, atol=ROUNDING)


@given(x=st.integers(-50, 50), y=st.integers(-50, 50))
def test_a_window_moves_pixels_by_its_corner(x, y):
    points = np.array([[0, 0, 0.04], [0.1, -0.2, 0.0]])
    moved = crop_camera(CAMERAS[0], x, y, 20, 30)
    assert (moved.width, moved.height) == (20, 30)
    np.testing.assert_allclose(moved.project(points) + [x, y], CAMERAS[0].project(points), atol=1e-9)


def test_a_part_is_the_object_and_its_surroundings_by_its_masks(plain, params, views):
    for number, name in enumerate(params.names):
        part = crop_to_masks(views, number, margin=4)
        height, width = part.mask.shape[1:]
        assert len({part.rgb.shape[1:3], part.valid.shape[1:], (height, width)}) == 1
        np.testing.assert_allclose(part.mask.sum(axis=(1, 2)), views.masks[:, number].sum(axis=(1, 2)), rtol=1e-3)
        assert max(height, width) < 32 < 64
        own = SceneBatch((name,), params.positions[None, [number]], params.quaternions[None, [number]],
                         params.light[None], None)  # fmt: skip
        look = plain.alone.render(own, part.cameras, quality=part.quality, outputs={"opacity"}).opacity[0, :, 0]
        for v, camera in enumerate(part.cameras):
            x, y = np.round(views.cameras[v].intrinsics[:2, 2] - camera.intrinsics[:2, 2]).astype(int)
            cut = np.s_[v, y : y + height, x : x + width]
            mask = views.masks[:, number][cut]
            np.testing.assert_array_equal(part.mask[v], mask)
            np.testing.assert_array_equal(part.rgb[v], views.images[cut] * mask[..., None])
            other = views.masks[:, 1 - number][cut]
            np.testing.assert_array_equal(part.valid[v], other < 0.3)
            np.testing.assert_allclose(look[v][other == 0], mask[other == 0], atol=ROUNDING)
        np.testing.assert_allclose(part.area, (part.mask * part.valid).sum(axis=(1, 2)), rtol=1e-6)


def test_a_part_leaves_out_views_that_do_not_show_the_object(views):
    masks = views.masks.copy()
    masks[0, 0] = 0
    part = crop_to_masks(replace(views, masks=masks), 0)
    assert len(part.cameras) == len(part.rgb) == len(part.area) == 1
    assert part.cameras[0].T_world_camera is views.cameras[1].T_world_camera


def test_what_others_cover_is_not_valid(views):
    masks = views.masks.copy()
    masks[:, 1] = 1 - masks[:, 0]
    part = crop_to_masks(replace(views, masks=masks), 0)
    np.testing.assert_array_equal(part.valid, 1 - part.mask < 0.3)
    alone = crop_to_masks(replace(views, masks=masks[:, :1]), 0)
    assert alone.valid.all()


@pytest.mark.parametrize("corner", [(0, 0), (63, 0), (0, 63), (63, 63)])
def test_a_part_at_the_border_stays_in_the_image(views, corner):
    masks = np.zeros_like(views.masks)
    masks[:, 0, corner[1], corner[0]] = 1
    part = crop_to_masks(replace(views, masks=masks), 0)
    assert part.mask.shape == (2, 16, 16)
    assert part.area.tolist() == [1, 1]


def test_around_are_windows_that_hold_the_object(plain, params, views):
    for number in range(2):
        own = crop_to_object(views, plain, params, number)
        assert own.masks is own.only is None
        assert own.images.shape[1] == own.images.shape[2] < 64
        batch = params.perturbed(np.zeros((1, params.size)))
        np.testing.assert_allclose(residuals(plain, own, batch), 0, atol=ROUNDING)
        shown = plain.together.render(batch, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, number]
        np.testing.assert_allclose(shown.sum(axis=(1, 2)), views.masks[:, number].sum(axis=(1, 2)), rtol=1e-3)


def test_around_keeps_which_pixels_count(plain, params, views):
    bright = views.images.sum(axis=-1) > 0.2
    own = crop_to_object(replace(views, only=bright), plain, params, 0)
    np.testing.assert_array_equal(own.only, own.images.sum(axis=-1) > 0.2)


def test_around_leaves_out_cameras_that_look_elsewhere(plain, params):
    away = view((0.5, 0, 0.4), (1.0, 0, 0.5), 64)
    both = own_views(plain, params, [CAMERAS[0], away])
    assert len(crop_to_object(both, plain, params, 0).cameras) == 1
    nowhere = own_views(plain, params, [away])
    own = crop_to_object(nowhere, plain, params, 0)
    np.testing.assert_array_equal(own.images, nowhere.images)
    assert own.masks is None
    assert crop_to_silhouette(nowhere, plain, params, 0).only is None


def test_near_is_the_whole_image_inside_and_black_outside(plain, params, views):
    for number in range(2):
        own, wide = crop_to_silhouette(views, plain, params, number), crop_to_object(views, plain, params, number)
        np.testing.assert_array_equal(own.images, wide.images * own.only[..., None])
        batch = SceneBatch.of(params.state())
        some = plain.together.render(batch, own.cameras, quality=own.quality, only=own.only).rgb[0]
        everything = plain.together.render(batch, own.cameras, quality=own.quality).rgb[0]
        np.testing.assert_array_equal(some[own.only], everything[own.only])
        assert not some[~own.only].any()
        assert 0.1 < own.only.mean() < 0.9
        np.testing.assert_allclose(residuals(plain, own, batch), 0, atol=ROUNDING)


def test_near_is_the_silhouette_and_three_pixels_beside_it(plain, params, views):
    own = crop_to_silhouette(views, plain, params, 1)
    batch = params.perturbed(np.zeros((1, params.size)))
    alone = SceneBatch(("ball",), batch.positions[:, [1]], batch.quaternions[:, [1]], batch.lights, None)
    silhouette = plain.alone.render(alone, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, 0] > 0
    for only, shown in zip(own.only, silhouette, strict=True):
        rows, columns = np.nonzero(shown)
        for row, column in zip(*np.nonzero(only), strict=True):
            assert np.maximum(abs(rows - row), abs(columns - column)).min() <= 3
        assert only[shown].all()
        assert only[max(rows.min() - 3, 0) : rows.max() + 4].any(axis=1).all()


def test_the_light_does_not_choose_the_pixels(plain, params, views):
    lit = replace(params, light=Light.from_angles(1.0, 0.3).direction)
    np.testing.assert_array_equal(
        crop_to_silhouette(views, plain, params, 0).only, crop_to_silhouette(views, plain, lit, 0).only
    )


def test_views_are_made_of_what_is_given(views):
    assert ObservedViews(views.cameras, views.images, None, None).quality == QUALITY


# Photometric loss


@given(seed=st.integers(0, 10**6), spread=st.sampled_from([1e-3, 0.1, 1.0]))
def test_the_loss_is_hubers(seed, spread):
    errors = spread * np.random.default_rng(seed).normal(size=(3, 2, 4, 5, 3))
    np.testing.assert_allclose(photometric_loss(errors), huber(HUBER, errors).mean(axis=(1, 2, 3, 4)), rtol=1e-12)


def test_small_errors_count_squared_and_large_ones_linearly():
    np.testing.assert_allclose(
        photometric_loss(np.array([[0.02], [-0.02], [1.0]])), [0.0002, 0.0002, 0.095], rtol=1e-12
    )


def test_a_scene_explains_its_own_images_and_no_others(plain):
    params = params_of(state({"block": (0.04, 0, 0.05), "ball": (-0.06, 0, 0.05)}))
    views = own_views(plain, params, [view(), view((0, 0.5, 0.4))])
    changes = np.zeros((3, params.size))
    changes[1, 0], changes[2, 0] = 0.005, 0.01
    errors = residuals(plain, views, params.perturbed(changes))
    assert errors.shape == (3, 2, 32, 32, 3)
    assert errors.dtype == np.float32
    assert not errors[0].any()
    losses = photometric_loss(errors)
    assert 0 == losses[0] < losses[1] < losses[2]


def test_residuals_are_rendered_minus_observed(plain):
    params = params_of(state({"ball": (0, 0, 0.05)}))
    views = own_views(plain, params, [view()])
    darker = ObservedViews(views.cameras, views.images - np.float32(0.25), None, None, views.quality)
    errors = residuals(plain, darker, params.perturbed(np.zeros((1, params.size))))
    np.testing.assert_allclose(errors, 0.25, atol=1e-6)


def test_the_loss_of_one_scene_is_that_of_a_batch_of_one(models, truth):
    params = params_of(truth)
    seen = own_views(models, params, default_cameras(32)[:1])
    moved = params.updated(np.array([0.01] * 12 + [0.0, 0.0]))
    assert loss_of(models, seen, params) == 0
    batch = moved.perturbed(np.zeros((1, moved.size)))
    assert loss_of(models, seen, moved) == photometric_loss(residuals(models, seen, batch))[0] > 0


# Masked loss


MASKED_LIGHT = np.array([0.48, 0.36, 0.8])
PLACE = np.array([0.02, -0.03, 0.12])
MASKED_CAMERAS = default_cameras(48)[:2]


def part_that_shows(look, number=0) -> ObjectView:
    mask = look.opacity[number]
    area = mask.sum(axis=(1, 2))
    return ObjectView(MASKED_CAMERAS, look.rgb[number], mask, np.ones(mask.shape, bool), area, QUALITY)


@pytest.fixture(scope="module")
def part(models):
    bare = ObjectView(MASKED_CAMERAS, *[np.zeros(0)] * 4, QUALITY)
    return part_that_shows(render_poses(models, BOX, bare, PLACE[None], np.array([UPRIGHT]), MASKED_LIGHT))


def loss_at(models, part, shifts, light=MASKED_LIGHT, **how):
    positions = PLACE + np.asarray(shifts)
    look = render_poses(models, BOX, part, positions, np.tile(UPRIGHT, (len(positions), 1)), light)
    return masked_loss(look, part, **how)


def test_the_pose_that_made_the_images_has_no_loss(models, part):
    np.testing.assert_allclose(loss_at(models, part, [[0, 0, 0]]), 0, atol=1e-6)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_loss_grows_with_displacement(models, part, axis, sign):
    shifts = np.zeros((6, 3))
    shifts[:, axis] = sign * np.array([0, 0.004, 0.01, 0.02, 0.03, 0.05])
    losses = loss_at(models, part, shifts)
    assert np.all(np.diff(losses) > 0)


def test_what_is_nowhere_to_be_seen_loses_the_silhouette(models, part):
    np.testing.assert_allclose(loss_at(models, part, [[0, 0, -5]]), 1, rtol=1e-5)


def test_what_another_object_hides_does_not_count(models, part):
    rgb, mask, valid = part.rgb.copy(), part.mask.copy(), part.valid.copy()
    rgb[:, :24], mask[:, :24], valid[:, :24] = 0, 0, False
    hidden = replace(part, rgb=rgb, mask=mask, valid=valid, area=np.maximum(mask.sum(axis=(1, 2)), 1))
    np.testing.assert_allclose(loss_at(models, hidden, [[0, 0, 0]]), 0, atol=1e-6)
    assert loss_at(models, replace(hidden, valid=part.valid), [[0, 0, 0]])[0] > 0.1


def test_any_brightness_is_up_to_a_factor(models, part):
    for gain in (0.4, 1.0, 2.5):
        brighter = replace(part, rgb=part.rgb * np.float32(gain))
        np.testing.assert_allclose(loss_at(models, brighter, [[0, 0, 0]], any_brightness=True), 0, atol=1e-5)
    assert loss_at(models, replace(part, rgb=part.rgb * np.float32(0.4)), [[0, 0, 0]])[0] > 0.1
    dark = replace(part, rgb=np.zeros_like(part.rgb))  # no factor below the least: black is not a dim box
    assert loss_at(models, dark, [[0, 0, 0]], any_brightness=True)[0] > 0.01


def test_the_loss_by_hand():
    """Two views of 1 x 2 pixels; the second view's mask is twice as large and counts twice."""
    mask = np.float32([[[1, 0]], [[1, 1]]])
    rgb = np.full((2, 1, 2, 3), 0.5, np.float32)
    part = ObjectView((), rgb, mask, np.ones(mask.shape, bool), mask.sum(axis=(1, 2)), QUALITY)
    shown = np.full((1, 2, 1, 2, 3), 0.5, np.float32)
    shown[0, 0, 0, 0] = 0.4, 0.5, 0.6  # 0.2 / 3 away
    shown[0, 1, 0, 1] = 2.0  # cut off at 0.3
    opacity = np.float32([[[[1, 0.25]], [[1, 1]]]])
    first = 0.25 + COLOUR_WEIGHT * 0.2 / 3
    second = COLOUR_WEIGHT * 0.3 / 2
    np.testing.assert_allclose(masked_loss(RenderedObject(shown, opacity), part), (first + 2 * second) / 3, rtol=1e-5)


def test_a_batch_is_its_poses_one_by_one(models, part):
    shifts = np.random.default_rng(0).normal(size=(4, 3)) * 0.02
    together = loss_at(models, part, shifts, any_brightness=True)
    apart = [loss_at(models, part, [shift], any_brightness=True)[0] for shift in shifts]
    np.testing.assert_allclose(together, apart, rtol=1e-6)


# Resting orientations


HALF = np.array([0.06, 0.045, 0.09])


@pytest.fixture(scope="module")
def box():
    return resting_orientations(block(HALF, voxel=0.005), yaws=4)


def down(resting):
    """The direction in the object's frame that points down, of each orientation."""
    conjugate = resting.quaternions * [1, -1, -1, -1]
    return rotate(conjugate, np.array([0, 0, -1.0]))


def test_a_box_lies_on_its_six_faces(box):
    assert len(box.quaternions) == len(box.heights) == 6 * 4
    faces = down(box)
    axes = np.abs(faces).argmax(axis=1)
    assert np.all(np.abs(faces).max(axis=1) > np.cos(np.deg2rad(5)))
    sides = {(int(axis), bool(face[axis] > 0)) for axis, face in zip(axes, faces, strict=True)}
    assert len(sides) == 6
    # Corners a voxel's part inside the surface count as its solid, and directions are a few degrees apart.
    np.testing.assert_allclose(box.heights, HALF[axes], atol=0.006)


def test_the_flattest_comes_first(box):
    assert np.all(np.diff(box.heights) >= 0)
    assert np.abs(down(box)[0]).argmax() == HALF.argmin()


def test_the_centre_and_the_radius_are_those_of_the_solid(box):
    np.testing.assert_allclose(box.centre, 0, atol=1e-4)
    assert box.radius == pytest.approx(np.linalg.norm(HALF), abs=0.01)


def test_every_way_is_turned_about_the_vertical(box):
    np.testing.assert_allclose(np.linalg.norm(box.quaternions, axis=1), 1, atol=1e-12)
    for own in box.quaternions.reshape(6, 4, 4):
        turns = rotation_angle(own, own[0])
        np.testing.assert_allclose(np.sort(turns), np.array([0, 1, 1, 2]) * np.pi / 2, atol=1e-6)


def test_the_centre_of_mass_is_found_off_the_origin():
    field = block(HALF)
    moved = replace(field, origin=field.origin + np.float32([0.01, -0.02, 0.03]))
    here, there = resting_orientations(field, yaws=1), resting_orientations(moved, yaws=1)
    np.testing.assert_allclose(there.centre - here.centre, [0.01, -0.02, 0.03], atol=1e-4)
    np.testing.assert_allclose(there.heights, here.heights, atol=1e-4)


def test_a_sphere_lies_in_every_way():
    resting = resting_orientations(ball(0.05), yaws=1)
    assert len(resting.heights) > 40
    np.testing.assert_allclose(resting.heights, 0.05, atol=0.006)
    assert np.abs(down(resting).mean(axis=0)).max() < 0.1


def test_the_lowest_solid_corner_is_on_the_table():
    field = block(HALF)
    points = field.origin + field.voxel * np.argwhere(field.density > 2)
    resting = resting_orientations(field, yaws=2)
    for quaternion, height in zip(resting.quaternions, resting.heights, strict=True):
        z = rotate(quaternion, points - resting.centre)[:, 2]
        assert z.min() + height == pytest.approx(0, abs=1e-6)
        lifted = Pose(np.array([0.3, -0.2, height + 0.05]) - rotate(quaternion, resting.centre), quaternion)
        assert resting.lowest(lifted) == pytest.approx(0.05, abs=1e-6)


def test_real_objects_lie_in_a_few_ways(models):
    for name in models.together.names:
        resting = models.resting(name)
        assert 5 <= len(resting.heights) / 24 <= 12
        assert np.all(resting.heights <= resting.radius)


def test_the_sphere_is_even():
    directions = fibonacci_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=5e-3)
    np.testing.assert_allclose(directions.T @ directions / 500, np.eye(3) / 3, atol=5e-3)
    cosines = directions @ directions.T - 2 * np.eye(500)
    nearest = np.rad2deg(np.arccos(cosines.max(axis=1)))
    assert nearest.min() > 5
    assert nearest.max() < 12


def test_turns_about_the_vertical():
    turned = rotate(yaw_quaternions(np.array([0, np.pi / 2, np.pi])), np.array([1.0, 0, 2]))
    np.testing.assert_allclose(turned, [[1, 0, 2], [0, 1, 2], [-1, 0, 2]], atol=1e-12)
