import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.world.collect_pushes import SUBSTATES
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

speeds = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), min_size=1, max_size=20)
starts = st.tuples(st.floats(-PUSHER_REACH_M, PUSHER_REACH_M), st.floats(-PUSHER_REACH_M, PUSHER_REACH_M))


@given(start=starts, velocity=speeds)
def test_it_goes_where_it_is_told_and_never_beyond_its_reach(start, velocity):
    velocity = np.array(velocity)
    path = pusher_path(np.array(start), velocity)
    assert path.shape == (SUBSTEPS * len(velocity) + 1, 2)
    np.testing.assert_array_equal(path[0], start)
    assert np.all(np.abs(path) <= PUSHER_REACH_M)
    told = np.repeat(velocity, SUBSTEPS, axis=0) * STEP_S / SUBSTEPS
    went = np.diff(path, axis=0)
    inside = np.abs(path[1:]) < PUSHER_REACH_M  # per axis: it slides along the border
    np.testing.assert_allclose(went[inside], told[inside], atol=1e-12)
    assert np.all(np.abs(went) <= np.abs(told) + 1e-12)


def test_who_stands_outside_is_not_drawn_in_but_goes_no_farther():
    path = pusher_path(np.array([0.4, 0.0]), np.array([[0.3, 0.0], [-0.3, 0.0]]))
    np.testing.assert_allclose(path[: SUBSTEPS + 1, 0], 0.4, atol=1e-12)
    assert path[-1, 0] == pytest.approx(0.34)


def test_many_sequences_at_once():
    velocity = np.random.default_rng(0).uniform(-0.3, 0.3, (7, 5, 2))
    together = pusher_path(np.array([0.3, -0.3]), velocity)
    for k in range(7):
        np.testing.assert_array_equal(together[k], pusher_path(np.array([0.3, -0.3]), velocity[k]))
    beginnings = np.random.default_rng(1).uniform(-0.3, 0.3, (7, 2))
    np.testing.assert_array_equal(pusher_path(beginnings, velocity)[:, 0], beginnings)


def test_it_is_the_way_of_the_simulated_pusher(library):
    world = Tabletop(library, request=SceneRequest(names=("009_gelatin_box",)))
    world.arrange(0)
    first = world.truth().pusher
    velocity = np.random.default_rng(2).uniform(-0.3, 0.3, (25, 2))
    velocity[5:9] = [0.3, 0.1]  # to the border and along it
    places = [first]
    for action in velocity:
        world.act(np.array([*action, 0.0]))
        places.append(world.truth().pusher)
    world.close()
    path = pusher_path(first[:2], velocity)[::SUBSTEPS]
    np.testing.assert_allclose(path, np.array(places)[:, :2], atol=1e-6)


def test_its_substeps_are_those_that_are_recorded():
    assert SUBSTEPS == SUBSTATES
