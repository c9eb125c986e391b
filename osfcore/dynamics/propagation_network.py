"""The propagation network: message passing with shared encoders and propagators (paper eq. 7).

After Li et al. 2019, "Propagation networks for model-based control under partial observation". With node features x_i
and edge features r_ij, receiver i and sender j, and h^0_i = E_node(x_i), e^0_ij = E_edge(r_ij):

    e^{l+1}_ij = e^l_ij + P_edge^l(e^l_ij, h^l_i, h^l_j)
    h^{l+1}_i  = h^l_i + P_node^l(h^0_i, h^l_i, sum_j e^{l+1}_ij)
    motion_i   = D(h^0_i, h^L_i)
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from osfcore.dynamics.features import EDGE_FEATURES, NODE_FEATURES

MOTION = 6  # displacement of the centre of mass, rotation vector


class PropagationNetwork(nn.Module):
    """From the features of a graph to the motion of its nodes, in units of the features' scales.

    Deviation from Li et al.: every step has propagators of its own, and edges have a state; for the same time, both
    are more accurate.

    Args:
        hidden: width of all layers.
        steps: L, propagation steps.
    """

    def __init__(self, hidden: int = 128, steps: int = 3) -> None:
        super().__init__()
        self.hidden, self.steps = hidden, steps
        self.node_encoder = _two_layers(NODE_FEATURES, hidden)
        self.edge_encoder = _two_layers(EDGE_FEATURES, hidden)
        self.edge_propagators = nn.ModuleList(_two_layers(3 * hidden, hidden) for _ in range(steps))
        self.node_propagators = nn.ModuleList(_two_layers(3 * hidden, hidden) for _ in range(steps))
        self.decoder = nn.Sequential(
            *(nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU()), nn.Linear(hidden, MOTION)
        )

    def forward(
        self,
        nodes: Float[Tensor, "A F"],
        edges: Float[Tensor, "E G"],
        receiver: Int[Tensor, "E"],
        sender: Int[Tensor, "S"],
    ) -> Float[Tensor, "A 6"]:
        """The motion of each node.

        Args:
            nodes: features of the objects.
            edges: features of the edges: first those from the pusher, then those between objects.
            receiver: object at the end of each edge.
            sender: object at the beginning of each of the last S edges; the pusher has no state of its own.
        """
        own = self.node_encoder(nodes)
        relation = self.edge_encoder(edges)
        state = own
        silent = own.new_zeros(len(receiver) - len(sender), self.hidden)
        for edge_propagator, node_propagator in zip(self.edge_propagators, self.node_propagators, strict=True):
            senders = torch.cat([silent, state[sender]])
            relation = relation + edge_propagator(torch.cat([relation, state[receiver], senders], dim=1))
            effect = torch.zeros_like(own).index_add(0, receiver, relation)
            state = state + node_propagator(torch.cat([own, state, effect], dim=1))
        return self.decoder(torch.cat([own, state], dim=1))


def _two_layers(inputs: int, hidden: int) -> nn.Sequential:
    """Normalised at the end: without it, training needs about twice as long for the same error."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.LayerNorm(hidden))
