import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.experiments.harness import compare_means, compare_shares, holm, mean_interval, share_interval

OUTCOMES = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=2, max_size=30)


def test_the_interval_of_a_share_is_wilsons():
    # By Wilson (1927), with z = 1.96: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    n, p, z = 20, 0.95, 1.959964
    middle, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    expected = np.array([middle - half, middle + half]) / (1 + z**2 / n)
    assert share_interval(19, 20) == pytest.approx(expected, abs=1e-6)


@given(tasks=st.integers(1, 200), share=st.floats(0, 1))
def test_a_share_lies_in_its_interval(tasks, share):
    low, high = share_interval(round(share * tasks), tasks)
    assert 0 <= low <= round(share * tasks) / tasks + 1e-9
    assert round(share * tasks) / tasks - 1e-9 <= high <= 1


def test_the_interval_of_a_mean_narrows_with_the_root_of_the_number():
    values = np.random.default_rng(0).normal(5, 1, 1600)
    widths = [np.ptp(mean_interval(values[:count])) for count in (100, 1600)]
    assert widths[0] == pytest.approx(2 * 1.96 / 10, rel=0.25)
    assert widths[0] / widths[1] == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("values", [[3.0], [3.0, 3.0, 3.0]])
def test_values_without_spread_have_no_interval(values):
    assert mean_interval(values) is None
    assert compare_means(values, [0.0] * len(values)) == {"difference": 3.0, "interval": None}


@pytest.mark.parametrize(("only_one", "p"), [(5, 2 / 2**5), (6, 2 / 2**6), (0, 1.0)])
def test_mcnemar_counts_tasks_in_which_one_alone_succeeds(only_one, p):
    ours = [True] * (10 + only_one) + [False] * 10
    others = [True] * 10 + [False] * (10 + only_one)
    found = compare_shares(ours, others)
    assert found["p"] == pytest.approx(p)
    assert found["difference"] == pytest.approx(only_one / len(ours))


@given(outcomes=OUTCOMES)
def test_the_interval_of_a_difference_holds_it_and_is_never_without_width(outcomes):
    ours, others = zip(*outcomes, strict=True)
    found = compare_shares(ours, others)
    low, high = found["interval"]
    assert -1 <= low <= found["difference"] <= high <= 1
    assert high - low > 0.05


def test_without_correlation_the_interval_of_a_difference_adds_the_squares_of_both():
    """Newcombe (1998), method 10, where one method always succeeds."""
    ours, others = [True] * 20, [True] * 15 + [False] * 5
    (low, _), (other_low, other_high) = share_interval(20, 20), share_interval(15, 20)
    found = compare_shares(ours, others)["interval"]
    assert found[0] == pytest.approx(0.25 - np.hypot(1 - low, other_high - 0.75))
    assert found[1] == pytest.approx(0.25 + 0.75 - other_low)


def test_tasks_that_are_hard_for_both_narrow_the_interval_of_their_difference():
    ours = [True] * 10 + [False] * 10
    alike, unlike = ours, [*ours[5:], *ours[:5]]
    widths = [np.ptp(compare_shares(ours, others)["interval"]) for others in (alike, unlike)]
    assert widths[0] < 0.7 * widths[1]


def test_holm_corrects_for_the_number_of_tests():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


@given(outcomes=OUTCOMES)
def test_comparing_the_other_way_round_turns_the_sign(outcomes):
    ours, others = zip(*outcomes, strict=True)
    one, other = compare_shares(ours, others), compare_shares(others, ours)
    assert one["difference"] == pytest.approx(-other["difference"])
    assert one["p"] == pytest.approx(other["p"])


def test_a_paired_difference_is_narrower_than_both_spreads():
    rng = np.random.default_rng(1)
    tasks = rng.normal(0, 10, 200)  # some are hard, some are easy, for both alike
    low, high = compare_means(list(tasks + rng.normal(1, 0.1, 200)), list(tasks))["interval"]
    assert 0.9 < low < 1 < high < 1.1
