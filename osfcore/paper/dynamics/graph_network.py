"""The paper's graph network (eq. 7): propagation with one shared edge encoder and propagator.

After Li et al. 2019, "Propagation networks for model-based control under partial observation", as the paper says. With
node features x_i (pose, action, embedding of the name), receiver i, sender j and h^0 = 0:

    c_i = E_node(x_i),    c_ij = E_edge(x_i, x_j)
    e^l_ij = P_edge(c_ij, h^{l-1}_i, h^{l-1}_j)
    h^l_i  = P_node(c_i, h^{l-1}_i, sum_j A_ij e^l_ij)
    change of pose_i = D(c_i, h^L_i)

The encoders have two layers and D has one before the answer; P_edge and P_node have one each, as there, with a shortcut
from h^{l-1} to h^l. The same weights serve all objects, edges and propagation steps. Number and width of the layers are
our choice, since the paper's appendix is not public; so is that the answer is a change of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import relu

from osfcore.paper.dynamics.graph import NODE_FEATURES, POSE, UNKNOWN

EMBEDDING = 16  # numbers that are learned for each name


class GraphNetwork(nn.Module):
    """From pose, action and name of the nodes of a graph to the change of their poses.

    A layer on several inputs is told as a sum of layers on each: what a node tells is then not computed again for each
    of its edges, nor what an edge tells again in each step.

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
        self.node_encoder = nn.ModuleList([nn.Linear(features, hidden), nn.Linear(hidden, hidden)])
        self.edge_encoder_receiver = nn.Linear(features, hidden)
        self.edge_encoder_sender = nn.Linear(features, hidden, bias=False)
        self.edge_encoder_last = nn.Linear(hidden, hidden)
        self.edge_propagator_relation = nn.Linear(hidden, hidden)
        self.edge_propagator_receiver = nn.Linear(hidden, hidden, bias=False)
        self.edge_propagator_sender = nn.Linear(hidden, hidden, bias=False)
        self.node_propagator_own = nn.Linear(hidden, hidden)
        self.node_propagator_state = nn.Linear(hidden, hidden, bias=False)
        self.node_propagator_effect = nn.Linear(hidden, hidden, bias=False)
        self.decoder = nn.Linear(2 * hidden, hidden)
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
        own = nodes
        for layer in self.node_encoder:
            own = relu(layer(own))
        relation = self.edge_propagator_relation(self._encoded_edges(nodes))
        told = self.node_propagator_own(own)
        is_edge = adjacency[:, :, None].to(own.dtype)  # (B, A, 1, A)
        state = torch.zeros_like(own)
        for _ in range(self.steps):
            receiver, sender = self.edge_propagator_receiver(state), self.edge_propagator_sender(state)
            effects = relu(relation + receiver[:, :, None] + sender[:, None])
            effect = (is_edge @ effects)[:, :, 0]
            state = relu(state + told + self.node_propagator_state(state) + self.node_propagator_effect(effect))
        return self.answer(relu(self.decoder(torch.cat([own, state], dim=2))))

    def _encoded_edges(self, nodes: Float[Tensor, "B A X"]) -> Float[Tensor, "B A A H"]:
        receiver, sender = self.edge_encoder_receiver(nodes), self.edge_encoder_sender(nodes)
        return relu(self.edge_encoder_last(relu(receiver[:, :, None] + sender[:, None])))
