import numpy as np
import pytest

from osfcore.estimation.objective import crop_to_masks, masked_loss, render_poses, views_of
from osfcore.estimation.search import MultistartCMA, RankedPoses
from tests.core.estimation.scenes import BOX


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


def test_the_same_generator_gives_the_same_search(models, part, starts, truth):
    first, second = (swarm_of(models, part, starts, truth, seed=3).advance() for _ in range(2))
    np.testing.assert_array_equal(first.candidates.position, second.candidates.position)
    assert first.loss == second.loss
