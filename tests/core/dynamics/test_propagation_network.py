import pytest
import torch

from osfcore.dynamics.graph import EDGE_FEATURES, MOTION, NODE_FEATURES, PropagationNetwork
from tests.core.dynamics.scenes import network


def graph(nodes: int = 6, pushed: int = 2, pairs: int = 8, seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    receiver = torch.randint(nodes, (pushed + pairs,), generator=g)
    return (
        torch.randn(nodes, NODE_FEATURES, generator=g),
        torch.randn(pushed + pairs, EDGE_FEATURES, generator=g),
        receiver,
        torch.randint(nodes, (pairs,), generator=g),
    )


@pytest.mark.parametrize("seed", range(3))
def test_permuting_nodes_permutes_the_answer(seed):
    nodes, edges, receiver, sender = graph(seed=seed)
    order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
    place = order.argsort()  # where each node went
    answer = network()(nodes, edges, receiver, sender)
    torch.testing.assert_close(
        network()(nodes[order], edges, place[receiver], place[sender]), answer[order], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_edges_does_not_matter(seed):
    nodes, edges, receiver, sender = graph(seed=seed)
    g = torch.Generator().manual_seed(seed)
    pushed, pairs = torch.randperm(2, generator=g), torch.randperm(8, generator=g)
    order = torch.cat([pushed, 2 + pairs])
    answer = network()(nodes, edges, receiver, sender)
    other = network()(nodes, edges[order], receiver[order], sender[pairs])
    torch.testing.assert_close(other, answer, atol=1e-5, rtol=0)


def test_graphs_side_by_side_do_not_disturb_each_other():
    one, other = graph(seed=1), graph(nodes=3, pushed=1, pairs=2, seed=2)
    (nodes, edges, receiver, sender), (nodes2, edges2, receiver2, sender2) = one, other
    both = network()(
        torch.cat([nodes, nodes2]),
        torch.cat([edges[:2], edges2[:1], edges[2:], edges2[1:]]),
        torch.cat([receiver[:2], receiver2[:1] + 6, receiver[2:], receiver2[1:] + 6]),
        torch.cat([sender, sender2 + 6]),
    )
    torch.testing.assert_close(both, torch.cat([network()(*one), network()(*other)]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_effects_travel_one_edge_a_step(steps):
    """A chain 0 -> 1 -> 2 -> 3: what changes at 0 is felt as far as the steps go."""
    torch.manual_seed(0)
    net = PropagationNetwork(16, steps).eval()
    nodes, edges, _, _ = graph(4, 0, 3)
    sender, receiver = torch.tensor([0, 1, 2]), torch.tensor([1, 2, 3])
    other = nodes.clone()
    other[0] += 1
    with torch.inference_mode():
        changed = (net(other, edges, receiver, sender) - net(nodes, edges, receiver, sender)).abs().amax(dim=1)
    assert (changed > 0).tolist() == [k <= steps for k in range(4)]


@pytest.mark.parametrize(("nodes", "pushed", "pairs"), [(1, 1, 0), (1, 0, 0), (5, 0, 4), (0, 0, 0)])
def test_any_number_of_nodes_and_edges(nodes, pushed, pairs):
    g = graph(max(nodes, 1), pushed, pairs)
    answer = network()(g[0][:nodes], *g[1:])
    assert answer.shape == (nodes, MOTION)
    assert torch.isfinite(answer).all()


def test_every_parameter_learns():
    net = network()
    net(*graph()).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_the_same_seed_makes_the_same_network():
    first, second = network(3).state_dict(), network(3).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
