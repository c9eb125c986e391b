"""The paper's graph network (eq. 7): propagation with one shared edge encoder and propagator.

After Li et al. 2019, "Propagation networks for model-based control under partial observation", as the paper says. With
node features x_i (pose, action, embedding of the name), receiver i, sender j and h^0 = 0:

    c_i = E_node(x_i),    c_ij = E_edge(x_i, x_j)
    e^l_ij = P_edge(c_ij, h^{l-1}_i, h^{l-1}_j)
    h^l_i  = h^{l-1}_i + P_node(c_i, h^{l-1}_i, sum_j A_ij e^l_ij)
    change of pose_i = D(c_i, h^L_i)

The same weights serve all objects, edges and propagation steps. Number and width of the layers are our choice, since
the paper's appendix is not public; so is that the answer is a change of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from osfcore.paper.dynamics.graph import NODE_FEATURES, POSE, UNKNOWN

EMBEDDING = 16  # numbers that are learned for each name


class GraphNetwork(nn.Module):
    """From pose, action and name of the nodes of a graph to the change of their poses.

    Args:
        names: of the objects that it knows, which have the numbers 2, 3, ...; all others have the number 0 and the
            embedding zero.
        hidden: width of all layers.
        steps: L, propagation steps.
    """

    def __init__(self, names: Sequence[str], hidden: int = 128, steps: int = 3) -> None:
        super().__init__()
        self.names, self.hidden, self.steps = tuple(names), hidden, steps
        features = NODE_FEATURES + EMBEDDING
        self.embedding = nn.Embedding(len(self.names) + 2, EMBEDDING, padding_idx=UNKNOWN)
        self.node_encoder = _Layers((features,), hidden)
        self.edge_encoder = _Layers((features, features), hidden)
        self.edge_propagator = _Layers((hidden, hidden, hidden), hidden)
        self.node_propagator = _Layers((hidden, hidden, hidden), hidden)
        self.decoder = _Layers((hidden, hidden), hidden)
        self.answer = nn.Linear(hidden, POSE)
        nn.init.zeros_(self.answer.weight)  # before anything is learned, nothing moves
        nn.init.zeros_(self.answer.bias)

    def number(self, name: str) -> int:
        """What a node of that name is called in `forward`."""
        return self.names.index(name) + 2 if name in self.names else UNKNOWN

    def forward(
        self, features: Float[Tensor, "B A F"], number: Int[Tensor, "B A"], adjacency: Bool[Tensor, "B A A"]
    ) -> Float[Tensor, "B A 7"]:
        """The change of position (in units of `graph.LENGTH_M`) and quaternion of every node.

        Args:
            features: pose and action of the nodes.
            number: what each of them is.
            adjacency: receiver i, sender j.
        """
        nodes = torch.cat([features, self.embedding(number)], dim=2)
        own = self.node_encoder(nodes)
        relation = self.edge_encoder(nodes[:, :, None], nodes[:, None])
        is_edge = adjacency[..., None].to(own.dtype)
        state = torch.zeros_like(own)
        for _ in range(self.steps):
            effect = self.edge_propagator(relation, state[:, :, None], state[:, None])
            state = state + self.node_propagator(own, state, (is_edge * effect).sum(dim=2))
        return self.answer(self.decoder(own, state))


class _Layers(nn.Module):
    """Two layers on several inputs that are put together; each has a matrix of its own, so that all are broadcast.

    This is a layer on their concatenation, but what only a node tells is not computed again for each of its edges.
    """

    def __init__(self, inputs: tuple[int, ...], hidden: int) -> None:
        super().__init__()
        whole = nn.Linear(sum(inputs), hidden)  # initialised as a layer on the concatenation is
        self.weights = nn.ParameterList(part.clone() for part in whole.weight.detach().split(inputs, dim=1))
        self.bias = nn.Parameter(whole.bias.detach().clone())
        self.last = nn.Linear(hidden, hidden)

    def forward(self, *inputs: Tensor) -> Tensor:
        parts = [functional.linear(x, w) for x, w in zip(inputs, self.weights, strict=True)]
        return functional.relu(self.last(functional.relu(sum(parts[1:], parts[0]) + self.bias)))
