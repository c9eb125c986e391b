from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import (
    LIGHT,
    POSE,
    QUALITY,
    crop_to_masks,
    loss_of,
    masked_loss,
    render_poses,
    views_of,
)
from osfcore.estimation.search import (
    CMAES,
    PLANAR_PARAMETERS,
    GaussNewtonState,
    MultistartCMA,
    RankedPoses,
    gauss_newton,
    initial_poses,
    light_loss_ratio,
    rank_poses,
    search_light,
    search_scene,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from tests.support.posed_scenes import BOTTLE, BOX, angle, apart, lying, observe, own_views, params_of, scene

# CMA-ES


SCALES = np.array([0.5, 0.0, 2.0, 0.1])
TARGET = np.array([0.4, 0.0, -1.0, 0.12])


def bowl(x: np.ndarray) -> np.ndarray:
    return (((x - TARGET) / np.where(SCALES > 0, SCALES, 1)) ** 2).sum(axis=1)


def searched(seed: int, generations: int = 40, losses=bowl) -> CMAES:
    search = CMAES(SCALES, 10, np.random.default_rng(seed))
    for _ in range(generations):
        search.tell(losses(search.ask()))
    return search


def test_finds_the_minimum_of_a_quadratic_with_its_own_generator_alone():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    search, again = searched(0), searched(0)
    np.testing.assert_allclose(search.mean, TARGET, atol=1e-3)
    assert search.sigma < 0.05
    np.testing.assert_array_equal(search.ask(), again.ask())
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


@pytest.mark.parametrize("worst", [np.inf, np.nan])
def test_losses_beyond_all_bounds_are_only_bad(worst):
    search = searched(0, losses=lambda x: np.where(x[:, 0] < 0, worst, bowl(x)))
    np.testing.assert_allclose(search.mean, TARGET, atol=2e-3)


# CMA-ES over poses


@pytest.fixture(scope="module")
def part(seen):
    return crop_to_masks(views_of(seen, 48), 0)


@pytest.fixture(scope="module")
def starts(truth):
    """The true pose, 6 mm off."""
    position, quaternion = truth.poses.position[0], truth.poses.quaternion[0]
    return RankedPoses(Pose((position + [0.004, -0.004, 0.002])[None], quaternion[None]), np.array([1.0]))


def test_a_search_in_the_masks_ends_nearer_than_it_began(models, part, starts, truth):
    light, rng = truth.light.direction, np.random.default_rng(0)
    swarm = MultistartCMA(models, BOX, part, starts, light, population=10, rng=rng, any_brightness=False)
    np.testing.assert_array_equal(swarm.best_poses().position, np.repeat(starts.poses.position, 2, axis=0))
    tried, least = zip(*(swarm.advance() for _ in range(8)), strict=True)
    before, after = masked_loss(render_poses(models, BOX, part, swarm.best_poses(), light), part)
    assert after < before
    assert min(least) < before
    assert tried[0].position.shape == (10, 3)


def test_a_search_for_a_scene_keeps_the_best_and_holds_what_has_no_scale(models, truth, views):
    start = changed(truth, SHIFT)
    scales = np.array([4e-3] * 3 + [0.1] * 3 + [0.0] * (POSE + LIGHT))
    rng = np.random.default_rng(0)
    found = list(search_scene(models, views, start, scales, population=8, generations=5, rng=rng))
    losses = [loss_of(models, views, start), *(generation.loss for generation in found)]
    assert np.all(np.diff(losses) <= 0)
    assert losses[-1] < 0.9 * losses[0]
    assert loss_of(models, views, found[-1].best) == pytest.approx(losses[-1], rel=1e-6)
    np.testing.assert_array_equal(found[-1].best.positions[1], start.positions[1])
    np.testing.assert_array_equal(found[-1].best.light, found[0].lights[0])


# Gauss-Newton


SHIFT = np.array([0.006, -0.004, 0.003, 0.05, -0.04, 0.08])


@pytest.fixture(scope="module")
def views(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


def changed(truth, first=(0,) * 6, second=(0,) * 6, light=(0, 0)):
    return params_of(truth).updated(np.array([*first, *second, *light], float))


def ended(models, views, params, **how) -> GaussNewtonState:
    return list(gauss_newton(models, views, GaussNewtonState.at(params), **how))[-1]


def test_only_the_objects_asked_for_move(models, truth, views):
    start = changed(truth, SHIFT, SHIFT, (0.1, 0.0))
    at = ended(models, views, start, iterations=2, objects=(1,))
    assert not np.array_equal(at.params.positions[1], start.positions[1])
    np.testing.assert_array_equal(at.params.positions[0], start.positions[0])
    np.testing.assert_allclose(at.params.light, start.light, atol=1e-12)
    assert [bool(normal.any()) for normal in at.normals] == [False, True, False]
    assert np.isfinite(at.losses).tolist() == [False, True, False]


def test_planar_objects_stay_flat_on_the_table(models, truth, views):
    start = changed(truth, SHIFT * np.isin(range(6), PLANAR_PARAMETERS))
    at = ended(models, views, start, iterations=5, numbers=PLANAR_PARAMETERS, objects=(0,))
    assert apart(at.params, truth)[0][0] < 1e-3
    np.testing.assert_array_equal(at.params.positions[:, 2], start.positions[:, 2])
    others = np.setdiff1d(range(6), PLANAR_PARAMETERS)
    assert not at.normals[0][others].any()
    assert not at.normals[0][:, others].any()
    assert at.normals[0][np.ix_(PLANAR_PARAMETERS, PLANAR_PARAMETERS)].all()


def test_objects_and_light_move_back_together_and_no_sweep_makes_it_worse(models, truth, views):
    start = changed(truth, SHIFT, -SHIFT, (0.1, 0.05))
    steps = list(gauss_newton(models, views, GaussNewtonState.at(start), iterations=6, light=views))
    shift, turn, light = apart(steps[-1].params, truth)
    assert shift.max() < 6e-4
    assert turn.max() < 0.01
    assert light < 0.01
    assert len(steps) == 6
    losses = [step.losses[-1] for step in steps]
    assert np.all(np.diff(losses) <= 0)
    assert losses[-1] == pytest.approx(loss_of(models, views, steps[-1].params), rel=1e-3)
    for normal, size in zip(steps[-1].normals, (POSE, POSE, LIGHT), strict=True):
        assert normal.shape == (size, size)
        np.testing.assert_allclose(normal, normal.T, rtol=1e-4, atol=1e-4 * normal.max())
        assert np.linalg.eigvalsh((normal + normal.T) / 2).min() > 0


def test_an_object_out_of_sight_stays_where_it_is(models, truth, views):
    params = params_of(truth)
    away = replace(params, positions=params.positions + [[0, 0, 0], [0, 0, -1.0]])
    at = ended(models, views, away, iterations=2, objects=(1,))
    np.testing.assert_array_equal(at.params.positions, away.positions)
    assert not at.normals[1].any()


# Light search


def found(models, state, params):
    seen = observe(models, state, default_cameras(96)[:2], masks=False)
    return search_light(models, views_of(seen, 32), views_of(seen, 64), params)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(30, 15), (-120, 25), (140, 45), (-100, 70), (0, 89)])
def test_the_light_of_a_scene_is_found(models, azimuth_deg, elevation_deg):
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0, 7), (60, 13), (120, 7), (210, 13), (270, 7), (330, 7)])
def test_a_light_near_the_horizon_is_found_with_one_object(models, azimuth_deg, elevation_deg):
    """Shading changes by half from one direction of a grid to the next, and the table's alone gives no azimuth."""
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.03, -0.05)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


def test_roughly_right_poses_give_the_light_wherever_the_guess_has_its_own(models, truth):
    change = np.array([0.008, -0.005, 0.002, 0.05, 0, 0.1, -0.006, 0.007, 0, 0, 0.05, -0.12, 0, 0])
    wrong = params_of(truth).updated(change)
    light = found(models, truth, wrong)
    assert np.rad2deg(angle(light, truth.light.direction)) < 6
    elsewhere = replace(wrong, light=np.array([0.6, -0.64, 0.48]))
    np.testing.assert_array_equal(found(models, truth, elsewhere), light)


def test_the_right_light_is_hardly_beaten_and_a_wrong_one_clearly(models, truth):
    views, right = views_of(observe(models, truth, default_cameras(96)[:2], masks=False), 32), params_of(truth)
    assert light_loss_ratio(models, views, right) > 1
    assert light_loss_ratio(models, views, right.updated(np.array([0] * 12 + [0.6, -0.4]))) < 0.5


# Where to begin


@pytest.fixture(scope="module")
def parts(seen, models):
    views = views_of(seen, 64)
    return {name: crop_to_masks(views, number) for number, name in enumerate(seen.names)}


@pytest.fixture(scope="module")
def ranked_poses(models, parts):
    return {name: initial_poses(models, name, part) for name, part in parts.items()}


@pytest.mark.parametrize("name", [BOX, BOTTLE])
def test_every_way_to_lie_is_ranked_and_among_the_first_is_the_truth(models, truth, ranked_poses, name):
    found, pose = ranked_poses[name], truth.pose(name)
    assert np.all(np.diff(found.losses) >= 0)
    turns = rotation_angle(found.poses.quaternion[:12], pose.quaternion)
    best = int(turns.argmin())
    assert turns[best] < np.deg2rad(10)
    assert np.linalg.norm(found.poses.position[best] - pose.position) < 0.012
    assert {tuple(q) for q in ranked_poses[name].poses.quaternion} == {
        tuple(q) for q in models.resting(name).quaternions
    }


def test_one_view_is_enough(models, truth, parts):
    part = parts[BOX]
    single = replace(part, cameras=part.cameras[:1], rgb=part.rgb[:1], mask=part.mask[:1], valid=part.valid[:1],
                     area=part.area[:1])  # fmt: skip
    found, pose = initial_poses(models, BOX, single), truth.pose(BOX)
    turns = rotation_angle(found.poses.quaternion, pose.quaternion)
    assert np.linalg.norm(found.poses.position[turns.argmin()] - pose.position) < 0.02
    assert turns.argmin() < len(turns) / 4


def test_under_the_right_light_the_truth_comes_first(models, truth, parts, ranked_poses):
    found, pose = ranked_poses[BOX], truth.pose(BOX)
    order = rank_poses(models, BOX, parts[BOX], Pose.joined(found.poses, pose[None]), truth.light.direction)
    assert np.all(np.diff(order.losses) >= 0)
    assert rotation_angle(order.poses.quaternion[0], pose.quaternion) < np.deg2rad(5)
    assert np.linalg.norm(order.poses.position[0] - pose.position) < 0.004
    assert pose.quaternion in order.poses.quaternion[:3]


@pytest.mark.parametrize("sign", [1, -1])  # q and -q are the same orientation
def test_distinct_orientations_are_those_far_from_better_ones(sign):
    turns = sign * quaternion_exp(np.outer(np.deg2rad([0, 10, 40, 50, 90, 20]), [0, 0, 1.0]))
    starts = RankedPoses(Pose(np.arange(18.0).reshape(6, 3), turns), np.arange(6.0))
    assert starts.distinct(2).losses.tolist() == [0, 2]
    assert starts.distinct(9).losses.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(starts.distinct(9).poses.position, starts.poses.position[[0, 2, 4]])
