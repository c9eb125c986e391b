import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.experiments import statistics

OUTCOMES = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=2, max_size=30)


def test_figures_are_of_what_is_known():
    values = [1.0, 2.0, 4.0, 9.0]
    assert statistics.mean([*values, None]) == 4
    assert statistics.median([None, *values]) == 3
    assert statistics.quantile(values, 1 / 3) == 2
    found = statistics.spread("mm", values, ("p90", "mean", "median", "max"))
    assert list(found) == ["mm_p90", "mm_mean", "mm_median", "mm_max"]
    assert list(found.values()) == pytest.approx([7.5, 4, 3, 9])
    assert statistics.mean([None]) is statistics.median([]) is statistics.quantile([], 0.5) is None
    assert set(statistics.spread("mm", [], ("mean", "p95", "max")).values()) == {None}


def test_the_interval_of_a_share_is_wilsons():
    # By Wilson (1927), with z = 1.96: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    n, p, z = 20, 0.95, 1.959964
    middle, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    expected = np.array([middle - half, middle + half]) / (1 + z**2 / n)
    assert statistics.share_interval(19, 20) == pytest.approx(expected, abs=1e-6)


def test_the_interval_of_a_mean_narrows_with_the_root_of_the_number():
    values = np.random.default_rng(0).normal(5, 1, 400)
    widths = [np.ptp(statistics.mean_interval(values[:count])) for count in (100, 400)]
    assert widths[0] == pytest.approx(2 * 1.96 / 10, rel=0.25)
    assert widths[0] / widths[1] == pytest.approx(2, rel=0.25)


@pytest.mark.parametrize("values", [[3.0], [3.0, 3.0, 3.0]])
def test_values_without_spread_have_no_interval(values):
    assert statistics.mean_interval(values) is None
    assert statistics.compare_means(values, [0.0] * len(values)) == {"difference": 3.0, "interval": None}


@pytest.mark.parametrize(("only_one", "p"), [(5, 2 / 2**5), (6, 2 / 2**6), (0, 1.0)])
def test_mcnemar_counts_tasks_in_which_one_alone_succeeds(only_one, p):
    ours = [True] * (10 + only_one) + [False] * 10
    others = [True] * 10 + [False] * (10 + only_one)
    found = statistics.compare_shares(ours, others)
    assert found["p"] == pytest.approx(p)
    assert found["difference"] == pytest.approx(only_one / len(ours))


@given(outcomes=OUTCOMES)
def test_an_interval_holds_its_difference_and_turns_its_sign_with_the_methods(outcomes):
    ours, others = zip(*outcomes, strict=True)
    found, turned = statistics.compare_shares(ours, others), statistics.compare_shares(others, ours)
    low, high = found["interval"]
    assert -1 <= low <= found["difference"] <= high <= 1
    assert high - low > 0.05
    assert found["difference"] == pytest.approx(-turned["difference"])
    assert found["p"] == pytest.approx(turned["p"])


def test_without_correlation_the_interval_of_a_difference_adds_the_squares_of_both():
    """Newcombe (1998), method 10, where one method always succeeds."""
    ours, others = [True] * 20, [True] * 15 + [False] * 5
    (low, _), (other_low, other_high) = statistics.share_interval(20, 20), statistics.share_interval(15, 20)
    found = statistics.compare_shares(ours, others)["interval"]
    assert found[0] == pytest.approx(0.25 - np.hypot(1 - low, other_high - 0.75))
    assert found[1] == pytest.approx(0.25 + 0.75 - other_low)


def test_tasks_that_are_hard_for_both_narrow_the_interval_of_their_difference():
    ours = [True] * 10 + [False] * 10
    alike, unlike = ours, [*ours[5:], *ours[:5]]
    widths = [np.ptp(statistics.compare_shares(ours, others)["interval"]) for others in (alike, unlike)]
    assert widths[0] < 0.7 * widths[1]
    rng = np.random.default_rng(1)
    tasks = rng.normal(0, 10, 200)
    low, high = statistics.compare_means(list(tasks + rng.normal(1, 0.1, 200)), list(tasks))["interval"]
    assert 0.9 < low < 1 < high < 1.1


def test_holm_corrects_for_the_number_of_tests():
    assert statistics.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert statistics.holm([0.5, 0.9]) == [1.0, 1.0]
    assert statistics.holm([]) == []
