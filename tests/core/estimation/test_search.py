"""Search: cma es, multistart cma, gauss newton, light search, pose initialization."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import (
    LIGHT,
    POSE,
    QUALITY,
    crop_to_masks,
    masked_loss,
    photometric_loss,
    render_poses,
    residuals,
    views_of,
)
from osfcore.estimation.search import (
    CMAES,
    OVERHEAD,
    PLANAR_PARAMETERS,
    GaussNewtonState,
    MultistartCMA,
    RankedPoses,
    difference_steps,
    gauss_newton,
    initial_poses,
    light_loss_ratio,
    rank_poses,
    search_light,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import quaternion_exp, rotation_angle
from tests.core.estimation.scenes import BOTTLE, BOX, angle, apart, lying, observe, own_views, params_of, scene

# Cma es


SCALES = np.array([0.5, 0.0, 2.0, 0.1])
TARGET = np.array([0.4, 0.0, -1.0, 0.12])


def bowl(x: np.ndarray) -> np.ndarray:
    return (((x - TARGET) / np.where(SCALES > 0, SCALES, 1)) ** 2).sum(axis=1)


def searched(seed: int, generations: int = 40, losses=bowl) -> CMAES:
    search = CMAES(SCALES, 10, np.random.default_rng(seed))
    for _ in range(generations):
        search.tell(losses(search.ask()))
    return search


@pytest.mark.parametrize("seed", range(3))
def test_finds_the_minimum_of_a_quadratic(seed):
    search = searched(seed)
    np.testing.assert_allclose(search.mean, TARGET, atol=1e-3)
    assert search.sigma < 0.05


def test_begins_at_zero_with_the_scales_for_deviations():
    search = CMAES(SCALES, 2000, np.random.default_rng(0))
    np.testing.assert_array_equal(search.mean, 0)
    assert search.sigma == 1
    asked = search.ask()
    assert asked.shape == (2000, 4)
    np.testing.assert_allclose(asked.std(axis=0), SCALES, rtol=0.1)


def test_a_number_whose_scale_is_zero_is_held():
    search = CMAES(SCALES, 6, np.random.default_rng(0))
    for _ in range(5):
        asked = search.ask()
        assert not asked[:, 1].any()
        assert asked[:, [0, 2, 3]].all()
        search.tell(bowl(asked + [0, 1, 0, 0]))
    assert search.mean[1] == 0


def test_the_same_generator_gives_the_same_search():
    np.testing.assert_array_equal(searched(4, 5).ask(), searched(4, 5).ask())
    assert not np.array_equal(searched(4, 5).ask(), searched(5, 5).ask())


def test_numpys_global_generator_is_left_alone():
    before = np.random.get_state()  # noqa: NPY002
    searched(0, 5)
    after = np.random.get_state()  # noqa: NPY002
    assert before[0] == after[0]
    np.testing.assert_array_equal(before[1], after[1])
    assert before[2:] == after[2:]


@pytest.mark.parametrize("worst", [np.inf, np.nan])
def test_losses_beyond_all_bounds_are_only_bad(worst):
    search = searched(0, losses=lambda x: np.where(x[:, 0] < 0, worst, bowl(x)))
    np.testing.assert_allclose(search.mean, TARGET, atol=2e-3)


# Multistart cma


@pytest.fixture(scope="module")
def part(seen):
    return crop_to_masks(views_of(seen, 48), 0)


@pytest.fixture(scope="module")
def starts(truth):
    """The true pose, 6 mm off."""
    position, quaternion = truth.poses.position[0], truth.poses.quaternion[0]
    return RankedPoses((position + [0.004, -0.004, 0.002])[None], quaternion[None], np.array([1.0]))


def swarm_of(models, part, starts, truth, seed=0):
    return MultistartCMA(
        models,
        BOX,
        part,
        starts,
        truth.light.direction,
        population=10,
        rng=np.random.default_rng(seed),
        any_brightness=False,
    )


def losses_of(models, part, poses, truth):
    look = render_poses(models, BOX, part, poses.position, poses.quaternion, truth.light.direction)
    return masked_loss(look, part)


def test_a_search_ends_nearer_than_it_began(models, part, starts, truth):
    swarm = swarm_of(models, part, starts, truth)
    told = [swarm.advance() for _ in range(8)]
    before, after = losses_of(models, part, swarm.best_poses(), truth)
    assert after < before
    assert min(generation.loss for generation in told) < before
    assert told[0].candidates.position.shape == (10, 3)
    assert told[-1].sigma > 0


def test_ends_begin_with_the_starts(models, part, starts, truth):
    ends = swarm_of(models, part, starts, truth).best_poses()
    np.testing.assert_array_equal(ends.position, np.repeat(starts.positions, 2, axis=0))
    np.testing.assert_allclose(ends.quaternion, np.repeat(starts.quaternions, 2, axis=0), atol=1e-12)


def test_the_same_generator_gives_the_same_search_multistart_cma(models, part, starts, truth):
    first, second = (swarm_of(models, part, starts, truth, seed=3).advance() for _ in range(2))
    np.testing.assert_array_equal(first.candidates.position, second.candidates.position)
    assert first.loss == second.loss


# Gauss newton


SHIFT = np.array([0.006, -0.004, 0.003, 0.05, -0.04, 0.08])


@pytest.fixture(scope="module")
def views(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


def changed(truth, first=(0,) * 6, second=(0,) * 6, light=(0, 0)):
    return params_of(truth).updated(np.array([*first, *second, *light], float))


def loss(models, views, params) -> float:
    return float(photometric_loss(residuals(models, views, params.perturbed(np.zeros((1, params.size)))))[0])


def ended(models, views, params, **how) -> GaussNewtonState:
    return list(gauss_newton(models, views, GaussNewtonState.at(params), **how))[-1]


@pytest.mark.parametrize("sign", [-1, 1])
def test_shifted_objects_move_back(models, truth, views, sign):
    start = changed(truth, sign * SHIFT, -sign * SHIFT)
    end = ended(models, views, start, iterations=6).params
    for before, after, bound in zip(apart(start, truth)[:2], apart(end, truth)[:2], (5e-4, 0.01), strict=True):
        assert np.all(after < before / 10)
        assert np.all(after < bound)
    assert loss(models, views, end) < loss(models, views, start) / 100


def test_the_light_moves_back(models, truth, views):
    start = changed(truth, light=(0.15, -0.1))
    end = ended(models, views, start, iterations=4, objects=(), light=views).params
    assert apart(end, truth)[2] < apart(start, truth)[2] / 10
    assert apart(end, truth)[2] < 0.01
    np.testing.assert_array_equal(end.positions, start.positions)


def test_objects_and_light_move_back_together(models, truth, views):
    start = changed(truth, SHIFT, -SHIFT, (0.1, 0.05))
    end = ended(models, views, start, iterations=6, light=views).params
    shift, turn, light = apart(end, truth)
    assert shift.max() < 6e-4
    assert turn.max() < 0.01
    assert light < 0.01


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


def test_each_sweep_is_told_and_none_makes_it_worse(models, truth, views):
    start = changed(truth, SHIFT, -SHIFT, (0.1, 0))
    steps = list(gauss_newton(models, views, GaussNewtonState.at(start), iterations=4, light=views))
    assert len(steps) == 4
    losses = [step.losses[-1] for step in steps]
    assert np.all(np.diff(losses) <= 0)
    assert losses[-1] == pytest.approx(loss(models, views, steps[-1].params), rel=1e-3)
    for normal, size in zip(steps[-1].normals, (POSE, POSE, LIGHT), strict=True):
        assert normal.shape == (size, size)
        np.testing.assert_allclose(normal, normal.T, rtol=1e-4, atol=1e-4 * normal.max())
        assert np.linalg.eigvalsh((normal + normal.T) / 2).min() > 0


def test_at_the_truth_nothing_moves(models, truth, views):
    """Whose images are explained to the last bit."""
    end = ended(models, views, params_of(truth), iterations=2, light=views)
    np.testing.assert_allclose(end.params.positions, truth.poses.position, atol=1e-5)
    assert end.losses.max() < 1e-9


def test_an_object_out_of_sight_stays_where_it_is(models, truth, views):
    params = params_of(truth)
    away = replace(params, positions=params.positions + [[0, 0, 0], [0, 0, -1.0]])
    at = ended(models, views, away, iterations=2, objects=(1,))
    np.testing.assert_array_equal(at.params.positions, away.positions)
    assert not at.normals[1].any()


def test_no_iterations_are_none(models, truth, views):
    assert list(gauss_newton(models, views, GaussNewtonState.at(params_of(truth)), iterations=0)) == []


def test_half_widths_are_of_each_number():
    assert difference_steps(0).shape == (LIGHT,)
    widths = difference_steps(2)
    assert widths.shape == (2 * POSE + LIGHT,)
    np.testing.assert_array_equal(widths[:POSE], widths[POSE : 2 * POSE])
    assert np.all(widths > 0)


# Light search


def found(models, state, params):
    seen = observe(models, state, default_cameras(96)[:2], masks=False)
    return search_light(models, views_of(seen, 32), views_of(seen, 64), params)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(30, 15), (-120, 25), (140, 45), (-100, 70), (0, 89)])
def test_the_light_of_a_scene_is_found(models, azimuth_deg, elevation_deg):
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


@pytest.mark.parametrize("azimuth_deg", range(0, 360, 30))
@pytest.mark.parametrize("elevation_deg", [7, 13])
def test_a_light_near_the_horizon_is_found_with_one_object(models, azimuth_deg, elevation_deg):
    """Shading changes by half from one direction of a grid to the next, and the table's alone tells no azimuth."""
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.03, -0.05)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


def test_poses_need_not_be_right_to_the_degree(models, truth):
    params = params_of(truth)
    change = np.array([0.008, -0.005, 0.002, 0.05, 0, 0.1, -0.006, 0.007, 0, 0, 0.05, -0.12, 0, 0])
    wrong = params.updated(change)
    assert np.rad2deg(angle(found(models, truth, wrong), truth.light.direction)) < 6


def test_where_the_guess_has_its_light_plays_no_part(models, truth):
    params = params_of(truth)
    other = params.updated(np.array([0] * 12 + [0.6, -0.4]))
    a, b = found(models, truth, params), found(models, truth, other)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(np.linalg.norm(a), 1, atol=1e-12)


def test_the_right_light_is_hardly_beaten_and_a_wrong_one_clearly(models, truth):
    seen = observe(models, truth, default_cameras(96)[:2], masks=False)
    params = params_of(truth)
    wrong = params.updated(np.array([0] * 12 + [0.6, -0.4]))
    assert light_loss_ratio(models, views_of(seen, 32), params) > 1
    assert light_loss_ratio(models, views_of(seen, 32), wrong) < 0.5


# Pose initialization


@pytest.fixture(scope="module")
def parts(seen, models):
    views = views_of(seen, 64)
    return {name: crop_to_masks(views, number) for number, name in enumerate(seen.names)}


@pytest.fixture(scope="module")
def ranked_poses(models, parts):
    return {name: initial_poses(models, name, part) for name, part in parts.items()}


def centroid(weights):
    rows, columns = np.indices(weights.shape) + 0.5
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


@pytest.mark.parametrize("name", [BOX, BOTTLE])
def test_every_way_to_lie_is_ranked(models, ranked_poses, name):
    found, resting = ranked_poses[name], models.resting(name)
    assert len(found.positions) == len(found.quaternions) == len(found.losses) == len(resting.heights)
    assert np.all(np.diff(found.losses) >= 0)
    assert {tuple(q) for q in found.quaternions} == {tuple(q) for q in resting.quaternions}


@pytest.mark.parametrize("name", [BOX, BOTTLE])
def test_among_the_first_is_the_truth(truth, ranked_poses, name):
    found, pose = ranked_poses[name].best(12), truth.pose(name)
    turns = rotation_angle(found.quaternions, pose.quaternion)
    best = int(turns.argmin())
    assert turns[best] < np.deg2rad(10)
    assert np.linalg.norm(found.positions[best] - pose.position) < 0.012


def test_all_are_put_where_the_masks_are(models, parts, ranked_poses):
    part, found = parts[BOX], ranked_poses[BOX]
    look = render_poses(models, BOX, part, found.positions, found.quaternions, OVERHEAD)
    off = [
        np.linalg.norm(centroid(shown[v] * part.valid[v]) - centroid(part.mask[v] * part.valid[v]))
        for shown in look.opacity
        for v in range(len(part.cameras))
    ]
    assert np.median(off) < 2
    assert max(off) < 8


def test_one_view_is_enough(models, truth, parts):
    part = parts[BOX]
    single = replace(part, cameras=part.cameras[:1], rgb=part.rgb[:1], mask=part.mask[:1], valid=part.valid[:1],
                     area=part.area[:1])  # fmt: skip
    found, pose = initial_poses(models, BOX, single), truth.pose(BOX)
    turns = rotation_angle(found.quaternions, pose.quaternion)
    assert np.linalg.norm(found.positions[turns.argmin()] - pose.position) < 0.02
    assert turns.argmin() < len(turns) / 4


def test_under_the_right_light_the_truth_comes_first(models, truth, parts, ranked_poses):
    found, pose = ranked_poses[BOX], truth.pose(BOX)
    positions = np.concatenate([found.positions, pose.position[None]])
    quaternions = np.concatenate([found.quaternions, pose.quaternion[None]])
    order = rank_poses(models, BOX, parts[BOX], positions, quaternions, truth.light.direction)
    assert np.all(np.diff(order.losses) >= 0)
    assert rotation_angle(order.quaternions[0], pose.quaternion) < np.deg2rad(5)
    assert np.linalg.norm(order.positions[0] - pose.position) < 0.004
    assert pose.quaternion in order.quaternions[:3]


def test_the_best_and_the_distinct():
    angles = np.deg2rad([0, 10, 40, 50, 90, 20])
    turns = quaternion_exp(np.outer(angles, [0, 0, 1.0]))
    starts = RankedPoses(np.arange(18.0).reshape(6, 3), turns, np.arange(6.0))
    assert starts.best(2).losses.tolist() == [0, 1]
    assert starts.best(9).losses.tolist() == [0, 1, 2, 3, 4, 5]
    assert starts.distinct(2).losses.tolist() == [0, 2]
    assert starts.distinct(9).losses.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(starts.distinct(9).positions, starts.positions[[0, 2, 4]])
    turned = replace(starts, quaternions=-turns)  # which is the same orientation
    assert turned.distinct(9).losses.tolist() == [0, 2, 4]
