import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts, check_actions
from osfcore.io.scene_file import actions_from_json
from tests.support.errors import about
from tests.support.same import assert_same


@given(count=st.integers(1, 5), horizon=st.integers(1, 8), seed=st.integers(0, 10**6))
def test_actions_within_the_limits_come_back_as_they_are(count, horizon, seed):
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 3)) * [1, 1, 0]
    found = check_actions(actions)
    for same in (found, check_actions(actions.tolist()), actions_from_json({"actions": actions.tolist()})):
        np.testing.assert_array_equal(same, actions)
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
    arrays = [rng.normal(size=shape) for shape in ((2, 4, 1, 3), (2, 4, 1, 4), (2, 4, 3))]
    futures = Rollouts(("a",), *arrays)
    for found, expected in (
        (futures.after(2), [array[:, 2:] for array in arrays]),
        (futures.after(9), [array[:, 3:] for array in arrays]),
        (Rollouts.joined([futures[1], futures[0]]), [array[::-1] for array in arrays]),
    ):
        assert_same(found, Rollouts(("a",), *expected))
