"""Poses of frames from ROS's transforms (tf2_msgs/TFMessage)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydantic import Field, FiniteFloat

from osfcore.errors import UnknownName
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.json_codec import Entry, decode


class _Vector(Entry):
    x: FiniteFloat
    y: FiniteFloat
    z: FiniteFloat


class _Quaternion(_Vector):
    w: FiniteFloat


class _Transform(Entry):
    translation: _Vector
    rotation: _Quaternion


class _Header(Entry):
    frame_id: str


class _Stamped(Entry):
    header: _Header
    child_frame_id: str
    transform: _Transform


class _Message(Entry):
    transforms: list[_Stamped] = Field(default=[])


class TransformTree:
    """`T_parent_child` of each frame; later messages replace what earlier ones told.

    Args:
        messages: of /tf and /tf_static, the older first.

    Raises:
        InvalidInput: if one is no such message.
    """

    def __init__(self, messages: Iterable[Mapping[str, Any]]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for each in decode(_Message, message, "transforms").transforms:
                at, q = each.transform.translation, each.transform.rotation
                child = _plain(each.child_frame_id)
                quaternion = np.array([q.w, q.x, q.y, q.z])
                pose = Pose(np.array([at.x, at.y, at.z]), unit_quaternion(quaternion, f"rotation of frame {child}"))
                self._parents[child] = _plain(each.header.frame_id), pose

    def pose(self, frame: str, within: str) -> Pose:
        """`T_within_frame`, along the parents that both have.

        Raises:
            UnknownName: if nothing leads from one to the other.
        """
        one, other = self._ways(_plain(frame)), self._ways(_plain(within))
        for ancestor, T_ancestor_frame in one.items():
            if ancestor in other:
                return other[ancestor].inverse() @ T_ancestor_frame
        raise UnknownName(f"frame that leads to {within}", frame, self._parents)

    def _ways(self, frame: str) -> dict[str, Pose]:
        """`T_ancestor_frame` of a frame's ancestors, itself included, the nearest first."""
        ways, pose = {frame: Pose.identity()}, Pose.identity()
        while frame in self._parents:
            frame, T_parent_child = self._parents[frame]
            if frame in ways:  # a circle, which tells nothing
                break
            pose = T_parent_child @ pose
            ways[frame] = pose
        return ways


def _plain(frame: str) -> str:
    return frame.removeprefix("/")
