"""Factors: factors, sensor."""

from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.control.world import World
from osfcore.errors import UnknownName
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.experiments.factors import (
    EPISODE_FACTORS,
    FACTORS,
    FIRST_FRAME_FACTORS,
    CameraError,
    Factor,
    VariedWorld,
    factor_named,
    received,
    resized_masks,
)
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import rotation_angle
from osfcore.metrics.success import RearrangementTask
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

# Factors


CAN = SceneRequest(names=("005_tomato_soup_can",))
CAMERAS, GOAL = default_cameras(48), goal_camera(48)
PUSH = np.array([0.3, -0.2, 0.0])


@contextmanager
def varied(library, factor: str | Factor, *, seed: int = 0, cameras=CAMERAS):
    factor = factor_named(factor) if isinstance(factor, str) else factor
    world = VariedWorld(library, factor, np.random.default_rng(seed), cameras=cameras, request=CAN)
    try:
        yield world
    finally:
        world.close()


@pytest.fixture(scope="module")
def usual(library):
    """A scene as a world shows it that differs in nothing."""
    world = Tabletop(library, cameras=CAMERAS, request=CAN)
    world.arrange(1)
    yield world
    world.close()


def test_factors_are_those_that_were_asked_for():
    light = ("light_low", "intensity_0.5", "intensity_1.5", "ambient_0.1", "ambient_0.5", "light_coloured")
    table = ("table_colour", "table_wood")
    sensor = ("camera_shifted", "noise_2", "jpeg_80", "srgb_8bit", "srgb_8bit_decoded")
    masks = ("masks_eroded_2", "masks_dilated_2")
    contacts = ("friction_0.5", "friction_2", "mass_0.5", "mass_2")
    first = ("exposure_0.7", "exposure_1.4", "ambient_0.6", "table_dark", "mild_together")
    assert (*light, *table, *sensor, *masks, *contacts, "objects_unseen") == EPISODE_FACTORS
    assert tuple(FACTORS) == (*EPISODE_FACTORS, *first)
    assert set(FIRST_FRAME_FACTORS) < set(FACTORS)
    assert factor_named("jpeg_80") is FACTORS["jpeg_80"]
    with pytest.raises(UnknownName, match="jpeg_80"):
        factor_named("jpeg_50")


@pytest.mark.parametrize("name", FACTORS)
def test_every_factor_makes_a_world(library, name):
    def drive(world: World):
        first = world.reset(1)
        world.act(PUSH)
        return first, world.observe(masks=True)

    with varied(library, name) as world:
        first, second = drive(world)
        again = world.truth()
    for observation in (first, second):
        assert observation.images.dtype == np.float32
        assert observation.images.min() >= 0
        assert observation.images.max() <= 1
        assert observation.cameras == CAMERAS
    assert first.masks is None
    assert second.masks is not None
    assert second.masks.any()
    assert second.time_s == pytest.approx(0.2)
    with varied(library, name) as world:
        np.testing.assert_array_equal(drive(world)[1].images, second.images)
        np.testing.assert_array_equal(world.truth().poses.position, again.poses.position)


def test_no_factor_is_the_usual_world_to_the_last_bit(library, usual):
    with varied(library, Factor()) as world:
        seen = world.reset(1)
        np.testing.assert_array_equal(seen.images, usual.observe().images)
        goal = world.goal_image(usual.truth(), GOAL)
    twin = Tabletop(library, cameras=CAMERAS, request=CAN)
    twin.restore(usual.truth())
    np.testing.assert_array_equal(goal.image, twin.render((GOAL,), with_pusher=False).images[0])
    twin.close()


@pytest.mark.parametrize("is_relit", [False, True])
def test_low_light_keeps_its_azimuth(usual, is_relit):
    lights = Light.from_angles(2.0, np.deg2rad(60.0)), Light.from_angles(-1.0 if is_relit else 2.0, np.deg2rad(60.0))
    start, goal = (replace(usual.truth(), light=light) for light in lights)
    factor = factor_named("light_low")
    for seed in range(20):
        task = factor.task(RearrangementTask(0, start, goal, ()), np.random.default_rng(seed))
        for state, light in ((task.start, lights[0]), (task.goal, lights[1])):
            assert 5 <= np.rad2deg(np.arcsin(state.light.direction[2])) <= 10
            azimuths = [np.arctan2(*one.direction[1::-1]) for one in (state.light, light)]
            assert azimuths[0] == pytest.approx(azimuths[1])
        assert (task.start.light.angle_to(task.goal.light) > 0.01) == is_relit


def test_intensity_scales_the_goal_as_well(library, usual):
    expected = usual.render((GOAL,), with_pusher=False).images[0]
    with varied(library, "intensity_1.5") as world:
        goal = world.goal_image(usual.truth(), GOAL)
        assert goal.camera is GOAL
    table = np.argwhere(np.all(np.abs(expected - expected[-1, -1]) < 1e-6, axis=-1))
    assert len(table) > 500
    rows, columns = table.T
    np.testing.assert_allclose(goal.image[rows, columns], np.minimum(1.5 * expected[rows, columns], 1), atol=1e-5)


def test_shares_of_ambient_light_change_shadows_more_than_lit_table(library, usual):
    ratios = []
    for name in ("ambient_0.1", "ambient_0.5"):
        with varied(library, name) as world:
            world.restore(usual.truth())
            (picture,) = usual.pictures(CAMERAS[:1])
            table = (picture.coverage.sum(axis=0) == 0) & (picture.depth < 1)
            seen = world.observe().images[0][table][:, 0]
        ratios.append(seen.min() / np.median(seen))
    sine = usual.truth().light.direction[2]
    for ratio, ambient in zip(ratios, (0.1, 0.5), strict=True):
        assert ratio == pytest.approx(ambient / (ambient + (1 - ambient) * sine), rel=0.02)


def test_wood_is_another_one_in_each_world_and_stays_in_it(library, usual):
    corners = []
    for seed in range(2):
        with varied(library, "table_wood", seed=seed) as world:
            world.restore(usual.truth())
            first, second = world.observe().images, world.observe().images
            np.testing.assert_array_equal(first, second)
            corners.append(first[0, -12:, :12])
    assert min(corner.std(axis=(0, 1)).min() for corner in corners) > 0.01
    assert np.abs(corners[0] - corners[1]).mean() > 0.01


def test_shifted_cameras_stay_where_they_are_and_tell_their_calibration(library, usual):
    cameras = default_cameras(128)
    with varied(library, "camera_shifted", cameras=cameras) as world:
        world.restore(usual.truth())
        seen, ideal = world.observe(masks=True), world.render(cameras, masks=True)
        goal = world.goal_image(usual.truth(), goal_camera(128)).image
        assert np.abs(goal - world.render((goal_camera(128),), with_pusher=False).images[0]).max() > 0.05
        world.restore(usual.truth())
        np.testing.assert_array_equal(world.observe().images, seen.images)
    assert seen.cameras == cameras
    moved = []
    for mine, true in zip(seen.masks[:, 0], ideal.masks[:, 0], strict=True):
        moved.append(np.linalg.norm(np.argwhere(mine).mean(axis=0) - np.argwhere(true).mean(axis=0)))
    focal = cameras[0].intrinsics[0, 0]
    most = focal * (np.tan(np.deg2rad(0.3)) * 1.3 + 0.003 / 0.6)  # off the middle, and for near objects
    assert 0.2 < max(moved) < most
    assert np.std(moved) > 0.02


def test_noise_differs_from_image_to_image(library, usual):
    with varied(library, "noise_2") as world:
        world.restore(usual.truth())
        first, second = world.observe().images, world.observe().images
        goal = world.goal_image(usual.truth(), GOAL).image
        clean = world.render((GOAL,), with_pusher=False).images[0]
    assert np.abs(first - second).mean() > 0.01
    assert np.std(goal - clean) == pytest.approx(0.02, rel=0.1)
    np.testing.assert_array_equal(clean, usual.render((GOAL,), with_pusher=False).images[0])


@pytest.mark.parametrize(("name", "change"), [("jpeg_80", "jpeg"), ("srgb_8bit", "srgb_8bit")])
def test_images_and_goals_are_changed_alike(library, usual, name, change):
    with varied(library, name) as world:
        world.restore(usual.truth())
        seen = world.observe().images
        goal = world.goal_image(usual.truth(), GOAL).image
    for mine, clean in zip(seen, usual.observe().images, strict=True):
        np.testing.assert_array_equal(mine, received(clean, change, np.random.default_rng()))
    clean = usual.render((GOAL,), with_pusher=False).images[0]
    np.testing.assert_array_equal(goal, received(clean, change, np.random.default_rng()))


def test_masks_reach_too_far_or_not_far_enough(library, usual):
    sound = usual.observe(masks=True)
    areas = []
    for name in ("masks_eroded_2", "masks_dilated_2"):
        with varied(library, name) as world:
            world.restore(usual.truth())
            seen = world.observe(masks=True)
        np.testing.assert_array_equal(seen.images, sound.images)
        areas.append(seen.masks)
    assert not np.any(areas[0] & ~sound.masks)
    assert not np.any(sound.masks & ~areas[1])
    assert areas[0].sum() < sound.masks.sum() < areas[1].sum()


@pytest.mark.parametrize("name", ["friction_0.5", "mass_2"])
def test_contacts_change_nothing_that_is_seen_before_a_push(library, usual, name):
    with varied(library, name) as world:
        world.restore(usual.truth())
        np.testing.assert_array_equal(world.observe().images, usual.observe().images)


# Sensor


IMAGE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (48, 64, 3)), (0, 0), 2).astype(np.float32)
CAMERA = Camera.look_at("above", (0, 0, 0.9), (0, 0, 0))


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_without_a_change_an_image_only_saturates():
    np.testing.assert_array_equal(received(IMAGE, "none", rng()), IMAGE)
    np.testing.assert_array_equal(received(3 * IMAGE, "none", rng()), np.minimum(3 * IMAGE, 1))


def test_noise_has_the_stated_size_and_is_another_one_each_time():
    grey, generator = np.full((128, 128, 3), 0.5, np.float32), rng()
    first, second = (received(grey, "noise", generator) - grey for _ in range(2))
    assert first.mean() == pytest.approx(0, abs=5e-4)
    assert first.std() == pytest.approx(0.02, rel=0.02)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    assert received(np.zeros_like(grey), "noise", rng()).min() == 0
    assert received(np.ones_like(grey), "noise", rng()).max() == 1


def test_jpeg_is_what_decoding_a_jpeg_file_gives(tmp_path):
    path = str(tmp_path / "image.jpg")
    eight_bit = np.round(255 * IMAGE).astype(np.uint8)
    cv2.imwrite(path, eight_bit[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    from_file = cv2.imread(path)[..., ::-1] / 255
    seen = received(IMAGE, "jpeg", rng())
    np.testing.assert_allclose(seen, from_file, atol=1e-6)
    assert 0.002 < np.abs(seen - IMAGE).mean() < 0.02


def test_undecoded_srgb_is_brighter_and_decoded_srgb_is_off_by_half_a_level():
    raw, decoded = (received(IMAGE, change, rng()) for change in ("srgb_8bit", "srgb_8bit_decoded"))
    np.testing.assert_allclose(255 * raw, np.round(255 * raw), atol=1e-4)
    np.testing.assert_allclose(raw, srgb_of_linear(IMAGE), atol=0.51 / 255)
    assert np.all(raw >= IMAGE - 0.01)
    steepest = 2.4 / 1.055  # of the decoding, at white
    np.testing.assert_allclose(decoded, IMAGE, atol=0.51 / 255 * steepest)
    assert len(np.unique(decoded)) <= 256


@pytest.mark.parametrize("change", ["none", "noise", "jpeg", "srgb_8bit", "srgb_8bit_decoded"])
def test_every_change_leaves_float32_in_range(change):
    seen = received(1.4 * IMAGE, change, rng())
    assert seen.dtype == np.float32
    assert seen.shape == IMAGE.shape
    assert seen.min() >= 0
    assert seen.max() <= 1


@pytest.fixture
def masks():
    """Two views of two objects, one of which is cut by the image's border."""
    masks = np.zeros((2, 2, 32, 40), bool)
    masks[:, 0, 10:20, 12:25] = True
    masks[1, 1, 5:15, 0:9] = True
    return masks


def test_larger_masks_reach_exactly_two_pixels_farther(masks):
    larger = resized_masks(masks, 2)
    for before, after in zip(masks.reshape(4, 32, 40), larger.reshape(4, 32, 40), strict=True):
        if not before.any():
            assert not after.any()
            continue
        away = cv2.distanceTransform(1 - before.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        np.testing.assert_array_equal(after, away <= 2)


def test_smaller_masks_keep_what_lies_more_than_two_pixels_inside(masks):
    smaller = resized_masks(masks, -2)
    assert not np.any(smaller & ~masks)
    np.testing.assert_array_equal(np.argwhere(smaller[0, 0])[[0, -1]], [[12, 14], [17, 22]])
    assert smaller[1, 1, 7:13, 0].all(), "an object goes on beyond the image's border"
    np.testing.assert_array_equal(resized_masks(masks, 0), masks)


def test_a_camera_error_moves_a_point_by_the_expected_pixels():
    focal, turn, shift = CAMERA.intrinsics[0, 0], np.deg2rad(0.3), 0.003
    right = CAMERA.T_world_camera.matrix()[:3, 0]
    moved = CameraError(np.zeros(3), shift * right).applied(CAMERA)
    np.testing.assert_allclose(moved.project(np.zeros(3)), [64 - focal * shift / 0.9, 64], atol=1e-6)
    about_down = CAMERA.T_world_camera.matrix()[:3, 1]
    turned = CameraError(turn * about_down, np.zeros(3)).applied(CAMERA)
    np.testing.assert_allclose(turned.project(np.zeros(3)), [64 - focal * np.tan(turn), 64], atol=1e-6)


def test_random_camera_errors_have_the_given_size_and_any_direction():
    generator = rng()
    errors = [CameraError.random(generator, 0.005, 0.003) for _ in range(400)]
    told = CAMERA.T_world_camera
    for error in errors[:5]:
        standing = error.applied(CAMERA)
        assert rotation_angle(standing.T_world_camera.quaternion, told.quaternion) == pytest.approx(0.005)
        assert np.linalg.norm(standing.T_world_camera.position - told.position) == pytest.approx(0.003)
        assert standing.name == CAMERA.name
    np.testing.assert_allclose(np.mean([error.shift for error in errors], axis=0) / 0.003, 0, atol=0.1)
    np.testing.assert_allclose(np.mean([error.rotation for error in errors], axis=0) / 0.005, 0, atol=0.1)


def test_no_error_leaves_a_camera_as_it_is():
    same = CameraError.random(rng(), 0.0, 0.0).applied(CAMERA)
    np.testing.assert_array_equal(same.T_world_camera.position, CAMERA.T_world_camera.position)
    np.testing.assert_array_equal(same.T_world_camera.quaternion, CAMERA.T_world_camera.quaternion)
