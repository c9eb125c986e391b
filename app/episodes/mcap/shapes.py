"""Foxglove's messages for times, poses and shapes. Its quaternions are (x, y, z, w), its colours RGBA in [0, 1]."""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove.messages import (
    Color,
    FrameTransform,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Quaternion,
    SceneEntity,
    Timestamp,
    TriangleListPrimitive,
    Vector3,
)
from foxglove.messages import Pose as PoseMessage
from jaxtyping import Float

from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import STEP_S
from osfcore.objects.asset import TexturedMesh

Rgba = tuple[float, float, float, float]
_NANOSECONDS = 1_000_000_000
_LINE_PX = 2.0


def time_ns(action: int) -> int:
    """Simulated time after some actions [ns]."""
    return round(action * STEP_S * _NANOSECONDS)


def stamp(action: int) -> Timestamp:
    """The same as messages have it."""
    return Timestamp(*divmod(time_ns(action), _NANOSECONDS))


def transform(child: str, pose: Pose, action: int) -> FrameTransform:
    """`T_world_child`, after some actions."""
    w, x, y, z = pose.quaternion.tolist()
    return FrameTransform(
        timestamp=stamp(action), parent_frame_id="world", child_frame_id=child,
        translation=vector(*pose.position.tolist()), rotation=Quaternion(x=x, y=y, z=z, w=w),
    )  # fmt: skip


def entity(name: str, frame: str, action: int = 0, **primitives: Any) -> SceneEntity:  # noqa: ANN401  lists of theirs
    """Shapes that move with a frame, from after some actions on."""
    return SceneEntity(id=name, frame_id=frame, frame_locked=True, timestamp=stamp(action), **primitives)


def triangles(mesh: TexturedMesh, colour: Rgba | None = None) -> TriangleListPrimitive:
    """A mesh in its own frame, in one colour or in those that its texture has at the vertices.

    Triangles rather than embedded glTF, of which viewers disagree which axis is up.
    """
    points, indices = _points(mesh.vertices), mesh.faces.reshape(-1).tolist()
    if colour is not None:
        return TriangleListPrimitive(pose=at_origin(), points=points, indices=indices, color=colour_of(colour))
    height, width = mesh.texture.shape[:2]
    columns = (mesh.uv[:, 0] * (width - 1)).round().astype(int)
    rows = ((1 - mesh.uv[:, 1]) * (height - 1)).round().astype(int)
    colours = [colour_of((r, g, b, 1.0)) for r, g, b in (mesh.texture[rows, columns] / 255).tolist()]
    return TriangleListPrimitive(pose=at_origin(), points=points, indices=indices, colors=colours)


def line(positions: Float[np.ndarray, "P 3"], colour: Rgba) -> LinePrimitive:
    """A polyline."""
    return LinePrimitive(
        type=LinePrimitiveLineType.LineStrip, pose=at_origin(), thickness=_LINE_PX, scale_invariant=True,
        points=_points(positions), color=colour_of(colour),
    )  # fmt: skip


def at_origin(height_m: float = 0.0) -> PoseMessage:
    """A pose at the frame's origin, or above it."""
    return PoseMessage(position=vector(0.0, 0.0, height_m), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def vector(x: float, y: float, z: float) -> Vector3:
    """A vector, or sizes along the axes."""
    return Vector3(x=x, y=y, z=z)


def colour_of(rgba: Rgba) -> Color:
    """A colour."""
    r, g, b, a = rgba
    return Color(r=r, g=g, b=b, a=a)


def _points(positions: Float[np.ndarray, "P 3"]) -> list[Point3]:
    return [Point3(x=x, y=y, z=z) for x, y, z in positions.tolist()]
