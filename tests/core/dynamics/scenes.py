"""Scenes to push things around in: real shapes on the table, and networks that have learned nothing."""

import itertools

import numpy as np
import torch

from osfcore.dynamics.graph import PropagationNetwork, unroll
from osfcore.dynamics.motion import SUBSTEPS, Motion, Sweep, headings, lowest_point, pusher_path
from osfcore.dynamics.shapes import MAP_SIDE, ObjectShape, ShapeTable, octahedral_directions
from osfcore.fields.kiloosf import KiloOSF
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, STEP_S
from osfcore.io.push_file import EpisodeFolder, PushEpisode, save_episode
from osfcore.render.reference import solid_field

VOXEL = 0.004  # of a bracket
BOX, CAN, GELATIN, APPLE = NAMES = ("003_cracker_box", "005_tomato_soup_can", "009_gelatin_box", "013_apple")


def hull(shape) -> np.ndarray:
    """Points whose convex hull is the shape's, around its centre of mass (P, 3) [m]."""
    return np.unique(shape.support, axis=0).astype(float)


def boxes(*parts) -> ObjectShape:
    """Boxes, each given as centre and half its sides, as the convex parts of one object; a single box is convex."""
    corners = [np.array(list(itertools.product(*zip(np.subtract(c, h), np.add(c, h), strict=True)))) for c, h in parts]
    points = np.concatenate(corners)
    maps = [support_map(part) for part in corners]
    radius = float(np.linalg.norm(points, axis=1).max())
    return ObjectShape(
        np.ptp(points, axis=0) / 2, np.zeros(3), radius, support_map(points), tuple(maps if len(maps) > 1 else ())
    )


def support_map(corners) -> np.ndarray:
    """The farthest corner in each direction."""
    return corners[np.argmax(octahedral_directions(MAP_SIDE) @ corners.T, axis=1)].astype(np.float32)


def angle_bracket() -> ObjectShape:
    """Two arms along +x and +y that share an end, 12 cm long, 4 cm wide and high: the corner between them is free."""
    return boxes(((0.04, 0.0, 0.0), (0.06, 0.02, 0.02)), ((0.0, 0.04, 0.0), (0.02, 0.06, 0.02)))


def bracket() -> KiloOSF:
    """The field of two arms along +x and +y, 10 cm long and 3 cm wide, that share an end at (-3.5, -3.5) cm."""
    arm = np.array([0.05, 0.015, 0.02])

    def depth(x):
        arms = (arm - np.abs(x + [0, 0.035, 0])), (arm[[1, 0, 2]] - np.abs(x + [0.035, 0, 0]))
        return np.maximum(*(sides.min(axis=-1) for sides in arms))

    def normal(x):
        return np.broadcast_to([0.0, 0, 1], x.shape)

    return solid_field(depth, normal, np.full(3, 0.05), (0.5, 0.5, 0.5), voxel=VOXEL, hidden=8)


def on_table(shape, x: float, y: float, turn=(0.0, 0.0, 0.0)) -> Pose:
    """An object turned by a rotation vector, its centre of mass over (x, y), touching the table."""
    quaternion = quaternion_exp(np.asarray(turn, float))
    height = -rotate(quaternion, hull(shape))[:, 2].min()
    return Pose(np.array([x, y, height]) - rotate(quaternion, shape.centre), quaternion)


def scene(shapes, placed: dict[str, tuple], pusher=(0.0, 0.0)) -> SceneState:
    """A state of objects given as name: arguments of `on_table`."""
    poses = [on_table(shapes[name], *where) for name, where in placed.items()]
    position, quaternion = (np.array([getattr(p, part) for p in poses]) for part in ("position", "quaternion"))
    pose = Pose(position.reshape(-1, 3), quaternion.reshape(-1, 4))
    return SceneState(tuple(placed), pose, Light(np.array([0.0, 0, 1])), np.array([*pusher, PUSHER_CENTRE_Z_M]))


def crowd(shapes) -> SceneState:
    """Three objects in a row before the pusher, a little tilted as real ones are, and one far away."""
    row = {CAN: (0.06, 0.01, (0.004, 0.006, 0.4)), GELATIN: (0.15, 0.0, (0.003, -0.005, 1.0))}
    return scene(shapes, {**row, APPLE: (0.24, 0.02, (0.1, 0.2, 0.3)), BOX: (-0.25, 0.2, (0.005, 0.004, 0.2))})


def moved_state(state: SceneState, angle: float, shift) -> SceneState:
    """The whole scene turned about the vertical and then shifted."""
    q, shift = quaternion_exp(np.array([0.0, 0.0, angle])), np.array([*shift, 0.0])
    turned = quaternion_multiply(np.broadcast_to(q, state.poses.quaternion.shape), state.poses.quaternion)
    return SceneState(
        state.names, Pose(rotate(q, state.poses.position) + shift, turned), state.light, rotate(q, state.pusher) + shift
    )


def picked(state: SceneState, order) -> SceneState:
    """The same objects in another order."""
    return SceneState(tuple(state.names[i] for i in order), state.poses[list(order)], state.light, state.pusher)


def network(seed: int = 0, hidden: int = 16, *, silent: bool = False) -> PropagationNetwork:
    """A network as it is before it has learned anything; a silent one answers with the first guess alone."""
    torch.manual_seed(seed)
    made = PropagationNetwork(hidden)
    if silent:
        torch.nn.init.zeros_(made.decoder[-1].weight)
        torch.nn.init.zeros_(made.decoder[-1].bias)
    return made.eval()


def start(table, shapes, state: SceneState) -> tuple[torch.Tensor, Motion]:
    """Numbers of the objects and the state at rest as one scene."""
    number = torch.tensor([[sorted(shapes).index(name) for name in state.names]])
    centre = state.poses.position + rotate(
        state.poses.quaternion, np.array([shapes[n].centre for n in state.names]).reshape(-1, 3)
    )
    centre = torch.as_tensor(centre, dtype=torch.float32)
    quaternion = torch.as_tensor(state.poses.quaternion, dtype=torch.float32)
    floor = lowest_point(table, number[0], centre, quaternion).clamp(max=0)
    still = torch.zeros_like(centre)[None]
    pusher = torch.as_tensor(state.pusher[None, :2], dtype=torch.float32)
    return number, Motion(centre[None], quaternion[None], still, still, pusher, floor[None])


def sweep_of(motion: Motion, velocity) -> Sweep:
    """One substep of an action (vx, vy) [m/s]."""
    velocity = torch.as_tensor(np.array([velocity]), dtype=torch.float32).expand(len(motion.pusher), 2)
    return Sweep(headings(velocity, motion), velocity * (STEP_S / SUBSTEPS))


def episode(shapes, state: SceneState, actions, *, substates: bool = True) -> PushEpisode:
    """A recording of what the first guess alone would make of a push, with its poses within the actions."""
    actions = np.asarray(actions, float)
    table = ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
    number, motion = start(table, shapes, state)
    velocity = torch.as_tensor(actions[:, None, :2], dtype=torch.float32)
    with torch.inference_mode():
        motions = [motion, *unroll(network(silent=True), table, number, motion, velocity)]
    turned = np.stack([m.quaternion[0].numpy() for m in motions]).astype(float)
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    offset = np.array([shapes[name].centre for name in state.names])
    positions = np.stack([m.centre[0].numpy() for m in motions]) - rotate(turned, offset)
    ends = slice(None, None, SUBSTEPS)
    pusher = np.concatenate(
        [pusher_path(state.pusher[:2], actions[:, :2])[ends], np.full((len(actions) + 1, 1), PUSHER_CENTRE_Z_M)], axis=1
    )
    within = {
        "sub_positions": positions[1:].reshape(len(actions), SUBSTEPS, -1, 3),
        "sub_quaternions": turned[1:].reshape(len(actions), SUBSTEPS, -1, 4),
    }
    moved = np.linalg.norm(np.diff(positions[ends], axis=0), axis=-1) > 0
    return PushEpisode(
        state.names, 0, positions[ends], turned[ends], pusher, actions, moved, **(within if substates else {})
    )


def write(path, episodes):
    """A push file."""
    with EpisodeFolder(path, {}) as folder:
        for number, e in enumerate(episodes):
            save_episode(folder.path(number), e)
        folder.combine(len(episodes))
    return path
