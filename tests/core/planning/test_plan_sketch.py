import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from osfcore.geometry.rollouts import Rollouts
from osfcore.planning.mppi import WAYS, PlanRound, sketch_of


def planned(costs, horizon=3):
    """A round in which sequence k has the pusher at x = k."""
    count = len(costs)
    pusher = np.zeros((count, horizon + 1, 3))
    pusher[..., 0] = np.arange(count)[:, None]
    turns = np.tile([1.0, 0, 0, 0], (count, horizon + 1, 1, 1))
    futures = Rollouts(("box",), pusher[:, :, None], turns, pusher)
    return PlanRound(0, np.zeros((horizon, 3)), futures, np.array(costs, float))


@given(costs=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=200))
def test_a_few_ways_stand_for_all_from_the_cheapest_to_the_dearest(costs):
    sketch = sketch_of(7, planned(costs))
    assert sketch.step == 7
    assert sketch.ways.shape == (min(WAYS, len(costs)), 4, 2)
    assert list(sketch.costs) == sorted(sketch.costs)
    assert (sketch.costs[0], sketch.costs[-1]) == (min(costs), max(costs) if len(costs) > 1 else min(costs))
    shown = sketch.ways[:, 0, 0].astype(int)
    assert len(set(shown)) == len(shown)
    np.testing.assert_array_equal(np.array(costs)[shown], sketch.costs)


@given(costs=st.lists(st.integers(0, 50), min_size=1, max_size=60))
def test_the_best_future_is_the_first_of_the_ways(costs):
    sketch = sketch_of(0, planned(costs))
    assert sketch.best.pusher.shape == (1, 4, 3)
    np.testing.assert_array_equal(sketch.best.pusher[0, :, :2], sketch.ways[0])
    assert costs[int(sketch.best.pusher[0, 0, 0])] == min(costs)


def test_a_sketch_of_a_large_plan_is_small():
    sketch = sketch_of(0, planned(np.random.default_rng(0).random(5000), horizon=30))
    assert sketch.ways.nbytes + sketch.best.positions.nbytes < 20_000
