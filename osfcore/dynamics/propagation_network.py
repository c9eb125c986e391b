"""The propagation network: one edge encoder and one propagator for whatever objects there are (paper eq. 7).

After Li et al. 2019, "Propagation networks for model-based control under partial observation": edges and nodes are
encoded once, effects travel along the edges several times, and each node's effect is decoded into its motion.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from osfcore.dynamics.features import EDGE_FEATURES, NODE_FEATURES

MOTION = 6  # displacement of the centre of mass, rotation vector


class PropagationNetwork(nn.Module):
    """From the features of a graph to the motion of its nodes, in units of the features' scales.

    Deviation from Li et al.: every step has a propagator of its own, and edges keep what travelled along them; for the
    same time, both are more exact.

    Args:
        hidden: width of all layers.
        steps: how often effects travel along the edges.
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
