from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import ObjectModels, views_of
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.paper.estimation import PaperEstimationConfig, estimate_first, estimate_next, masked_error, scene_error
from osfcore.render.types import SceneBatch
from tests.support.errors import about
from tests.support.posed_scenes import apart, observe, scene
from tests.support.rendered_scenes import ball, block, wooden_table

QUICK = PaperEstimationConfig(joint_iterations=40, later_iterations=20)


@pytest.fixture(scope="module")
def plain():
    return ObjectModels({"block": block(), "ball": ball()}, wooden_table())


@pytest.fixture(scope="module")
def truth():
    turned = quaternion_exp(np.array([0.0, 0.0, 0.3]))
    return scene({
        "block": Pose(np.array([0.06, -0.05, 0.05]), turned),
        "ball": Pose(np.array([-0.08, 0.05, 0.05]), np.array([1.0, 0, 0, 0])),
    })  # fmt: skip


@pytest.fixture(scope="module")
def seen(plain, truth):
    return observe(plain, truth, default_cameras(64)[:3])


def batch_of(state, names=None) -> SceneBatch:
    whole = SceneBatch.of(state)
    if names is None:
        return whole
    n = [state.names.index(name) for name in names]
    return SceneBatch(names, whole.positions[:, n], whole.quaternions[:, n], whole.lights, None)


def test_the_truth_has_the_least_error(plain, truth, seen):
    views = views_of(seen, 64)
    moved = replace(truth, poses=Pose(truth.poses.position + (0.01, 0, 0), truth.poses.quaternion))
    assert scene_error(plain, views, batch_of(truth))[0] < 0.2 * scene_error(plain, views, batch_of(moved))[0]
    for n, name in enumerate(truth.names):
        right, wrong = (masked_error(plain, views, n, batch_of(state, (name,)))[0] for state in (truth, moved))
        assert right < wrong  # by little where the light is low, for eq. 5 has it overhead


@pytest.mark.slow
def test_cma_finds_positions_and_the_light(plain, truth, seen):
    steps = list(estimate_first(plain, seen, np.random.default_rng(0), QUICK))
    estimate = steps[-1].estimate
    assert all(step.estimate is None for step in steps[:-1])
    shift, _, light = apart(estimate.state, truth)
    assert shift.max() < 0.02
    assert np.rad2deg(light) < 15
    assert estimate.trusted  # nothing is ever doubted
    first = [step for step in steps if step.stage == "objects"]
    assert len(first) == QUICK.masked_iterations
    assert all(np.array_equal(step.state.light.direction, (0, 0, 1)) for step in first)
    losses = [step.loss for step in steps if step.stage == "together"]
    assert losses == sorted(losses, reverse=True)


def test_a_later_frame_begins_at_the_last_estimate(plain, truth, seen):
    before = replace(truth, poses=Pose(truth.poses.position + (0.008, -0.006, 0), truth.poses.quaternion))
    blind = replace(seen, masks=None)
    estimate = list(estimate_next(plain, blind, before, np.random.default_rng(0), QUICK))[-1].estimate
    shift, turn, light = apart(estimate.state, truth)
    assert shift.max() < 0.006
    assert np.rad2deg(turn[0]) < 10
    assert light == pytest.approx(0, abs=1e-6)  # it is held
    few = replace(QUICK, later_iterations=1)
    sure, blind = (
        list(estimate_next(plain, one, truth, np.random.default_rng(0), few))[-1].loss for one in (seen, blind)
    )
    assert blind < sure  # masks count where there are any


def test_what_cannot_be_estimated_is_refused(plain, truth, seen):
    rng = np.random.default_rng(0)
    with pytest.raises(InvalidInput, check=about("masks of the first frame")):
        list(estimate_first(plain, replace(seen, masks=None), rng, QUICK))
    with pytest.raises(InvalidInput, check=about("mask of block")):
        list(estimate_first(plain, replace(seen, masks=np.zeros_like(seen.masks)), rng, QUICK))
    with pytest.raises(InvalidInput, check=about("objects of the last estimate")):
        list(estimate_next(plain, seen, scene({"ball": truth.pose("ball")}), rng, QUICK))


@pytest.mark.slow
def test_a_second_round_has_the_light_that_was_found_and_searches_end_when_they_converge(plain, truth, seen):
    starts = {name: np.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0]]) for name in truth.names}
    config = PaperEstimationConfig(
        masked_iterations=60, masked_population=16, joint_iterations=60, joint_population=16, rounds=2, converged=0.3
    )
    steps = list(estimate_first(plain, seen, np.random.default_rng(0), config, starts))
    assert len(steps) < 2 * (60 + 60)
    assert [step.estimate is None for step in steps].count(False) == 1
    masked = [step for step in steps if step.stage == "objects"]
    overhead = [step for step in masked if np.array_equal(step.state.light.direction, (0, 0, 1))]
    assert 0 < len(overhead) < len(masked)
    tried = [len(step.candidates.position) for step in masked if step.candidates is not None]
    assert max(tried) == 2 * 16  # of both searches for an object
