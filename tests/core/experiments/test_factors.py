from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.experiments.factors import FACTORS, CameraError, Factor, VariedWorld, factor_named, received, resized_masks
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.metrics.success import RearrangementTask
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

CAN = SceneRequest(names=("005_tomato_soup_can",))
CAMERAS, GOAL = default_cameras(48), goal_camera(48)


def varied(library, factor: str | Factor, *, seed: int = 0, cameras=CAMERAS):
    factor = factor_named(factor) if isinstance(factor, str) else factor
    return closing(VariedWorld(library, factor, np.random.default_rng(seed), cameras=cameras, request=CAN))


@pytest.fixture(scope="module")
def usual(library):
    """A scene as a world shows it that differs in nothing."""
    with closing(Tabletop(library, cameras=CAMERAS, request=CAN)) as world:
        world.arrange(1)
        yield world


@pytest.mark.parametrize("name", FACTORS)
def test_every_factor_makes_a_world(library, name):
    seen = []
    for _ in range(2):
        with varied(library, name, cameras=CAMERAS[:2]) as world:
            assert world.reset(1).masks is None
            world.act(np.array([0.3, -0.2, 0.0]))
            seen.append(world.observe(masks=True))
    assert seen[0].images.dtype == np.float32
    assert 0 <= seen[0].images.min() < seen[0].images.max() <= 1
    assert seen[0].cameras == CAMERAS[:2]
    assert seen[0].masks.any()
    np.testing.assert_array_equal(seen[0].images, seen[1].images)


def test_no_factor_is_the_usual_world_to_the_last_bit(library, usual):
    with varied(library, Factor()) as world:
        np.testing.assert_array_equal(world.reset(1).images, usual.observe().images)
        goal = world.goal_image(usual.truth(), GOAL)
        np.testing.assert_array_equal(goal.image, world.render((GOAL,), with_pusher=False).images[0])


@pytest.mark.parametrize("is_relit", [False, True])
def test_low_light_keeps_its_azimuth(usual, is_relit):
    lights = Light.from_angles(2.0, np.deg2rad(60.0)), Light.from_angles(-1.0 if is_relit else 2.0, np.deg2rad(60.0))
    start, goal = (replace(usual.truth(), light=light) for light in lights)
    for seed in range(20):
        given = RearrangementTask(0, start, goal, ())
        task = factor_named("light_low").task(given, np.random.default_rng(seed))
        for state, light in ((task.start, lights[0]), (task.goal, lights[1])):
            assert 5 <= np.rad2deg(np.arcsin(state.light.direction[2])) <= 10
            azimuths = [np.arctan2(*one.direction[1::-1]) for one in (state.light, light)]
            assert azimuths[0] == pytest.approx(azimuths[1])
        assert (task.start.light.angle_to(task.goal.light) > 0.01) == is_relit


@pytest.mark.parametrize("ambient", [0.1, 0.5])
def test_shares_of_ambient_light_change_shadows_more_than_lit_table(library, usual, ambient):
    (picture,) = usual.pictures(CAMERAS[:1])
    table = (picture.coverage.sum(axis=0) == 0) & (picture.depth < 1)
    with varied(library, f"ambient_{ambient}", cameras=CAMERAS[:1]) as world:
        world.restore(usual.truth())
        seen = world.observe().images[0][table][:, 0]
    sine = usual.truth().light.direction[2]
    expected = ambient / (ambient + (1 - ambient) * sine)
    assert seen.min() / np.median(seen) == pytest.approx(expected, rel=0.02)


def test_wood_is_another_one_in_each_world_and_stays_in_it(library, usual):
    corners = []
    for seed in range(2):
        with varied(library, "table_wood", seed=seed, cameras=CAMERAS[:1]) as world:
            world.restore(usual.truth())
            first, second = world.observe().images, world.observe().images
            np.testing.assert_array_equal(first, second)
            corners.append(first[0, -12:, :12])
    assert min(corner.std(axis=(0, 1)).min() for corner in corners) > 0.01
    assert np.abs(corners[0] - corners[1]).mean() > 0.01


def test_shifted_cameras_stay_where_they_are_and_keep_their_calibration(library, usual):
    cameras = default_cameras(128)
    with varied(library, "camera_shifted", cameras=cameras) as world:
        world.restore(usual.truth())
        seen, ideal = world.observe(masks=True), world.render(cameras, masks=True)
        goal = world.goal_image(usual.truth(), goal_camera(128)).image
        assert np.abs(goal - world.render((goal_camera(128),), with_pusher=False).images[0]).max() > 0.05
        world.restore(usual.truth())
        np.testing.assert_array_equal(world.observe().images, seen.images)
    assert seen.cameras == cameras
    centres = ([np.argwhere(mask).mean(axis=0) for mask in masks] for masks in (seen.masks[:, 0], ideal.masks[:, 0]))
    moved = [np.linalg.norm(mine - true) for mine, true in zip(*centres, strict=True)]
    focal = cameras[0].intrinsics[0, 0]
    most = focal * (np.tan(np.deg2rad(0.3)) * 1.3 + 0.003 / 0.6)  # off the middle, and for near objects
    assert 0.2 < max(moved) < most
    assert np.std(moved) > 0.02


@pytest.mark.parametrize(("name", "change"), [("noise_2", "noise"), ("jpeg_80", "jpeg"), ("mass_2", "none")])
def test_images_and_goals_are_changed_alike(library, usual, name, change):
    drawn = np.random.default_rng(0)
    factor_named(name).camera_errors(drawn, len(CAMERAS) + 1)  # what a world draws when it is made
    with varied(library, name) as world:
        world.restore(usual.truth())
        seen = world.observe().images
        goal = world.goal_image(usual.truth(), GOAL).image
    clean = [*usual.observe().images, usual.render((GOAL,), with_pusher=False).images[0]]
    for mine, image in zip([*seen, goal], clean, strict=True):
        np.testing.assert_array_equal(mine, received(image, change, drawn))


# Sensors


IMAGE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (48, 64, 3)), (0, 0), 2).astype(np.float32)
CAMERA = Camera.look_at("above", (0, 0, 0.9), (0, 0, 0))


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


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
    seen = received(IMAGE, "jpeg", rng())
    np.testing.assert_allclose(seen, cv2.imread(path)[..., ::-1] / 255, atol=1e-6)
    assert 0.002 < np.abs(seen - IMAGE).mean() < 0.02


def test_undecoded_srgb_is_brighter_and_decoded_srgb_is_off_by_half_a_level():
    raw, decoded = (received(IMAGE, change, rng()) for change in ("srgb_8bit", "srgb_8bit_decoded"))
    np.testing.assert_allclose(255 * raw, np.round(255 * raw), atol=1e-4)
    np.testing.assert_allclose(raw, srgb_of_linear(IMAGE), atol=0.51 / 255)
    assert np.all(raw >= IMAGE - 0.01)
    steepest = 2.4 / 1.055  # of the decoding, at white
    np.testing.assert_allclose(decoded, IMAGE, atol=0.51 / 255 * steepest)
    assert decoded.dtype == np.float32
    assert len(np.unique(decoded)) <= 256


@pytest.fixture
def masks():
    """Two views of two objects, one of which is cut by the image's border."""
    masks = np.zeros((2, 2, 32, 40), bool)
    masks[:, 0, 10:20, 12:25] = True
    masks[1, 1, 5:15, 0:9] = True
    return masks


def test_masks_reach_exactly_two_pixels_farther_or_less_far(masks):
    larger, smaller = resized_masks(masks, 2), resized_masks(masks, -2)
    for before, after in zip(masks.reshape(4, 32, 40), larger.reshape(4, 32, 40), strict=True):
        if before.any():
            away = cv2.distanceTransform(1 - before.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            np.testing.assert_array_equal(after, away <= 2)
        else:
            assert not after.any()
    assert not np.any(smaller & ~masks)
    np.testing.assert_array_equal(np.argwhere(smaller[0, 0])[[0, -1]], [[12, 14], [17, 22]])
    assert smaller[1, 1, 7:13, 0].all(), "an object goes on beyond the image's border"


def test_a_camera_error_moves_a_point_by_the_expected_pixels():
    focal, turn, shift = CAMERA.intrinsics[0, 0], np.deg2rad(0.3), 0.003
    right, down, _ = CAMERA.T_world_camera.matrix()[:3, :3].T
    moved = CameraError(np.zeros(3), shift * right).applied(CAMERA)
    np.testing.assert_allclose(moved.project(np.zeros(3)), [64 - focal * shift / 0.9, 64], atol=1e-6)
    turned = CameraError(turn * down, np.zeros(3)).applied(CAMERA)
    np.testing.assert_allclose(turned.project(np.zeros(3)), [64 - focal * np.tan(turn), 64], atol=1e-6)
