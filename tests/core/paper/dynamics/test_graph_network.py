import pytest
import torch

from osfcore.paper.dynamics import NODE_FEATURES, UNKNOWN, GraphNetwork
from tests.core.paper.dynamics.scenes import BOX, CAN, NAMES, network


def graph(nodes: int = 5, seed: int = 0, share: float = 0.5):
    g = torch.Generator().manual_seed(seed)
    joined = torch.rand(2, nodes, nodes, generator=g) < share
    joined = (joined | joined.transpose(1, 2)) & ~torch.eye(nodes, dtype=torch.bool)
    number = torch.randint(len(NAMES) + 2, (2, nodes), generator=g)
    return torch.randn(2, nodes, NODE_FEATURES, generator=g), number, joined


@pytest.mark.parametrize("seed", range(3))
def test_permuting_nodes_permutes_the_answer(seed):
    features, number, joined = graph(seed=seed)
    order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
    answer = network()(features, number, joined)
    other = network()(features[:, order], number[:, order], joined[:, order][:, :, order])
    torch.testing.assert_close(other, answer[:, order], atol=1e-5, rtol=0)


def test_before_anything_is_learned_nothing_moves():
    assert not GraphNetwork(NAMES, 8)(*graph()).any()


def test_what_is_not_joined_is_not_felt():
    features, number, joined = graph()
    joined[:, 0], joined[:, :, 0] = False, False
    answer = network()(features, number, joined)
    other = network()(torch.cat([features[:, :1] + 1, features[:, 1:]], dim=1), number, joined)
    torch.testing.assert_close(other[:, 1:], answer[:, 1:], atol=0, rtol=0)
    assert (other[:, 0] != answer[:, 0]).any()


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_effects_travel_one_edge_a_step_after_the_first(steps):
    """A chain 0 - 1 - 2 - 3 - 4: what node 0 is told reaches as many nodes as there are steps."""
    features, number, joined = graph(share=0.0)
    for node in range(4):
        joined[:, node, node + 1] = joined[:, node + 1, node] = True
    net = network(steps=steps, hidden=64)
    changed = torch.cat([features[:, :1] + 1, features[:, 1:]], dim=1)
    felt = (net(changed, number, joined) != net(features, number, joined)).any(dim=2).any(dim=0)
    assert felt.tolist() == [node <= steps for node in range(5)]


def test_names_are_numbered_and_unknown_ones_have_no_embedding():
    net = network()
    assert len({net.number(CAN), net.number(BOX), 0, 1}) == 4
    assert net.number("teapot") == UNKNOWN
    assert not net.embedding(torch.tensor(net.number("teapot"))).any()
    assert net.embedding(torch.tensor(net.number(CAN))).any()


def test_the_embedding_of_the_unknown_stays_zero_in_training():
    net = network()
    features, number, joined = graph()
    net(features, torch.zeros_like(number), joined).square().sum().backward()
    assert net.embedding.weight.grad is not None
    assert not net.embedding.weight.grad[UNKNOWN].any()


def test_all_objects_edges_and_steps_share_their_weights():
    def count(names, steps):
        return sum(p.numel() for p in network(names=names, steps=steps).parameters())

    assert count(NAMES, 1) == count(NAMES, 5)
    assert count((*NAMES, "teapot"), 1) == count(NAMES, 1) + 16
