import pytest
import torch

from osfcore.paper.dynamics import GraphNetwork, squared_error, unroll
from tests.core.paper.dynamics.scenes import NAMES, in_units, network, scenes

NUMBER, KAPPA = torch.tensor([[2, 3, 0]] * 4), torch.tensor([[0.1, 0.2, 0.05]] * 4)


def rolled(net, given, *, number=NUMBER, kappa=KAPPA, steps=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    actions = torch.rand(4, steps, 3, generator=g) * 0.6 - 0.3
    pusher = torch.cat([given.pusher[:, None], torch.rand(4, steps, 3, generator=g)], dim=1)
    with torch.inference_mode():
        return list(unroll(net, number, kappa, given, actions, pusher)), pusher


def test_quaternions_stay_unit_and_the_pusher_goes_its_way():
    found, pusher = rolled(network(), scenes(4, 3), steps=20)
    assert len(found) == 20
    for step, after in enumerate(found, start=1):
        torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(4, 3))
        torch.testing.assert_close(after.pusher, pusher[:, step])


def test_what_has_learned_nothing_moves_nothing():
    given = scenes(4, 3)
    for after in rolled(GraphNetwork(NAMES, 8), given)[0]:
        torch.testing.assert_close(after.position, given.position)
        cosine = (after.quaternion * given.quaternion).sum(dim=-1).abs()
        torch.testing.assert_close(cosine, torch.ones_like(cosine))


def test_a_quaternion_and_its_opposite_move_the_same_way():
    given = scenes(4, 3)
    one, other = (rolled(network(), g)[0][-1] for g in (given, given._replace(quaternion=-given.quaternion)))
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 0, 1], [2, 1, 0]])
def test_the_order_of_objects_does_not_matter(order):
    given = scenes(4, 3)
    other = given._replace(position=given.position[:, order], quaternion=given.quaternion[:, order])
    here = rolled(network(), given)[0][-1]
    there = rolled(network(), other, number=NUMBER[:, order], kappa=KAPPA[:, order])[0][-1]
    torch.testing.assert_close(there.position, here.position[:, order], atol=1e-5, rtol=0)
    torch.testing.assert_close(there.quaternion, here.quaternion[:, order], atol=1e-5, rtol=0)


def test_what_objects_are_called_and_how_long_they_are_matters():
    given, net = scenes(4, 3), network()
    plain = rolled(net, given)[0][0]
    assert (rolled(net, given, number=NUMBER[:, [1, 0, 2]])[0][0].position != plain.position).any()
    assert (rolled(net, given, kappa=0 * KAPPA)[0][0].position != plain.position).any()


def test_the_loss_is_the_squared_error_summed_across_objects():
    given = scenes(4, 3)
    assert squared_error(given, given.position, given.quaternion) == 0
    assert squared_error(given, given.position, -given.quaternion) == 0  # the same orientations
    shifted = given.position + torch.tensor([0.03, 0.0, 0.04])
    expected = torch.tensor(3 * in_units(0.05) ** 2)
    torch.testing.assert_close(squared_error(given, shifted, given.quaternion), expected)
    still = torch.zeros(1, 1, 3)
    upright, turned = torch.tensor([[[1.0, 0, 0, 0]]]), torch.tensor([[[0.0, 0, 0, 1.0]]])  # half a turn apart
    begin = scenes(1, 1)._replace(position=still, quaternion=upright)
    torch.testing.assert_close(squared_error(begin, still, turned), torch.tensor(2.0))
