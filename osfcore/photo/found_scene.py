"""What was found in a photograph as JSON, in the table's frame where there is one, else in the camera's.

    {"table": "board" | "objects" | null,
     "objects": [{"name", "position": [3], "quaternion": [w, x, y, z], "loss", "iou", "doubt",
                  "rivals": [{"position", "quaternion", "loss", "iou"}]}],
     "light": {"direction": [3], "std_deg", "diffuse", "distance_m", "distance_std_m"},
     "camera": {"name", "T_world_camera": 4x4, "K": 3x3, "width", "height"}, "other_cameras": [...], "notes": [...]}

"board" and "objects" say how the table was found. "light" is null where too few pixels show objects.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from osfcore.geometry.poses import Pose
from osfcore.io.json_codec import Entry, Text, Vector3, Vector4
from osfcore.io.scene_file import CameraJson

TableSource = Literal["board", "objects"]


class FoundPose(Entry):
    """A pose, and how well it explains the photograph."""

    position: Vector3 = Field(description="[m]")
    quaternion: Vector4 = Field(description="Unit quaternion (w, x, y, z).")
    loss: float = Field(description="Of outline, shading and texture; less is better.")
    iou: float = Field(description="Of the outline and the mask, 1 where they agree.")

    def pose(self) -> Pose:
        """Return the pose."""
        return Pose(np.array(self.position), np.array(self.quaternion))


class FoundObject(FoundPose):
    """An object in its most likely pose."""

    name: Text
    doubt: str = Field(description="Why it should not be trusted, a sentence; empty where it may be.")
    rivals: list[FoundPose] = Field(description="Other orientations that explain the picture, the best first.")

    def poses(self) -> tuple[FoundPose, ...]:
        """Return the best pose, then its rivals."""
        return self, *self.rivals


class FoundLight(Entry):
    """The lamp."""

    direction: Vector3 = Field(description="Unit vector toward it.")
    std_deg: float = Field(description="Standard deviation of the direction.")
    diffuse: bool = Field(description="Nothing speaks for one lamp; the direction then means little.")
    distance_m: float | None = Field(description="From the frame's origin; null where it cannot be told.")
    distance_std_m: float | None = Field(description="Its standard deviation.")


class FoundScene(Entry):
    """Everything that was found in a photograph."""

    table: TableSource | None
    objects: list[FoundObject]
    light: FoundLight | None
    camera: CameraJson
    other_cameras: list[CameraJson] = Field([], description="Of further photos.")
    notes: list[str]
