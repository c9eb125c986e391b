"""Shapes that several requests and responses of the REST interface share.

Lengths in metres, time in seconds, quaternions (w, x, y, z), world z up with the table top at z = 0. OpenAPI states
the bounds. The page writes some down again, in static/index.html and static/js; a test compares.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from osfcore.control.events import MAX_STEPS
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.objects.fetch import MAX_TEXT

from ..jobs.params import Identifier, ObjectName

VISITOR = "[A-Za-z0-9_-]+"

# Texts
DisplayName = Annotated[str, Field(min_length=1, max_length=100)]  # for people: of goals, photos, episodes
Label = Annotated[str, Field(max_length=MAX_TEXT)]  # for people: of objects, and their licences
FileName = Annotated[str, Field(max_length=200)]
Visitor = Annotated[Identifier, Field(pattern=f"^{VISITOR}$")]  # what a page calls itself

# Numbers
Pixel = Annotated[FiniteFloat, Field(ge=0, le=100_000)]
Box = Annotated[list[Pixel], Field(min_length=4, max_length=4, description="Left, top, right, bottom [px].")]

# Settings of an episode, least and most
STEPS = (1, MAX_STEPS)
SAMPLES = (8, MAX_SEQUENCES)
HORIZON = (1, MAX_HORIZON)
Steps = Annotated[int, Field(ge=STEPS[0], le=STEPS[1])]
Samples = Annotated[int, Field(ge=SAMPLES[0], le=SAMPLES[1])]
Horizon = Annotated[int, Field(ge=HORIZON[0], le=HORIZON[1])]

# Places
Vector3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Component = Annotated[FiniteFloat, Field(ge=-1.1, le=1.1)]
_Coordinate = Annotated[FiniteFloat, Field(ge=-100, le=100)]  # far beyond any table, but its square does not overflow
Quaternion = Annotated[list[_Component], Field(min_length=4, max_length=4, description="Unit quaternion (w, x, y, z).")]
Position = Annotated[list[_Coordinate], Field(min_length=3, max_length=3, description="[m], world frame.")]
Velocity = Annotated[
    Vector3, Field(description="Pusher velocity (vx, vy, 0) [m/s], |vx| and |vy| at most 0.3, held for 0.2 s.")
]


class Input(BaseModel):
    """What comes in: unknown fields and wrong types are mistakes."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Excerpt(BaseModel):
    """Part of a file or answer that holds more than is needed here; the rest is left alone."""

    model_config = ConfigDict(extra="ignore", strict=True)


class LightIn(Input):
    """A distant light; only its direction counts."""

    position: Position = Field(
        description="From the table's centre toward the light [m]; brought to length 1; at least 5 deg up.",
        examples=[[0.3, -0.4, 0.8]],
    )

    def light(self) -> Light:
        """The light; raises InvalidInput if it is too low."""
        return Light(np.array(self.position))


class ObjectPose(Input):
    """Where one object is, or shall be."""

    name: ObjectName
    position: Position
    quaternion: Quaternion

    def named_pose(self) -> tuple[str, Pose]:
        """Name and pose, unchecked."""
        return self.name, Pose(np.array(self.position), np.array(self.quaternion))


ObjectNames = Annotated[list[ObjectName], Field(min_length=1, max_length=MAX_OBJECTS)]
Poses = Annotated[list[ObjectPose], Field(min_length=1, max_length=MAX_OBJECTS)]
SceneRef = Annotated[Identifier | None, Field(None, description="Identifier; null for the scene that is shown.")]
