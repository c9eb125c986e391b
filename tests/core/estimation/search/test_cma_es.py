import numpy as np
import pytest

from osfcore.estimation.search import CMAES

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
