import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, STEP_S
from osfcore.planning.paths import CELL_M, CLEARANCE_M, FreeSpace, actions_along, duration_s

BOX = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
place = st.floats(-0.3, 0.3)


def along(way, count: int = 400) -> np.ndarray:
    """Points all along a way."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.linspace(0, length[-1], count)
    return np.stack([np.interp(at, length, way[:, axis]) for axis in range(2)], axis=1)


def length_of(way) -> float:
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def distance_to_box(points) -> np.ndarray:
    return np.linalg.norm(np.maximum(np.abs(points) - [0.05, 0.03], 0), axis=1)


def test_on_an_empty_table_ways_are_straight():
    start, ends = np.array([-0.2, 0.1]), np.array([[0.3, 0.05], [-0.2, 0.1], [0.0, -0.3]])
    ways = FreeSpace([]).paths_from(start)
    for end in ends:
        way = ways.to(end)
        np.testing.assert_array_equal(way[[0, -1]], [start, end])
        assert length_of(way) == pytest.approx(np.linalg.norm(end - start))


@given(x=place, y=place, u=place, v=place)
def test_ways_go_around_what_stands_in_them(x, y, u, v):
    space = FreeSpace([BOX])
    start, end = np.array([x, y]), np.array([u, v])
    if not space.is_free(np.stack([start, end])).all():
        return
    way = space.paths_from(start).to(end)
    assert distance_to_box(along(way)).min() > PUSHER_RADIUS_M + CLEARANCE_M - 2 * CELL_M
    assert length_of(way) < np.linalg.norm(end - start) + 0.25


def test_from_a_place_in_contact_a_way_leads_out():
    space = FreeSpace([BOX])
    start = np.array([0.0, 0.03 + PUSHER_RADIUS_M])
    beyond_reach = np.array([[0.36, 0.0], [0.0, -0.4]])
    assert not space.is_free(np.vstack([start, beyond_reach])).any()
    way = space.paths_from(start).to(np.array([0.0, -0.2]))
    points = along(way)
    inside = distance_to_box(points) < PUSHER_RADIUS_M - CELL_M
    assert not inside.any()


@given(seed=st.integers(0, 10**6), horizon=st.integers(1, 20))
def test_actions_keep_the_limits_and_lead_along_the_way(seed, horizon):
    rng = np.random.default_rng(seed)
    way = rng.uniform(-0.3, 0.3, (rng.integers(2, 6), 2))
    speeds = rng.uniform(0.2, 1, len(way) - 1)
    actions = actions_along(way, horizon, speeds)
    assert actions.shape == (horizon, 3)
    assert np.abs(actions).max() <= MAX_SPEED_M_S + 1e-9
    assert (actions[:, 2] == 0).all()
    reached = way[0] + STEP_S * np.cumsum(actions[:, :2], axis=0)
    for point in reached:
        assert np.linalg.norm(along(way, 4000) - point, axis=1).min() < 1e-3


def test_actions_take_as_long_as_the_slower_axis_and_then_rest():
    actions = actions_along(np.array([[0.0, 0.0], [0.12, 0.03]]), 4)
    np.testing.assert_allclose(actions[:2], [[0.3, 0.075, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(actions[2:], 0, atol=1e-12)
    half = actions_along(np.array([[0.0, 0.0], [0.12, 0.03]]), 4, np.array([0.5]))
    np.testing.assert_allclose(half, [[0.15, 0.0375, 0]] * 4, atol=1e-12)
    way, speeds = np.array([[0.0, 0.0], [0.12, 0.03], [0.12, -0.06]]), np.array([0.5, 0.25])
    assert duration_s(way) == pytest.approx((0.12 + 0.09) / MAX_SPEED_M_S)
    assert duration_s(way, speeds) == pytest.approx((0.12 / 0.5 + 0.09 / 0.25) / MAX_SPEED_M_S)


@given(seed=st.integers(0, 10**6))
def test_actions_pass_every_corner_nearby_and_end_no_sooner_than_said(seed):
    rng = np.random.default_rng(seed)
    way = rng.uniform(-0.3, 0.3, (rng.integers(2, 6), 2))
    speeds = rng.uniform(0.2, 1, len(way) - 1)
    least = int(np.ceil(duration_s(way, speeds) / STEP_S - 1e-9))
    actions = actions_along(way, least + len(way), speeds)
    reached = np.vstack([way[0], way[0] + STEP_S * np.cumsum(actions[:, :2], axis=0)])
    gaps = np.linalg.norm(along(reached, 20_000)[:, None] - way, axis=2).min(axis=0)
    assert gaps.max() < 0.012 + 1e-3
    np.testing.assert_allclose(reached[-1], way[-1], atol=1e-9)
    assert least < 2 or np.linalg.norm(reached[least - 1] - way[-1]) > 0
