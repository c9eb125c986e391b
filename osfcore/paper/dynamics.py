"""The paper's dynamics model as published: contact graph (eq. 8), graph network (eq. 7), rollouts, weights."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import relu

from osfcore.dynamics.graph import described_sizes, parameter_bytes
from osfcore.dynamics.rollout import check_scene, pusher_centres
from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.io.checkpoint import load_parameters, read_parameters
from osfcore.io.files import write_atomically

# The contact graph (paper eq. 8), with objects and the pusher as nodes, and the features of its nodes.
#
# Node 0 is the pusher, nodes 1 to N are the objects. The input of an object's node is its pose s_t in R^7, as
# published, and which object it is. The paper's appendix with the structure of its network is not public; what
# follows is our reading of the text:
#
# - which object a node is, follows from an embedding that is learned for each name;
# - the pusher is a node as the objects are, with its position, no rotation and the action a_t; that of objects is 0;
# - positions are in units of `LENGTH_M` and actions in units of the highest speed, so that all inputs are of order one;
# - of the two quaternions of an orientation the one with w >= 0 is the input, for they mean the same.
#
# Nothing else is an input: world coordinates, no velocities, no shapes, no contacts.


LENGTH_M = 0.1  # that becomes 1, also in the loss: a centimetre there weighs as much as a turn by 11 deg
POSE, ACTION = 7, 3
NODE_FEATURES = POSE + ACTION
PUSHER_KAPPA_M = max(PUSHER_HEIGHT_M, 2 * PUSHER_RADIUS_M)  # longest axis of the pusher's bounding box
UNKNOWN, PUSHER = 0, 1  # numbers of nodes that are no object with a name; objects have the numbers after these


class Scenes(NamedTuple):
    """Where everything is in B scenes of N objects.

    Attributes:
        position: of the objects [m].
        quaternion: of the objects, unit.
        pusher: its centre [m].
    """

    position: Float[Tensor, "B N 3"]
    quaternion: Float[Tensor, "B N 4"]
    pusher: Float[Tensor, "B 3"]


def longest_axes(fields: FieldLibrary, names: Iterable[str]) -> dict[str, float]:
    """Return thresholds kappa of some objects [m]: the longest side of the box around what is dense.

    Deviation: dense in our field, at any density, whichever fields are shown.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a field's file is broken.
    """
    return {name: float(np.diff(fields.load(name).extent, axis=0).max()) for name in names}


def adjacency(scenes: Scenes, kappa: Float[Tensor, "B N"]) -> Bool[Tensor, "B A A"]:
    """Return which of the A = N + 1 nodes may touch during the action (eq. 8).

        A_ij = 1 where ||p_i - p_j||^2 < kappa and i != j

    The formula is taken as it stands: a squared distance [m^2] is compared with a length [m], so that objects 20 cm
    long are joined up to 45 cm. Of the poses s_i the positions count. The paper has one kappa; here it is the larger
    one of both nodes, so that A is symmetric.

    Args:
        scenes: where everything is.
        kappa: of the objects [m].
    """
    place = torch.cat([scenes.pusher[:, None], scenes.position], dim=1)
    longest = functional.pad(kappa, (1, 0), value=PUSHER_KAPPA_M)
    squared = (place[:, :, None] - place[:, None]).square().sum(dim=-1)
    near = squared < torch.maximum(longest[:, :, None], longest[:, None])
    return near & ~torch.eye(place.shape[1], dtype=torch.bool, device=place.device)


def node_features(scenes: Scenes, action: Float[Tensor, "B 3"]) -> Float[Tensor, "B A F"]:
    """Return pose and action of every node.

    Args:
        scenes: where everything is.
        action: velocity of the pusher [m/s].
    """
    upright = torch.zeros_like(scenes.quaternion[:, :1])
    upright[..., 0] = 1
    quaternion = torch.cat([upright, scenes.quaternion], dim=1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    position = torch.cat([scenes.pusher[:, None], scenes.position], dim=1) / LENGTH_M
    actions = functional.pad(action[:, None] / MAX_SPEED_M_S, (0, 0, 0, scenes.position.shape[1]))
    return torch.cat([position, quaternion, actions], dim=2)


# The paper's graph network (eq. 7): propagation with one shared edge encoder and propagator.
#
# After Li et al. 2019, "Propagation networks for model-based control under partial observation", as the paper says.
# With node features x_i (pose, action, embedding of the name), receiver i, sender j and h^0 = 0:
#
#     c_i = E_node(x_i),    c_ij = E_edge(x_i, x_j)
#     e^l_ij = P_edge(c_ij, h^{l-1}_i, h^{l-1}_j)
#     h^l_i  = P_node(c_i, h^{l-1}_i, sum_j A_ij e^l_ij)
#     change of pose_i = D(c_i, h^L_i)
#
# The encoders have two layers and D has one before the answer; P_edge and P_node have one each, as there, with a
# shortcut from h^{l-1} to h^l. The same weights serve all objects, edges and propagation steps. Number and width of
# the layers are our choice, since the paper's appendix is not public; so is that the answer is a change of the
# pose.


EMBEDDING = 16  # numbers that are learned for each name


class GraphNetwork(nn.Module):
    """From pose, action and name of the nodes of a graph to the change of their poses.

    A layer on several inputs is written as a sum of layers on each. So the part of a node is not computed again for
    each of its edges, nor the part of an edge in each step.

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
        """Return the number of an object with that name."""
        return self.names.index(name) + 2 if name in self.names else UNKNOWN

    def forward(
        self, features: Float[Tensor, "B A F"], number: Int[Tensor, "B A"], adjacency: Bool[Tensor, "B A A"]
    ) -> Float[Tensor, "B A 7"]:
        """Return the change of position (in units of `LENGTH_M`) and quaternion of every node.

        Args:
            features: pose and action of the nodes.
            number: what each of them is.
            adjacency: receiver i, sender j.
        """
        nodes = torch.cat([features, self.embedding(number)], dim=2)
        own = nodes
        for layer in self.node_encoder:
            own = relu(layer(own))
        receiver, sender = self.edge_encoder_receiver(nodes), self.edge_encoder_sender(nodes)
        edges = relu(self.edge_encoder_last(relu(receiver[:, :, None] + sender[:, None])))
        relation, constant = self.edge_propagator_relation(edges), self.node_propagator_own(own)
        is_edge = adjacency[:, :, None].to(own.dtype)  # (B, A, 1, A)
        state = torch.zeros_like(own)
        for _ in range(self.steps):
            receiver, sender = self.edge_propagator_receiver(state), self.edge_propagator_sender(state)
            effects = relu(relation + receiver[:, :, None] + sender[:, None])
            effect = (is_edge @ effects)[:, :, 0]
            state = relu(state + constant + self.node_propagator_state(state) + self.node_propagator_effect(effect))
        return self.answer(relu(self.decoder(torch.cat([own, state], dim=2))))


# Poses after each action by the paper's network, and the loss that it is trained with.
#
# The network predicts the change of a pose, which is added to it; the quaternion is normalised afterwards (eq. 7
# leaves open how the next pose comes about). The pusher goes where its actions take it: a robot knows its hand.


def unroll(
    network: GraphNetwork,
    number: Int[Tensor, "B N"],
    kappa: Float[Tensor, "B N"],
    start: Scenes,
    actions: Float[Tensor, "B T 3"],
    pusher: Float[Tensor, "B T1 3"],
) -> Iterator[Scenes]:
    """Yield the scenes after each action, each predicted from the one before.

    Args:
        network: predicts one action.
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        start: the scenes before the first action.
        actions: velocities of the pusher [m/s].
        pusher: its centre before the first and after each action [m].
    """
    scenes, numbers = start, functional.pad(number, (1, 0), value=PUSHER)  # the pusher is the first node
    for step in range(actions.shape[1]):
        features = node_features(scenes, actions[:, step])
        change = network(features, numbers, adjacency(scenes, kappa))[:, 1:]
        position = scenes.position + LENGTH_M * change[..., :3]
        # the change is of the quaternion that the network saw, with w >= 0
        quaternion = functional.normalize(features[:, 1:, 3:7] + change[..., 3:], dim=-1)
        scenes = Scenes(position, quaternion, pusher[:, step + 1])
        yield scenes


def squared_error(
    predicted: Scenes, position: Float[Tensor, "B N 3"], quaternion: Float[Tensor, "B N 4"]
) -> Float[Tensor, ""]:
    """Return the squared error of position and quaternion, summed across objects, mean over the scenes.

    Of the two quaternions of the true orientation the nearer one counts. The paper gives no unit of length; here it is
    `LENGTH_M`.

    Args:
        predicted: by the network.
        position: true [m].
        quaternion: true.
    """
    is_opposite = (predicted.quaternion * quaternion).sum(dim=-1, keepdim=True) < 0
    shift = (predicted.position - position) / LENGTH_M
    turn = predicted.quaternion - torch.where(is_opposite, -quaternion, quaternion)
    return (shift.square().sum(dim=-1) + turn.square().sum(dim=-1)).sum(dim=1).mean()


# Files of the paper's networks: safetensors with half-precision parameters, checked when read.


FORMAT = "paper-pushes-1"
WEIGHTS_FILE = "paper_pushes.safetensors"
_MOST_NAMES = 10_000


def weights_path(data_dir: Path | None) -> Path:
    """Return DATA_DIR/dynamics/paper_pushes.safetensors if it is there, else the package's."""
    own = None if data_dir is None else data_dir / "dynamics" / WEIGHTS_FILE
    return own if own is not None and own.is_file() else shipped()


def shipped() -> Path:
    """Return the file of the network that comes with the package."""
    return Path(str(files("osfcore.paper") / "shipped" / "pushes.safetensors"))


def network_bytes(network: GraphNetwork) -> bytes:
    """Return a network as the contents of a file."""
    words = {"hidden": str(network.hidden), "steps": str(network.steps), "names": json.dumps(network.names)}
    return parameter_bytes(network, {"format": FORMAT, **words})


def write_network(path: Path, network: GraphNetwork) -> None:
    """Write a network; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, network_bytes(network))


def read_network(path: Path) -> GraphNetwork:
    """Read a network.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or no such network.
    """
    metadata, values = read_parameters(path, FORMAT, "network of pushes")
    network = GraphNetwork(_names(metadata, path), *described_sizes(metadata, path))
    load_parameters(network, values, path)
    if network.embedding.weight[UNKNOWN].any():
        raise CorruptFile(path, "its embedding of unknown objects is not zero")
    return network.eval()


def _names(metadata: Mapping[str, str], path: Path) -> list[str]:
    """Return the objects that a network knows by the metadata of its file."""
    try:
        names: list[str] = json.loads(metadata["names"])
    except (KeyError, ValueError, RecursionError) as error:
        raise CorruptFile(path, f"it holds no network of pushes of known objects ({shown(error)})") from error
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not is_list or not len(set(names)) == len(names) <= _MOST_NAMES:
        raise CorruptFile(path, "its names of objects are no list of different names")
    return names


# Open-loop rollouts of action sequences by the paper's model, behind the same interface as ours.


_CHUNK = 512  # sequences rolled out at once: more would not be faster


class PaperPushModel:
    """The paper's dynamics model: a trained network with the longest axes of its objects.

    Args:
        network: predicts the poses after one action.
        kappas: longest axes of all objects that may occur, by name [m]; the network need not know their names.
        device: that computes.

    Raises:
        InvalidInput: if there are no objects.
    """

    def __init__(self, network: GraphNetwork, kappas: Mapping[str, float], device: torch.device | str = "cpu") -> None:
        if not kappas:
            raise InvalidInput("number of objects", 0, "at least 1")
        self.device = torch.device(device)
        self._network = network.to(self.device).eval()
        self._kappas = dict(kappas)

    @property
    def names(self) -> tuple[str, ...]:
        """Objects whose longest axes are known."""
        return tuple(sorted(self._kappas))

    def rollout(
        self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None = None
    ) -> Rollouts:
        """Predict poses under K sequences of T actions.

        Objects are put into the order of their names inside, so that the order in which they come never matters.

        Args:
            state: of the scene, with its pusher.
            actions: velocities (vx, vy, 0) of the pusher [m/s], each held for 0.2 s.
            before: plays no part: the paper's model has no velocities.

        Raises:
            InvalidInput: if there are no objects or no pusher, or actions have another shape, are too many, not finite
                or beyond the limits; nothing is clipped.
            UnknownName: if the longest axis of an object is not known.
        """
        actions = check_actions(actions)
        start = check_scene(state, self._kappas, "longest axis")
        pusher = pusher_centres(start[:2], actions, start[2])
        order = np.argsort(state.names)
        slots = np.argsort(order)
        with torch.inference_mode():
            chunks = [slice(k, k + _CHUNK) for k in range(0, len(actions), _CHUNK)]
            parts = [self._unroll(state, order, actions[chunk], pusher[chunk]) for chunk in chunks]
        placed, turned = (np.concatenate([part[i] for part in parts]).astype(float)[:, :, slots] for i in range(2))
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        positions, quaternions = (
            np.concatenate([np.broadcast_to(given, (len(actions), 1, *given.shape)), found], axis=1)
            for given, found in ((state.poses.position, placed), (state.poses.quaternion, turned))
        )
        return Rollouts(state.names, positions, quaternions, pusher)

    def _unroll(
        self, state: SceneState, order: np.ndarray, actions: np.ndarray, pusher: np.ndarray
    ) -> tuple[Float[np.ndarray, "K T N 3"], Float[np.ndarray, "K T N 4"]]:
        """Return poses after each action, in the order of names."""
        count, names = len(actions), [state.names[i] for i in order]
        number = torch.tensor([self._network.number(name) for name in names], device=self.device).expand(count, -1)
        kappa = self._tensor(np.array([self._kappas[name] for name in names])).expand(count, -1)
        places = (state.poses.position, state.poses.quaternion)
        position, quaternion = (self._tensor(part[order]).expand(count, -1, -1) for part in places)
        start = Scenes(position, quaternion, self._tensor(pusher[:, 0]))
        scenes = list(unroll(self._network, number, kappa, start, self._tensor(actions), self._tensor(pusher)))
        placed, turned = torch.stack([s.position for s in scenes], 1), torch.stack([s.quaternion for s in scenes], 1)
        return placed.cpu().numpy(), turned.cpu().numpy()

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=self.device)


def load_paper_push_model(
    data_dir: Path | None, fields: FieldLibrary, names: Iterable[str], device: torch.device | str = "cpu"
) -> PaperPushModel:
    """Return the paper's network with the longest axes of some objects, each from its field.

    Args:
        data_dir: DATA_DIR; a network in it comes before the package's.
        fields: of the objects.
        names: which objects.
        device: that computes.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a file is broken.
    """
    return PaperPushModel(read_network(weights_path(data_dir)), longest_axes(fields, names), device)
