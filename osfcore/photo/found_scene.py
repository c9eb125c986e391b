"""The contents of a photograph as JSON, in the table's frame if the table is known, else in the camera's frame.

    {"table": "board" | "objects" | null,
     "objects": [{"name", "position": [3], "quaternion": [w, x, y, z], "loss", "iou", "probability", "doubt",
                  "outline", "rivals": [{"position", "quaternion", "loss", "iou", "probability"}]}],
     "light": {"direction": [3], "std_deg", "diffuse", "distance_m", "distance_std_m"},
     "camera": {"name", "T_world_camera": 4x4, "K": 3x3, "width", "height"}, "other_cameras": [...], "notes": [...]}

"table" names what the table was found from. "light" is null if too few pixels show objects. "outline" is of the mask in
the first photo, as it was found.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from osfcore.geometry.poses import Pose
from osfcore.io.json_codec import Entry, Text, Vector2, Vector3, Vector4
from osfcore.io.scene_file import CameraJson

TableSource = Literal["board", "objects"]


class FoundPose(Entry):
    """A pose, and how well it explains the photograph."""

    position: Vector3 = Field(description="Position [m].")
    quaternion: Vector4 = Field(description="Unit quaternion (w, x, y, z).")
    loss: float = Field(description="Loss of outline, shading and texture; lower is better.")
    iou: float = Field(description="Intersection over union of outline and mask; 1 if they agree.")
    probability: float | None = Field(None, description="That the object is turned like this, within 10 degrees.")

    def pose(self) -> Pose:
        """Return the pose."""
        return Pose(np.array(self.position), np.array(self.quaternion))


class FoundObject(FoundPose):
    """An object in its most likely pose."""

    name: Text
    doubt: str = Field(description="Why the pose should not be trusted, in one sentence; empty if it can be.")
    rivals: list[FoundPose] = Field(description="Other orientations that explain the photo, the best first.")
    outline: list[list[Vector2]] = Field(
        [], description="Closed polygons around its mask as it was found with the pose, in the first photo [px]."
    )

    def poses(self) -> tuple[FoundPose, ...]:
        """Return the best pose, then its rivals."""
        return self, *self.rivals


class FoundLight(Entry):
    """The lamp."""

    direction: Vector3 = Field(description="Unit vector toward the lamp.")
    std_deg: float = Field(description="Standard deviation of the direction [deg].")
    diffuse: bool = Field(description="True if the photo shows no single lamp; the direction is then unreliable.")
    distance_m: float | None = Field(description="Distance from the frame's origin [m]; null if it is unknown.")
    distance_std_m: float | None = Field(description="Standard deviation of the distance [m].")


class FoundScene(Entry):
    """Everything that was found in a photograph."""

    table: TableSource | None
    objects: list[FoundObject]
    light: FoundLight | None
    camera: CameraJson
    other_cameras: list[CameraJson] = Field([], description="Cameras of further photos.")
    notes: list[str]
