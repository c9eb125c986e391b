"""Open-loop rollouts of action sequences by the dynamics model (paper eq. 7)."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from osfcore.dynamics.graph import PropagationNetwork, read_network, shipped, unroll
from osfcore.dynamics.kernels import Shapes, Weights, packed_shapes, packed_weights, unroll_block
from osfcore.dynamics.motion import SUBSTEPS, Motion, going_on, lowest_point, pusher_path
from osfcore.dynamics.shapes import ObjectShape, ShapeTable, field_parts, object_shape, read_parts, write_parts
from osfcore.errors import CannotWrite, InvalidInput, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.poses import Pose, rotate
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState

_CHUNK = 4096  # sequences rolled out at once: more would not be faster
_BLOCK = 40  # scenes whose objects go through the compiled network together, at most


class PushModel:
    """The learned dynamics model: a graph network that predicts the motion of objects under pushes.

    On a CPU it runs compiled code, which gives the same results as PyTorch up to rounding. A network whose width is no
    multiple of four runs in PyTorch.

    Args:
        network: network that predicts the motion of one substep.
        shapes: shapes of all objects that may occur, by name.
        device: PyTorch device.

    Raises:
        InvalidInput: if there are no shapes.

    Example:
        >>> push_model = load_push_model(None, fields, [name])
        >>> actions = np.zeros((2, 5, 3))  # two sequences of five actions; the second one waits
        >>> actions[0, :, 0] = 0.15  # [m/s] toward the bottle
        >>> futures = push_model.rollout(state, actions)
        >>> futures.positions.shape
        (2, 6, 1, 3)
        >>> futures.positions[:, -1, 0, 0] > 0.01  # whether the bottle moved by 1 cm
        array([ True, False])
    """

    def __init__(
        self, network: PropagationNetwork, shapes: Mapping[str, ObjectShape], device: torch.device | str = "cpu"
    ) -> None:
        if not shapes:
            raise InvalidInput("number of objects", 0, "at least 1")
        self.device = torch.device(device)
        self._network = network.to(self.device).eval()
        self._names = tuple(sorted(shapes))
        self._table = ShapeTable(tuple(shapes[name] for name in self._names), self.device)
        self._packed = None
        if self.device.type == "cpu" and network.hidden % 4 == 0:
            self._packed = packed_shapes(self._table), packed_weights(self._network)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects whose shapes are known."""
        return self._names

    def rollout(
        self,
        state: SceneState,
        actions: Float[np.ndarray, "K T 3"],
        before: SceneState | None = None,
        pushers: Float[np.ndarray, "K 2"] | None = None,
    ) -> Rollouts:
        """Predict the poses of all objects under K sequences of T actions.

        The order of the objects in the state does not change the result. An object that nothing can touch keeps exactly
        its pose.

        Args:
            state: state of the scene, with a pusher.
            actions: velocities (vx, vy, 0) of the pusher in the world [m/s]. Each action is held for 0.2 s;
                vx and vy are at most 0.3 in size.
            before: state of the same objects one action earlier, which gives their velocities; at rest if None.
            pushers: x and y of the pusher at the beginning of each sequence [m]; as in the state if None.

        Returns:
            The K futures, with poses before the first and after each action.

        Raises:
            InvalidInput: if there are no objects or no pusher, or the actions have another shape, are too many, not
                finite or beyond the limits. Actions are never clipped.
            UnknownName: if the shape of an object is not known.
        """
        actions = check_actions(actions)
        pusher = check_scene(state, self._names, "shape")
        order = sorted(range(len(state.names)), key=state.names.__getitem__)
        begins = np.tile(pusher[:2], (len(actions), 1)) if pushers is None else pushers
        with torch.inference_mode():
            number = torch.tensor([[self._names.index(state.names[i]) for i in order]], device=self.device)
            start = self._initial_motion(state, order, number, pusher, before)
            chunks = [slice(k, k + _CHUNK) for k in range(0, len(actions), _CHUNK)]
            parts = [self._unroll(number, start, actions[chunk], begins[chunk]) for chunk in chunks]
        placed, turned, moved = (np.concatenate([part[i] for part in parts]) for i in range(3))
        turned = turned.astype(float)
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        placed = placed.astype(float) - rotate(turned, self._table.centre[number[0]].cpu().numpy())
        many = (len(actions), actions.shape[1] + 1)
        positions, quaternions = (
            np.broadcast_to(part, (*many, *part.shape)).copy()
            for part in (state.poses.position, state.poses.quaternion)
        )
        for place, slot in enumerate(order):
            here = moved[..., place]  # elsewhere the given pose stays
            positions[:, 1:, slot][here] = placed[..., place, :][here]
            quaternions[:, 1:, slot][here] = turned[..., place, :][here]
        return Rollouts(state.names, positions, quaternions, pusher_centres(begins, actions, pusher[2]))

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array, float), device=self.device)

    def _initial_motion(
        self, state: SceneState, order: list[int], number: Tensor, pusher: np.ndarray, before: SceneState | None
    ) -> Motion:
        """Return the state with the velocities of the action before; at rest if that is not given."""
        start = self._at_rest(state.poses[order], number, pusher)
        if before is None:
            return start
        if sorted(before.names) != sorted(state.names):
            raise InvalidInput("objects one action ago", ", ".join(before.names), "those of the state")
        earlier = sorted(range(len(order)), key=before.names.__getitem__)
        return going_on(self._at_rest(before.poses[earlier], number, pusher), start)

    def _at_rest(self, poses: Pose, number: Int[Tensor, "1 N"], pusher: np.ndarray) -> Motion:
        """Return one scene in which nothing moves."""
        quaternion = self._tensor(poses.quaternion)
        centre = self._tensor(poses.position) + rotations.rotate(quaternion, self._table.centre[number[0]])
        centre, quaternion = centre.float(), quaternion.float()
        floor = lowest_point(self._table, number[0], centre, quaternion).clamp(max=0)
        still = torch.zeros_like(centre)
        scene = (centre, quaternion, still, still, self._tensor(pusher[:2]).float(), floor)
        return Motion(*(part[None] for part in scene))

    def _unroll(
        self, number: Tensor, start: Motion, actions: np.ndarray, begins: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centres of mass, orientations and whether anything moved since the start, after each action."""
        if self._packed is not None:
            return _unroll_compiled(*self._packed, number[0], start, actions, begins)
        centres, turned, moved = [], [], []
        has_moved = torch.zeros(len(actions), number.shape[1], dtype=torch.bool, device=self.device)
        count = len(actions)
        velocity = torch.as_tensor(actions[..., :2], dtype=torch.float32, device=self.device).transpose(0, 1)
        scenes = Motion(*(part.expand(count, *part.shape[1:]) for part in start))
        scenes = scenes._replace(pusher=self._tensor(begins).float())
        motions = unroll(self._network, self._table, number.expand(count, -1), scenes, velocity)
        for step, motion in enumerate(motions, start=1):
            has_moved = has_moved | (motion.linear.abs().amax(dim=2) > 0) | (motion.angular.abs().amax(dim=2) > 0)
            if step % SUBSTEPS == 0:
                centres.append(motion.centre)
                turned.append(motion.quaternion)
                moved.append(has_moved)
        return tuple(torch.stack(part, dim=1).cpu().numpy() for part in (centres, turned, moved))  # pyright: ignore[reportReturnType]


def check_scene(state: SceneState, known: Collection[str], kind: str) -> Float[np.ndarray, "3"]:
    """Check that a scene can be predicted; return the pusher's centre in the world [m].

    Args:
        state: state of the scene.
        known: names of the objects that can be predicted.
        kind: what is known of them, such as "shape", for the error.

    Raises:
        InvalidInput: if there are no objects or no pusher.
        UnknownName: if an object is not known.
    """
    if not state.names:
        raise InvalidInput("number of objects", 0, "at least 1")
    if state.pusher is None:
        raise InvalidInput("pusher of the state", "missing", "given, because predictions start from it")
    for name in state.names:
        if name not in known:
            raise UnknownName(kind, name, known)
    return state.pusher


def pusher_centres(
    begins: Float[np.ndarray, "*#batch 2"], actions: Float[np.ndarray, "K T 3"], height: float
) -> Float[np.ndarray, "K T1 3"]:
    """Return the pusher's centre in the world before the first and after each action [m], at this height [m]."""
    path = pusher_path(begins, actions[..., :2])[:, ::SUBSTEPS]
    return np.concatenate([path, np.full((*path.shape[:2], 1), height)], axis=-1)


def _unroll_compiled(
    shapes: Shapes,
    weights: Weights,
    number: Int[Tensor, "N"],
    start: Motion,
    actions: Float[np.ndarray, "K T 3"],
    begins: Float[np.ndarray, "K 2"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the same as `PushModel._unroll` without torch. BENCHMARKS.md has the gain in speed."""
    begins, velocity = begins.astype(np.float32), np.ascontiguousarray(actions[..., :2], np.float32)
    shifts = np.diff(pusher_path(begins, velocity.astype(float)), axis=1).astype(np.float32)
    scene = (start.centre, start.quaternion, start.linear, start.angular, start.floor)
    many = (*velocity.shape[:2], len(number))
    results = np.empty((*many, 3), np.float32), np.empty((*many, 4), np.float32), np.empty(many, bool)
    first = tuple(np.ascontiguousarray(part[0].numpy(), np.float32) for part in scene)
    given = shapes, weights, number.numpy(), first, begins, velocity, shifts
    size = min(_BLOCK, -(-len(begins) // 2))  # no matter how many threads there are, so that rounding is the same
    blocks = range(0, len(begins), size)
    with ThreadPoolExecutor(min(numba.get_num_threads(), len(blocks))) as threads:
        list(threads.map(lambda k: unroll_block(*given, k, min(k + size, len(begins)), *results), blocks))
    return results


# The trained network and the shapes: those in the data directory, or else those that ship with the package.


NETWORK_FILE = "pushes.safetensors"


def network_path(data_dir: Path | None) -> Path:
    """Return DATA_DIR/dynamics/pushes.safetensors if it exists, else the package's file."""
    own = None if data_dir is None else data_dir / "dynamics" / NETWORK_FILE
    return own if own is not None and own.is_file() else shipped()


def load_shapes(data_dir: Path | None, fields: FieldLibrary, names: Iterable[str]) -> dict[str, ObjectShape]:
    """Return the shapes of some objects, which the dynamics model and push proposals need.

    Shapes are computed from fields. Dividing a new field into convex parts takes up to half a minute; the parts are
    then stored in DATA_DIR/dynamics/parts. Parts of the shipped fields come with the package.

    Args:
        data_dir: DATA_DIR; None to store nothing.
        fields: fields of the objects.
        names: names of the objects.

    Returns:
        The shapes by name.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if the file of a field is broken.
        OsfError: if nothing in a field is solid.

    Example:
        >>> list(load_shapes(None, fields, ["006_mustard_bottle"]))
        ['006_mustard_bottle']
    """
    return {name: _load_shape(data_dir, fields, name) for name in names}


def _load_shape(data_dir: Path | None, fields: FieldLibrary, name: str) -> ObjectShape:
    field = fields.load(name)
    digest = hashlib.sha256(fields.info(name).path.read_bytes()).hexdigest()
    own = None if data_dir is None else data_dir / "dynamics" / "parts" / f"{name}.safetensors"
    kept = Path(str(files("osfcore.dynamics") / "shipped" / "parts" / f"{name}.safetensors"))
    for path in (own, kept):
        parts = None if path is None else read_parts(path, digest)
        if parts is not None:
            return object_shape(field, parts)
    parts = field_parts(field)
    if own is not None:
        with contextlib.suppress(CannotWrite):  # a full disk costs time, not the prediction
            write_parts(own, parts, digest)
    return object_shape(field, parts)


def load_push_model(
    data_dir: Path | None, fields: FieldLibrary, names: Iterable[str], device: torch.device | str = "cpu"
) -> PushModel:
    """Load the trained dynamics model for some objects.

    Args:
        data_dir: DATA_DIR, as in `load_shapes`. Its network dynamics/pushes.safetensors, if there is one, is used
            instead of the package's.
        fields: fields of the objects, from which their shapes are computed.
        names: names of the objects.
        device: PyTorch device.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a file is broken.
        OsfError: if nothing in a field is solid.

    Example:
        >>> load_push_model(None, fields, ["006_mustard_bottle"]).names
        ('006_mustard_bottle',)
    """
    return PushModel(read_network(network_path(data_dir)), load_shapes(data_dir, fields, names), device)
