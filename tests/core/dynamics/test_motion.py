import numpy as np
import pytest
import torch

from osfcore.dynamics.motion import SLEEP_M, SLEEP_RAD, Motion, going_on, headings, lowest_point, sleeping
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.poses import quaternion_exp, rotate
from tests.core.dynamics.scenes import NAMES, crowd, hull, start


def still(count: int = 2, scenes: int = 1) -> Motion:
    zero = torch.zeros(scenes, count, 3)
    quaternion = torch.tensor([1.0, 0, 0, 0]).expand(scenes, count, 4)
    return Motion(zero, quaternion, zero, zero, torch.zeros(scenes, 2), torch.zeros(scenes, count))


@pytest.mark.parametrize("number", range(4))
def test_lowest_point_stands_on_the_table_it_was_put_on(shapes, table, number):
    points = hull(shapes[NAMES[number]])
    q = quaternion_exp(np.random.default_rng(number).normal(size=(50, 3)))
    low = np.array([rotate(one, points)[:, 2].min() for one in q])
    centre = np.zeros((50, 3))
    centre[:, 2] = 0.01 - low
    heights = lowest_point(
        table,
        torch.full((50,), number),
        torch.as_tensor(centre, dtype=torch.float32),
        torch.as_tensor(q, dtype=torch.float32),
    )
    assert heights.min() > 0.01 - 1e-6  # of a point of the object
    assert heights.median() < 0.01 + 3e-4


def test_floor_is_the_table_or_what_was_lower(shapes, table):
    _, motion = start(table, shapes, crowd(shapes))
    assert motion.floor.max() <= 0
    assert motion.floor.min() > -5e-4


def test_heading_is_that_of_the_velocity():
    velocity = torch.tensor([[0.3, 0.0], [0.0, -0.2], [-0.06, 0.08]])
    found = headings(velocity, still(scenes=3))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0], [0, -1], [-0.6, 0.8]]))


def test_where_the_pusher_stands_still_the_fastest_object_leads():
    motion = still(3)._replace(linear=torch.tensor([[[0.001, 0, 0.0], [0.0, -0.003, 0.1], [0.0, 0, 0.5]]]))
    torch.testing.assert_close(headings(torch.zeros(1, 2), motion), torch.tensor([[0.0, -1.0]]))


def test_where_nothing_moves_any_heading_serves():
    found = headings(torch.zeros(2, 2), still(scenes=2))
    torch.testing.assert_close(found.norm(dim=1), torch.ones(2))


def test_headings_turn_with_the_scene():
    generator = torch.Generator().manual_seed(0)
    velocity, linear = torch.randn(20, 2, generator=generator), torch.randn(20, 4, 3, generator=generator)
    velocity[::2] = 0
    c, s = np.cos(0.7), np.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    before = headings(velocity, still(4, 20)._replace(linear=linear))
    after = headings(velocity @ turn[:2, :2].T, still(4, 20)._replace(linear=linear @ turn.T))
    torch.testing.assert_close(after, before @ turn[:2, :2].T)


@pytest.mark.parametrize("share", [0.0, 0.99, 1.01])
@pytest.mark.parametrize("axis", range(3))
def test_only_what_hardly_moves_rests(share, axis):
    linear, angular = torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)
    linear[0, 0, axis], angular[0, 1, axis] = share * SLEEP_M, share * SLEEP_RAD
    linear[0, 2, axis], angular[0, 2, axis] = 2 * SLEEP_M, 0.1 * SLEEP_RAD
    rested = sleeping(still(3)._replace(linear=linear, angular=angular))
    kept = float(share > 1)
    torch.testing.assert_close(rested.linear[0, 0], kept * linear[0, 0])
    torch.testing.assert_close(rested.angular[0, 1], kept * angular[0, 1])
    torch.testing.assert_close(rested.linear[0, 2], linear[0, 2])  # who moves keeps his slow turn
    torch.testing.assert_close(rested.angular[0, 2], angular[0, 2])


def test_velocities_are_means_over_the_action_before(shapes, table):
    _, now = start(table, shapes, crowd(shapes))
    turn = torch.tensor([0.0, 0.0, -0.4])
    before = now._replace(
        centre=now.centre - torch.tensor([0.02, 0.0, 0.0]),
        quaternion=rotations.multiply(rotations.exponential(turn).expand_as(now.quaternion), now.quaternion),
    )
    moving = going_on(before, now)
    torch.testing.assert_close(moving.linear, torch.tensor([0.005, 0.0, 0.0]).expand_as(now.linear), atol=1e-6, rtol=0)
    torch.testing.assert_close(moving.angular, -turn.expand_as(now.angular) / 4, atol=1e-6, rtol=0)
    assert torch.equal(moving.centre, now.centre)
    still = going_on(now._replace(centre=now.centre + 1e-4), now)
    assert not still.linear.any()
    assert not still.angular.any()
