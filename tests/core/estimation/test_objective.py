from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import huber

from osfcore.errors import UnknownName
from osfcore.estimation.objective import (
    COLOUR_WEIGHT,
    HUBER,
    POSE,
    QUALITY,
    ObjectModels,
    ObjectView,
    RenderedObject,
    SceneParameters,
    crop_to_masks,
    crop_to_object,
    crop_to_silhouette,
    full_circle,
    masked_loss,
    photometric_loss,
    render_poses,
    residuals,
    resting_orientations,
    views_of,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import Observation
from osfcore.objects.asset import Symmetry
from osfcore.render.types import SceneBatch
from tests.support.errors import about
from tests.support.posed_scenes import BOX, own_views, params_of
from tests.support.rendered_scenes import UPRIGHT, ball, block, plain_table, state, view

# Parametrization


SEEDS = st.integers(0, 10**6)


def a_guess(rng, count=3, pusher=None) -> SceneParameters:
    quaternions = quaternion_exp(rng.normal(size=(count, 3)))
    names = tuple(f"object{n}" for n in range(count))
    light = Light.random(rng, min_elevation_deg=MIN_LIGHT_ELEVATION_DEG).direction
    return SceneParameters(names, rng.normal(size=(count, 3)), quaternions, light, pusher)


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


# Object models


def test_objects_without_a_field_are_refused(plain):
    plain.check(("ball", "block"))
    for ask in (lambda: plain.check(("ball", "mug")), lambda: plain.resting("mug")):
        with pytest.raises(UnknownName, check=about("mug")):
            ask()


def test_orientations_that_look_the_same_are_not_turned():
    """About the axis of a body of revolution any angle is none, on the models themselves and on changed ones."""
    bowl = ObjectModels(
        {"ball": ball()}, plain_table(), symmetries={"ball": Symmetry("continuous", axis=(0.0, 0.0, 1.0))}
    )
    upright, about, tilted = (np.eye(4)[0], np.eye(4)[3], quaternion_exp(np.array([0.5, 0.0, 0.0])))
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


def observation(width=96, height=64) -> Observation:
    rng = np.random.default_rng(0)
    cameras = tuple(camera.resized(width, height) for camera in default_cameras()[:2])
    images = rng.uniform(size=(2, height, width, 3))
    chosen = rng.uniform(size=(2, 3, height, width)) < 0.3
    return Observation(cameras, images, ("a", "b", "c"), chosen, np.array([0.1, 0, 0.062]), 0.0)


def test_images_and_masks_are_means_over_pixels_and_never_enlarged():
    seen = observation()
    views = views_of(seen, 48)
    np.testing.assert_allclose(views.images, seen.images.reshape(2, 32, 2, 48, 2, 3).mean(axis=(2, 4)), atol=1e-6)
    np.testing.assert_allclose(views.masks, seen.masks.reshape(2, 3, 32, 2, 48, 2).mean(axis=(3, 5)), atol=1e-6)
    assert views.images.dtype == views.masks.dtype == np.float32
    np.testing.assert_array_equal(views_of(seen, 500).images, seen.images.astype(np.float32))
    np.testing.assert_array_equal(views_of(seen, 500).masks, seen.masks)
    flat = views_of(observation(200, 16), 32)  # no side may become shorter than a camera's shortest
    assert flat.images.shape == (2, 16, 32, 3)
    nobody = views_of(replace(seen, names=(), masks=np.zeros((2, 0, 64, 96), bool)), 48)
    assert nobody.masks.shape == (2, 0, 32, 48)


def test_a_part_is_the_object_and_its_surroundings_by_its_masks(plain, params, views):
    for number, name in enumerate(params.names):
        part = crop_to_masks(views, number)
        height, width = part.mask.shape[1:]
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


def test_a_part_leaves_out_views_that_do_not_show_the_object_and_pixels_that_others_cover(views):
    masks = views.masks.copy()
    masks[0, 0] = 0
    part = crop_to_masks(replace(views, masks=masks), 0)
    assert len(part.cameras) == len(part.rgb) == len(part.area) == 1
    assert part.cameras[0].T_world_camera is views.cameras[1].T_world_camera
    masks = views.masks.copy()
    masks[:, 1] = 1 - masks[:, 0]
    part = crop_to_masks(replace(views, masks=masks), 0)
    np.testing.assert_array_equal(part.valid, 1 - part.mask < 0.3)
    assert crop_to_masks(replace(views, masks=masks[:, :1]), 0).valid.all()


def test_around_are_windows_that_hold_the_object(plain, params, views):
    for number in range(2):
        own = crop_to_object(views, plain, params, number)
        assert own.images.shape[1] == own.images.shape[2] < 64
        batch = params.repeated()
        for window in (own, crop_to_silhouette(views, plain, params, number)):
            np.testing.assert_allclose(residuals(plain, window, batch), 0, atol=ROUNDING)
        shown = plain.together.render(batch, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, number]
        np.testing.assert_allclose(shown.sum(axis=(1, 2)), views.masks[:, number].sum(axis=(1, 2)), rtol=1e-3)
    # Cameras that look elsewhere are left out.
    away = view((0.5, 0, 0.4), (1.0, 0, 0.5), 64)
    both = own_views(plain, params, [CAMERAS[0], away])
    assert len(crop_to_object(both, plain, params, 0).cameras) == 1
    nowhere = own_views(plain, params, [away])
    np.testing.assert_array_equal(crop_to_object(nowhere, plain, params, 0).images, nowhere.images)
    assert crop_to_silhouette(nowhere, plain, params, 0).only is None


def test_near_is_the_silhouette_and_three_pixels_beside_it(plain, params, views):
    own = crop_to_silhouette(views, plain, params, 1)
    batch = params.repeated()
    alone = SceneBatch(("ball",), batch.positions[:, [1]], batch.quaternions[:, [1]], batch.lights, None)
    silhouette = plain.alone.render(alone, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, 0] > 0
    for only, shown in zip(own.only, silhouette, strict=True):
        rows, columns = np.nonzero(shown)
        for row, column in zip(*np.nonzero(only), strict=True):
            assert np.maximum(abs(rows - row), abs(columns - column)).min() <= 3
        assert only[shown].all()
        assert only[max(rows.min() - 3, 0) : rows.max() + 4].any(axis=1).all()


# Photometric loss


@given(seed=st.integers(0, 10**6), spread=st.sampled_from([1e-3, 0.1, 1.0]))
def test_the_loss_is_hubers(seed, spread):
    errors = spread * np.random.default_rng(seed).normal(size=(3, 2, 4, 5, 3))
    np.testing.assert_allclose(photometric_loss(errors), huber(HUBER, errors).mean(axis=(1, 2, 3, 4)), rtol=1e-12)


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
    darker = residuals(plain, replace(views, images=views.images - np.float32(0.25)), params.repeated())
    np.testing.assert_allclose(darker, 0.25, atol=1e-6)  # rendered minus observed


# Masked loss


MASKED_LIGHT = np.array([0.48, 0.36, 0.8])
PLACE = np.array([0.02, -0.03, 0.12])
MASKED_CAMERAS = default_cameras(48)[:2]


@pytest.fixture(scope="module")
def part(models):
    bare = ObjectView(MASKED_CAMERAS, *[np.zeros(0)] * 4, QUALITY)
    look = render_poses(models, BOX, bare, Pose(PLACE[None], np.array([UPRIGHT])), MASKED_LIGHT)
    (mask,) = look.opacity
    return ObjectView(MASKED_CAMERAS, look.rgb[0], mask, np.ones(mask.shape, bool), mask.sum(axis=(1, 2)), QUALITY)


def loss_at(models, part, shifts, **how):
    positions = PLACE + np.asarray(shifts)
    poses = Pose(positions, np.tile(UPRIGHT, (len(positions), 1)))
    return masked_loss(render_poses(models, BOX, part, poses, MASKED_LIGHT), part, **how)


def test_the_loss_grows_with_displacement_from_the_pose_that_made_the_images(models, part):
    for direction in (*np.eye(3), *-np.eye(3)):
        losses = loss_at(models, part, np.outer([0, 0.004, 0.01, 0.02, 0.03, 0.05], direction))
        assert losses[0] == pytest.approx(0, abs=1e-6)
        assert np.all(np.diff(losses) > 0)
    # What is nowhere to be seen loses the silhouette.
    np.testing.assert_allclose(loss_at(models, part, [[0, 0, -5]]), 1, rtol=1e-5)


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
    assert np.all(np.diff(box.heights) >= 0)
    assert box.radius == pytest.approx(np.linalg.norm(HALF), abs=0.01)
    for own in box.quaternions.reshape(6, 4, 4):
        turns = rotation_angle(own, own[0])
        np.testing.assert_allclose(np.sort(turns), np.array([0, 1, 1, 2]) * np.pi / 2, atol=1e-6)
    turned = rotate(full_circle(4), np.array([1.0, 0, 2]))
    np.testing.assert_allclose(turned, [[1, 0, 2], [0, 1, 2], [-1, 0, 2], [0, -1, 2]], atol=1e-12)


def test_the_centre_of_mass_moves_with_the_object_and_its_lowest_corner_is_on_the_table():
    field = block(HALF)
    moved = replace(field, origin=field.origin + np.float32([0.01, -0.02, 0.03]))
    here, there = (resting_orientations(one, yaws=2) for one in (field, moved))
    np.testing.assert_allclose(here.centre, 0, atol=1e-4)
    np.testing.assert_allclose(there.centre, [0.01, -0.02, 0.03], atol=1e-4)
    np.testing.assert_allclose(there.heights, here.heights, atol=1e-4)
    points = field.origin + field.voxel * np.argwhere(field.density > 2)
    for quaternion, height in zip(here.quaternions, here.heights, strict=True):
        z = rotate(quaternion, points - here.centre)[:, 2]
        assert z.min() + height == pytest.approx(0, abs=1e-6)
        lifted = Pose(np.array([0.3, -0.2, height + 0.05]) - rotate(quaternion, here.centre), quaternion)
        assert here.lowest(lifted) == pytest.approx(0.05, abs=1e-6)
