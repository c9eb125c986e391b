import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.planning.paths import CLEARANCE_M
from osfcore.planning.pushes import straight_pushes

angle = st.floats(-np.pi, np.pi)
half = st.floats(0.01, 0.1)
seeds = st.integers(0, 10**6)


def turned(points, by: float) -> np.ndarray:
    c, s = np.cos(by), np.sin(by)
    return points @ np.array([[c, s], [-s, c]])


def box(length: float, width: float) -> np.ndarray:
    """Points all around a box, given by half its sides."""
    at = np.linspace(-1, 1, 41)
    sides = [np.stack([at, np.full(41, s)], axis=1) for s in (-1, 1)]
    return np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * [length, width]


def offset_of(direction: float, distance: float) -> np.ndarray:
    return distance * np.array([np.cos(direction), np.sin(direction)])


@given(length=half, width=half, direction=angle, by=angle, distance=st.floats(0.005, 0.3), seed=seeds)
def test_pushes_begin_clear_of_the_object_and_lead_through_it(length, width, direction, by, distance, seed):
    outline = turned(box(length, width), by)
    pushes = straight_pushes(outline, offset_of(direction, distance), 20, np.random.default_rng(seed))
    gaps = np.linalg.norm(np.maximum(np.abs(turned(pushes.starts, -by)) - [length, width], 0), axis=1)
    assert gaps.min() > PUSHER_RADIUS_M + CLEARANCE_M
    along = pushes.ends - pushes.starts
    lengths = np.linalg.norm(along, axis=1)
    side = np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths[:, None]
    across = outline @ side.T - (pushes.starts * side).sum(axis=1)
    assert (across.min(axis=0) < 1e-9).all()
    assert (across.max(axis=0) > -1e-9).all()
    assert (lengths > CLEARANCE_M + 0.6 * distance).all()
    assert (lengths < CLEARANCE_M + 0.005 + 1.15 * distance).all()


@given(length=half, width=half, direction=angle, by=angle, distance=st.floats(0.005, 0.3))
def test_without_chance_a_push_leads_straight_through_the_middle(length, width, direction, by, distance):
    middle, offset = np.array([0.1, -0.05]), offset_of(direction, distance)
    pushes = straight_pushes(middle + turned(box(length, width), by), offset, 3, None)
    unit = offset / distance
    for ends in (pushes.starts, pushes.ends):
        np.testing.assert_allclose((ends - middle) @ [-unit[1], unit[0]], 0, atol=1e-9)
        np.testing.assert_array_equal(ends, np.broadcast_to(ends[0], (3, 2)))
    went = (pushes.ends - pushes.starts) @ unit
    np.testing.assert_allclose(went, distance + CLEARANCE_M, atol=0.005)


def test_a_push_of_a_box_ends_where_its_near_side_should_be():
    pushes = straight_pushes(box(0.05, 0.03), np.array([0.1, 0.0]), 1, None)
    np.testing.assert_allclose(pushes.ends, [[-0.05 - PUSHER_RADIUS_M + 0.1, 0.0]], atol=1e-12)


@given(by=angle, direction=angle, seed=seeds)
def test_pushes_turn_with_the_scene(by, direction, seed):
    outline, offset = turned(box(0.08, 0.04), 0.3), offset_of(direction, 0.1)
    pushes = straight_pushes(outline, offset, 5, np.random.default_rng(seed))
    other = straight_pushes(turned(outline, by), turned(offset, by), 5, np.random.default_rng(seed))
    np.testing.assert_allclose(other.ends - other.starts, turned(pushes.ends - pushes.starts, by), atol=1e-6)


@pytest.mark.parametrize("part", ["starts", "ends"])
def test_the_same_seed_gives_the_same_pushes(part):
    a, b, c = (
        getattr(straight_pushes(box(0.05, 0.03), np.array([0.1, 0.02]), 8, np.random.default_rng(seed)), part)
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).min() > 0
