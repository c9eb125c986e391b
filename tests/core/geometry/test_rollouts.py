import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts, check_actions
from tests.support.errors import about


@given(count=st.integers(1, 5), horizon=st.integers(1, 8), seed=st.integers(0, 10**6))
def test_actions_within_the_limits_come_back_as_they_are(count, horizon, seed):
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 3)) * [1, 1, 0]
    found = check_actions(actions)
    np.testing.assert_array_equal(found, actions)
    np.testing.assert_array_equal(check_actions(actions.tolist()), actions)
    found[:] = 0
    assert actions.any()  # a copy


def test_counts_and_speeds_at_their_limits_are_allowed_and_others_refused():
    for shape in ((1, MAX_HORIZON, 3), (MAX_SEQUENCES, 1, 3)):
        assert check_actions(np.zeros(shape)).shape == shape
    check_actions([[[0.1 + 0.2, -0.3, 0.0]]])
    for shape in ((1, MAX_HORIZON + 1, 3), (MAX_SEQUENCES + 1, 1, 3), (1, 0, 3), (0, 1, 3)):
        with pytest.raises(InvalidInput):
            check_actions(np.zeros(shape))


@pytest.mark.parametrize("value", [-0.31, 0.3001, float("nan"), float("inf")])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_first_bad_action_is_named_and_nothing_is_clipped(value, axis):
    actions = np.zeros((4, 5, 3))
    actions[2, 3, axis] = actions[3, 0, axis] = value
    with pytest.raises(InvalidInput, check=about("action 3 of sequence 2 [m/s]")):
        check_actions(actions)


def test_futures_are_cut_by_sequence_and_by_time():
    rng = np.random.default_rng(0)
    futures = Rollouts(("a",), rng.normal(size=(2, 4, 1, 3)), rng.normal(size=(2, 4, 1, 4)), rng.normal(size=(2, 4, 3)))
    np.testing.assert_array_equal(futures.after(2).positions, futures.positions[:, 2:])
    np.testing.assert_array_equal(futures.after(2).pusher, futures.pusher[:, 2:])
    np.testing.assert_array_equal(futures.after(9).quaternions, futures.quaternions[:, 3:])
    both = Rollouts.joined([futures[1], futures[0]])
    np.testing.assert_array_equal(both.positions, futures.positions[::-1])
    np.testing.assert_array_equal(both.pusher, futures.pusher[::-1])
