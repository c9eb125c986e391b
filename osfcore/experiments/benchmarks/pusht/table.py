"""The plane of Push-T as our table: the T is an object that lies on it, the pusher is ours.

The plane's centre is the table's, 1 px is 1 mm, x and y are the same axes (the plane's y points down in its pictures).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.shapes.object_shapes import ObjectShape, solid_shape
from osfcore.experiments.benchmarks.pusht.environment import PX_M
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.planning.pose_cost import PoseCost, PoseGoal

NAME = "tee"
_PLANE_CENTRE_PX = 256.0
# Both boxes, x and y, in the frame of the environment's T; its origin is the middle of the bar's outer side [px].
_BAR, _STEM = ((-60.0, 60.0), (0.0, 30.0)), ((-15.0, 15.0), (30.0, 120.0))
_MIDDLE_PX = (0.0, 60.0)  # of its bounding box, the origin of our object frames
_HALF_HEIGHT_M = 0.025
_ARM_M = 0.045  # the T's radius of gyration: what a rotation by 1 rad moves it by


def tee_shape() -> ObjectShape:
    """The T as two boxes."""
    boxes = [np.array([[x, y, z] for x in xs for y in ys for z in (-1, 1)]) for xs, ys in (_BAR, _STEM)]
    scale, shift = (PX_M, PX_M, _HALF_HEIGHT_M), (*_MIDDLE_PX, 0.0)
    corners = [(box - shift) * scale for box in boxes]
    areas = [np.ptp(xs) * np.ptp(ys) for xs, ys in (_BAR, _STEM)]
    centre = np.average([box.mean(axis=0) for box in corners], axis=0, weights=areas)
    return solid_shape(np.concatenate(corners), centre, corners)


def pose_of(tee: Float[np.ndarray, "*batch 3"]) -> Pose:
    """The T's pose on the table from its origin [px] and angle [rad] on the plane."""
    sine, cosine = np.sin(tee[..., 2]), np.cos(tee[..., 2])
    (x, y), height = _MIDDLE_PX, np.full(tee.shape[:-1], _HALF_HEIGHT_M)
    middle = tee[..., :2] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    flat = _on_table(middle)
    turn = np.zeros((*tee.shape[:-1], 3))
    turn[..., 2] = tee[..., 2]
    return Pose(np.concatenate([flat, height[..., None]], axis=-1), quaternion_exp(turn))


def scene_of(state: Float[np.ndarray, "7"]) -> SceneState:
    """The plane's state as a scene."""
    return SceneState((NAME,), pose_of(state[None, 4:]), Light(np.array([0.0, 0.0, 1.0])), _pusher(state[:2]))


def rollouts_of(states: Float[np.ndarray, "K T1 7"]) -> Rollouts:
    """Sequences of the plane's states as futures of the scene."""
    poses = pose_of(states[:, :, None, 4:])
    return Rollouts((NAME,), poses.position, poses.quaternion, _pusher(states[..., :2]))


def goal_of(tee: Float[np.ndarray, "3"]) -> PoseGoal:
    """The pose goal of a place [px, rad] on the plane."""
    return PoseGoal((NAME,), pose_of(tee[None]))


def cost_of(goal: PoseGoal) -> PoseCost:
    """What futures cost, for all planners."""
    return PoseCost(goal, _ARM_M)


def _pusher(places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    height = np.full((*places.shape[:-1], 1), PUSHER_CENTRE_Z_M)
    return np.concatenate([_on_table(places), height], axis=-1)


def _on_table(places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    return (places - _PLANE_CENTRE_PX) * PX_M
