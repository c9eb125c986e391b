import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES, Rollouts, check_actions


@given(count=st.integers(1, 5), horizon=st.integers(1, 8), seed=st.integers(0, 10**6))
def test_actions_within_the_limits_come_back_as_they_are(count, horizon, seed):
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 3)) * [1, 1, 0]
    found = check_actions(actions)
    np.testing.assert_array_equal(found, actions)
    np.testing.assert_array_equal(check_actions(actions.tolist()), actions)
    found[:] = 0
    assert actions.any()  # a copy


@pytest.mark.parametrize("shape", [(1, MAX_HORIZON, 3), (MAX_SEQUENCES, 1, 3)])
def test_as_many_as_are_allowed_are_allowed(shape):
    assert check_actions(np.zeros(shape)).shape == shape


@pytest.mark.parametrize("shape", [(1, MAX_HORIZON + 1, 3), (MAX_SEQUENCES + 1, 1, 3), (1, 0, 3), (0, 1, 3)])
def test_more_or_none_are_refused(shape):
    with pytest.raises(InvalidInput, match="between 1 and"):
        check_actions(np.zeros(shape))


@pytest.mark.parametrize("value", [0.3, -0.3, 0.1 + 0.2])
def test_the_limit_itself_is_allowed_with_its_rounding_error(value):
    check_actions([[[value, value, 0.0]]])


@pytest.mark.parametrize("value", [0.31, -0.31, 0.3001, float("nan"), float("inf"), -float("inf"), 1e300])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_first_bad_action_is_named_and_nothing_is_clipped(value, axis):
    actions = np.zeros((4, 5, 3))
    actions[2, 3, axis] = actions[3, 0, axis] = value
    with pytest.raises(InvalidInput, match=r"action 3 of sequence 2 \[m/s\]"):
        check_actions(actions)


@given(count=st.integers(1, 4), objects=st.integers(0, 3), data=st.data())
def test_one_sequence_alone_is_a_future_by_itself(count, objects, data):
    k = data.draw(st.integers(0, count - 1))
    rng = np.random.default_rng(0)
    told = Rollouts(
        tuple("abc"[:objects]), *(rng.normal(size=(count, 5, *rest)) for rest in ((objects, 3), (objects, 4), (3,)))
    )
    alone = told[k]
    assert alone.names == told.names
    for part in ("positions", "quaternions", "pusher"):
        np.testing.assert_array_equal(getattr(alone, part), getattr(told, part)[[k]])


scalars = st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=3) | st.integers()
anything = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner), max_leaves=20
)


@given(value=anything)
def test_whatever_comes_it_is_actions_or_a_clear_error(value):
    try:
        found = check_actions(value)
    except OsfError as error:
        assert len(str(error)) < 600
    else:
        assert found.shape[2] == 3
        assert np.abs(found).max() <= 0.3 + 1e-9


def test_what_is_left_of_futures_begins_later_and_keeps_the_last_state():
    rng = np.random.default_rng(0)
    futures = Rollouts(("a",), rng.normal(size=(2, 4, 1, 3)), rng.normal(size=(2, 4, 1, 4)), rng.normal(size=(2, 4, 3)))
    np.testing.assert_array_equal(futures.after(2).positions, futures.positions[:, 2:])
    np.testing.assert_array_equal(futures.after(2).pusher, futures.pusher[:, 2:])
    np.testing.assert_array_equal(futures.after(9).quaternions, futures.quaternions[:, 3:])
