"""Open-loop rollouts of action sequences by the paper's model, behind the same interface as ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.errors import InvalidInput, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.paper.dynamics.graph import Scenes, longest_axes
from osfcore.paper.dynamics.graph_network import GraphNetwork
from osfcore.paper.dynamics.prediction import unroll
from osfcore.paper.dynamics.weights import read_network, weights_path

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
        """Predicted poses under K sequences of T actions.

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
        pusher = self._pusher_of(state, actions)
        order = np.argsort(state.names)
        slots = np.argsort(order)
        with torch.inference_mode():
            parts = [
                self._unroll(state, order, actions[k : k + _CHUNK], pusher[k : k + _CHUNK])
                for k in range(0, len(actions), _CHUNK)
            ]
        position, quaternion = (np.concatenate([part[i] for part in parts]).astype(float) for i in range(2))
        quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
        given = (state.poses.position, state.poses.quaternion)
        first = [np.broadcast_to(part, (len(actions), 1, *part.shape)) for part in given]
        positions = np.concatenate([first[0], position[:, :, slots]], axis=1)
        quaternions = np.concatenate([first[1], quaternion[:, :, slots]], axis=1)
        return Rollouts(state.names, positions, quaternions, pusher)

    def _pusher_of(self, state: SceneState, actions: Float[np.ndarray, "K T 3"]) -> Float[np.ndarray, "K T1 3"]:
        """Where the actions take the pusher, at its height."""
        if not state.names:
            raise InvalidInput("number of objects", 0, "at least 1")
        if state.pusher is None:
            raise InvalidInput("pusher of the state", "missing", "given: predictions start from where it is")
        for name in state.names:
            if name not in self._kappas:
                raise UnknownName("longest axis", name, self._kappas)
        path = pusher_path(state.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
        return np.concatenate([path, np.full((*path.shape[:2], 1), state.pusher[2])], axis=-1)

    def _unroll(
        self, state: SceneState, order: np.ndarray, actions: np.ndarray, pusher: np.ndarray
    ) -> tuple[Float[np.ndarray, "K T N 3"], Float[np.ndarray, "K T N 4"]]:
        """Poses after each action, in the order of names."""
        count, names = len(actions), [state.names[i] for i in order]
        number = torch.tensor([self._network.number(name) for name in names], device=self.device)
        kappa = self._tensor(np.array([self._kappas[name] for name in names]))
        position = self._tensor(state.poses.position[order]).expand(count, -1, -1)
        quaternion = self._tensor(state.poses.quaternion[order]).expand(count, -1, -1)
        start = Scenes(position, quaternion, self._tensor(pusher[:, 0]))
        number, kappa = number.expand(count, -1), kappa.expand(count, -1)
        scenes = list(unroll(self._network, number, kappa, start, self._tensor(actions), self._tensor(pusher)))
        placed, turned = ([getattr(s, name) for s in scenes] for name in ("position", "quaternion"))
        return torch.stack(placed, dim=1).cpu().numpy(), torch.stack(turned, dim=1).cpu().numpy()

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=self.device)


def load_paper_push_model(
    data_dir: Path | None, fields: FieldLibrary, names: Iterable[str], device: torch.device | str = "cpu"
) -> PaperPushModel:
    """The paper's network with the longest axes of some objects, each from its field.

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
