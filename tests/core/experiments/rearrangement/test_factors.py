from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.world import World
from osfcore.errors import UnknownName
from osfcore.experiments.factors import (
    EPISODE_FACTORS,
    FACTORS,
    FIRST_FRAME_FACTORS,
    Factor,
    VariedWorld,
    factor_named,
    received,
)
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.metrics.success import RearrangementTask
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

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
