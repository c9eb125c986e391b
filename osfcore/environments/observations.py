"""What an environment tells of a table: spaces and values of poses and pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from jaxtyping import UInt8

from osfcore.geometry.states import SceneState, pose_rows
from osfcore.geometry.workspace import PUSHER_REACH_M, TABLE_SIDE_M

Kind = Literal["poses", "pixels", "both"]
KINDS: tuple[Kind, ...] = get_args(Kind)


def space_of(kind: Kind, objects: int, available: int, views: int, side: int) -> gymnasium.spaces.Dict:
    """The space of observations.

    Args:
        kind: of them.
        objects: in the scene (N).
        available: objects to choose from.
        views: images of the table (V).
        side: of each image [px].
    """
    box = gymnasium.spaces.Box
    spaces: dict[str, gymnasium.Space[Any]] = {"pusher": box(-PUSHER_REACH_M, PUSHER_REACH_M, (2,), np.float64)}
    goal: dict[str, gymnasium.Space[Any]] = {}
    if kind != "pixels":
        spaces["objects"] = gymnasium.spaces.MultiDiscrete([available] * objects)
        limits = np.tile([TABLE_SIDE_M] * 3 + [1.0] * 4, (objects, 1))
        spaces["poses"] = goal["poses"] = box(-limits, limits, dtype=np.float64)
    if kind != "poses":
        spaces["pixels"] = box(0, 255, (views, side, side, 3), np.uint8)
        goal["pixels"] = box(0, 255, (side, side, 3), np.uint8)
    return gymnasium.spaces.Dict({**spaces, "goal": gymnasium.spaces.Dict(goal)})


def observation_of(
    state: SceneState,
    goal: SceneState,
    available: tuple[str, ...],
    pixels: Mapping[str, UInt8[np.ndarray, "..."]] | None,
    kind: Kind,
) -> dict[str, Any]:
    """An observation, nothing of which belongs to another one.

    Args:
        state: of the table.
        goal: how it shall become.
        available: objects to choose from: what is told of an object is its number in them.
        pixels: images of "table" and "goal", where they are told.
        kind: of the observation.
    """
    assert state.pusher is not None, "a simulated table has a pusher"
    told: dict[str, Any] = {"pusher": state.pusher[:2].clip(-PUSHER_REACH_M, PUSHER_REACH_M)}
    aim: dict[str, Any] = {}
    if kind != "pixels":
        told["objects"] = np.array([available.index(name) for name in state.names])
        told["poses"], aim["poses"] = pose_rows(state.poses), pose_rows(goal.poses)
    if pixels is not None:
        told["pixels"], aim["pixels"] = pixels["table"].copy(), pixels["goal"].copy()
    return {**told, "goal": aim}
