"""Requests and responses of the REST interface; the one place where core dataclasses become JSON.

Lengths in metres, time in seconds, quaternions (w, x, y, z), world z up with the table top at z = 0.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from app.api.schemas.limits import (
    ACTIONS,
    COORDINATE_M,
    IMAGE_SIDE,
    NAME,
    OBJECTS,
    QUATERNION_COMPONENT,
    SEED,
    sized,
    within,
)
from app.api.schemas.paging import PageOut
from app.processes.messages.scene_messages import SceneRecord
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.io.scene_file import CameraJson, ObjectJson, PointJson
from osfcore.objects.asset import ObjectInfo

Component = Annotated[FiniteFloat, Field(**within(QUATERNION_COMPONENT))]
Coordinate = Annotated[FiniteFloat, Field(**within(COORDINATE_M))]
Quaternion = Annotated[list[Component], Field(min_length=4, max_length=4, description="Unit quaternion (w, x, y, z).")]
Position = Annotated[list[Coordinate], Field(min_length=3, max_length=3, description="[m], world frame.")]
Vector3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Velocity = Annotated[
    Vector3, Field(description="Pusher velocity (vx, vy, 0) [m/s], |vx| and |vy| at most 0.3, held for 0.2 s.")
]
ImageSize = Annotated[int, Field(**within(IMAGE_SIDE), description="Side of the square images [px].")]
Seed = Annotated[int, Field(**within(SEED))]
ObjectName = Annotated[str, Field(**sized(NAME), examples=["006_mustard_bottle"])]


class Input(BaseModel):
    """What comes in: unknown fields and wrong types are mistakes."""

    model_config = ConfigDict(extra="forbid", strict=True)


class ProblemPointer(BaseModel):
    """One thing that is wrong with a request."""

    pointer: str | None = Field(default=None, description="JSON pointer into the request body.")
    parameter: str | None = Field(default=None, description="Name of the path, query or header parameter.")
    detail: str


class Problem(BaseModel):
    """An error, as in RFC 9457."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = Field(description="One sentence for a person.")
    errors: list[ProblemPointer] | None = None


class Health(BaseModel):
    """Whether and how the service runs."""

    status: Literal["ok", "degraded"]
    problems: list[str] = Field(description="What is wrong now, a sentence each; it goes when its cause is gone.")
    version: str
    uptime_s: float = Field(description="Since the start [s].")
    objects_available: int
    stage: Literal["starting", "ready", "restarting"] = Field(description="The process that simulates.")


class SymmetryOut(BaseModel):
    """Which rotations an eye cannot tell apart."""

    kind: Literal["none", "discrete", "continuous"]
    reason: str


class ObjectOut(BaseModel):
    """An object of the catalogue or one that a user added."""

    name: str
    label: str
    mass_kg: float = Field(description="[kg]")
    size_m: Vector3 | None = Field(description="Extents of the bounding box [m]; null until it has been fetched.")
    symmetry: SymmetryOut
    licence: str
    attribution: str
    available: bool = Field(description="Whether it is on this machine and can be used in scenes.")
    own: bool = Field(description="Whether it was added here, and can be deleted.")
    fetchable: bool = Field(description="Whether a job of the kind fetch_assets can bring it here.")
    version: str | None = Field(description="Changes with its looks and facts; null until it is on this machine.")

    @staticmethod
    def of(
        info: ObjectInfo, size_m: np.ndarray | None, version: str | None, *, is_own: bool, is_fetchable: bool
    ) -> ObjectOut:
        """From catalogue facts.

        Args:
            info: the facts.
            size_m: extents of the bounding box [m]; None if it is not on this machine.
            version: what changes with it.
            is_own: whether a user added it.
            is_fetchable: whether the package index has it.
        """
        return ObjectOut(
            name=info.name,
            label=info.label,
            mass_kg=info.mass_kg,
            size_m=None if size_m is None else size_m.tolist(),
            symmetry=SymmetryOut(kind=info.symmetry.kind, reason=info.symmetry.reason),
            licence=info.licence,
            attribution=info.attribution,
            available=size_m is not None,
            own=is_own,
            fetchable=is_fetchable,
            version=version,
        )


class ObjectList(BaseModel):
    """All known objects."""

    objects: list[ObjectOut]


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


class SceneIn(Input):
    """What a new scene shall contain; everything left out is drawn from the seed."""

    objects: list[ObjectName] | None = Field(None, **sized(OBJECTS), description="Which objects.")
    count: int = Field(3, **within(OBJECTS), description="How many objects, where they are not named.")
    seed: Seed | None = Field(None, description="The same seed gives the same scene; null for any.")
    light: LightIn | None = None
    poses: list[ObjectPose] | None = Field(
        None, **sized(OBJECTS), description="Exact poses, instead of random resting ones."
    )
    image_size: ImageSize = DEFAULT_IMAGE_SIDE


class ScenePatch(Input):
    """What to move by hand, all or nothing."""

    light: LightIn | None = None
    objects: list[ObjectPose] | None = Field(None, max_length=OBJECTS[1])


class ActionsIn(Input):
    """Velocities of the pusher, one after the other."""

    actions: list[Velocity] = Field(**sized(ACTIONS), examples=[[[0.2, 0.0, 0.0]]])


class SceneObject(ObjectJson):
    """An object on the table."""

    label: str

    @staticmethod
    def labelled(name: str, pose: Pose, labels: dict[str, str]) -> SceneObject:
        """An object with its label.

        Args:
            name: of the object.
            pose: T_world_object [m].
            labels: by name; an object without one is called by its name.
        """
        return SceneObject(**dict(ObjectJson.of(name, pose)), label=labels.get(name, name))


class SceneOut(BaseModel):
    """A scene as it is now."""

    id: str
    seed: int
    created_at: str = Field(description="UTC, ISO 8601.")
    is_current: bool = Field(description="Whether it is the one that viewer and page show.")
    time_s: float = Field(description="Simulated time since creation or reset [s].")
    objects: list[SceneObject]
    light: PointJson
    pusher: PointJson | None = Field(description="Centre of the pusher.")
    cameras: list[CameraJson]
    image_size: int = Field(description="[px]")
    revision: int = Field(description="Grows with every change.")

    @staticmethod
    def of(record: SceneRecord, labels: dict[str, str], *, is_current: bool) -> SceneOut:
        """From the simulation's record.

        Args:
            record: of the scene.
            labels: of objects, by name.
            is_current: whether viewer and page show this scene.
        """
        state = record.state
        return SceneOut(
            id=record.id,
            seed=record.seed,
            created_at=record.created_at,
            is_current=is_current,
            time_s=round(record.time_s, 6),
            objects=[SceneObject.labelled(name, state.pose(name), labels) for name in state.names],
            light=PointJson.of(state.light.position),
            pusher=None if state.pusher is None else PointJson.of(state.pusher),
            cameras=_cameras(record.image_size),
            image_size=record.image_size,
            revision=record.revision,
        )


@cache  # every scene tells its cameras
def _cameras(size: int) -> list[CameraJson]:
    return [CameraJson.of(camera) for camera in (*default_cameras(size), goal_camera(size))]


class SceneList(PageOut):
    """All scenes, oldest first."""

    scenes: list[SceneOut]
    current: str | None = Field(description="Identifier of the scene that is shown.")


class FrameEvent(BaseModel):
    """Live images, the data of a "frame" event."""

    scene: str
    revision: int
    cameras: dict[str, str] = Field(description="Camera name to JPEG data URL.")


Points = list[tuple[float, float]]


class ObjectOutlinesOut(BaseModel):
    """An object in one picture; coordinates are shares of its width and height."""

    name: str
    best: Points = Field(description="Outline of where it is taken to be; empty for what was not looked at yet.")
    tried: list[Points] = Field(description="The same of some candidates.")


class LookEvent(BaseModel):
    """An estimator at work, the data of a "look" event."""

    look: Literal["first", "goal", "next", "search"] = Field(description="At what: first frame, goal image, ...")
    share: float = Field(description="Of the work that is done.")
    loss: float | None = Field(description="Of the whole, in units of its stage.")
    difference: float | None = Field(
        description="Of the rendered scene from the images: root of the mean square over all pixels, 0 to 1."
    )
    stage: str = Field(description="Of the method; losses of one stage can be compared.")
    is_over: bool = Field(description="Whether this is the result.")
    light_deg: tuple[float, float] = Field(description="Azimuth and elevation of the light so far.")
    cameras: dict[str, list[ObjectOutlinesOut]] = Field(description='By camera; "goal" is the goal image.')
    pictures: dict[str, str] = Field(
        default_factory=dict, description="The best scene so far as each camera would see it: JPEG data URLs."
    )


class ForgottenEvent(BaseModel):
    """A job was removed for good, the data of a "forgotten" event."""

    job: str


class NoticeEvent(BaseModel):
    """A sentence for whoever watches, the data of a "notice" event."""

    level: Literal["info", "warning", "error"]
    text: str
