import copy

import pytest
import torch

from osfcore.dynamics.graph import EDGE_FEATURES, NODE_FEATURES
from osfcore.dynamics.train import Optimizers
from tests.core.dynamics.scenes import network


def graph(seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Twenty objects, half of them pushed, some of them pairs."""
    torch.manual_seed(seed)
    nodes, edges = torch.randn(20, NODE_FEATURES), torch.randn(16, EDGE_FEATURES)
    receiver = torch.cat([torch.arange(10), torch.arange(6)])
    return nodes, edges, receiver, torch.arange(6) + 10


TARGET = graph()[0][:, :6]


def loss_of(model) -> torch.Tensor:
    return (model(*graph()) - TARGET).square().mean()


def down(descent: Optimizers, steps: int, first: int = 0) -> list[float]:
    losses = []
    for done in range(first, first + steps):
        loss = loss_of(descent.network)
        losses.append(float(loss.detach()))
        descent.step(loss, 1.0, done)
    return losses


def test_it_descends_and_its_average_follows():
    descent = Optimizers(network(), 1e-2)
    losses = down(descent, 60)
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        assert float(loss_of(descent.average)) < 0.2 * losses[0]


def test_every_parameter_moves():
    model = network()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    descent = Optimizers(model, 1e-3)
    down(descent, 2)
    for name, value in descent.network.state_dict().items():
        assert not torch.equal(value, before[name]), name


def test_without_a_rate_nothing_moves():
    descent = Optimizers(network(), 1e-2)
    before = {name: value.clone() for name, value in descent.network.state_dict().items()}
    descent.step(loss_of(descent.network), 0.0, 0)
    assert all(torch.equal(value, before[name]) for name, value in descent.network.state_dict().items())


def test_matrices_are_updated_as_much_in_all_their_directions():
    """Muon's mark: the singular values of an update are nearly the same."""
    model = network(hidden=32)
    weight = model.node_encoder[2].weight
    before = weight.detach().clone()
    Optimizers(model, 1e-3).step(loss_of(model), 1.0, 0)
    values = torch.linalg.svdvals(weight.detach() - before)
    assert values[0] < 3 * values[len(values) // 2]


def test_the_average_begins_at_once_and_then_hardly_moves():
    descent = Optimizers(network(), 1e-2)
    down(descent, 1)
    for kept, new in zip(descent.average.parameters(), descent.network.parameters(), strict=True):
        assert torch.equal(kept, new)
    kept = [value.clone() for value in descent.average.parameters()]
    down(descent, 1, first=100_000)
    for old, now, new in zip(kept, descent.average.parameters(), descent.network.parameters(), strict=True):
        torch.testing.assert_close(now, old.lerp(new, 0.002))


@pytest.mark.parametrize("steps", [1, 3])
def test_a_restored_one_goes_on_in_the_same_way(steps):
    whole = Optimizers(network(), 1e-2)
    down(whole, steps)
    state = copy.deepcopy(whole.state())
    other = Optimizers(network(seed=5), 1e-2)
    other.restore(state)
    expected = down(whole, 2, first=steps)
    assert down(other, 2, first=steps) == expected
