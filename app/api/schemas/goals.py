"""Requests and responses that concern goals."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from pydantic import BaseModel, Field, model_validator

from app.api.schemas.common import Input, LightIn, ObjectPose, SceneObject, Seed
from app.api.schemas.limits import GOAL_NAME, NAME, OBJECTS, sized, within
from app.api.schemas.paging import DamagedOut, PageOut
from app.services.goals.goal_checks import GoalCheck, GoalVerdict
from app.services.goals.goals import Draft
from app.storage.photos import PhotoCrop
from app.storage.records import GoalRecord, Source
from osfcore.geometry.poses import Pose
from osfcore.io.scene_file import CameraJson, ObjectJson

GoalName = Annotated[str, Field(**sized(GOAL_NAME), description="For people.")]
SceneRef = Annotated[
    str | None, Field(None, **sized(NAME), description="Identifier; null for the scene that is shown.")
]
Poses = Annotated[list[ObjectPose], Field(**sized(OBJECTS))]


class RandomLayout(Input):
    """Some objects elsewhere, each 7.5 to 20 cm away."""

    seed: Seed = 0
    moved: int | None = Field(None, **within(OBJECTS), description="How many; null as the seed will have it.")


class GoalIn(Input):
    """A goal image made in the simulation, of objects that lie elsewhere."""

    scene: SceneRef
    objects: Poses | None = Field(None, description="Those that lie elsewhere; they come to rest as if let go.")
    random: RandomLayout | None = Field(None, description="Instead of objects.")
    light: LightIn | None = Field(None, description="In which the image is taken; null for the scene's.")
    name: GoalName = "Goal"

    @model_validator(mode="after")
    def _says_one(self) -> GoalIn:
        if (self.objects is None) == (self.random is None):
            raise ValueError("give either objects or random")
        return self


class DraftIn(Input):
    """Which scene's objects shall be laid out."""

    scene: SceneRef


class DraftPatch(Input):
    """Objects of the draft that shall lie elsewhere."""

    objects: Poses

    def named_poses(self) -> tuple[tuple[str, Pose], ...]:
        """Names and poses, unchecked."""
        return tuple(entry.named_pose() for entry in self.objects)


class DraftKeep(Input):
    """How the goal is called."""

    name: GoalName = "Composed"


class CropIn(Input):
    """A rectangle of the photo that becomes the goal image, in pixels of the photo as it was sent."""

    left: float = Field(allow_inf_nan=False, description="Before it is turned [px].")
    top: float = Field(allow_inf_nan=False, description="Before it is turned [px].")
    width: float = Field(allow_inf_nan=False, description="Its height follows from the camera's proportions [px].")
    turn_deg: float = Field(0.0, allow_inf_nan=False, description="Clockwise about its centre.")

    def crop(self) -> PhotoCrop:
        """Unchecked."""
        return PhotoCrop(self.left, self.top, self.width, self.turn_deg)


class GoalPatch(Input):
    """Another part of the photo."""

    crop: CropIn


class CropOut(BaseModel):
    """The rectangle of the photo that is the goal image [px, degrees]."""

    left: float
    top: float
    width: float
    turn_deg: float


class PhotoOut(BaseModel):
    """The photo that a goal image was cut out of."""

    width: int = Field(description="As it was sent [px].")
    height: int = Field(description="As it was sent [px].")
    crop: CropOut


class GoalCheckOut(BaseModel):
    """Whether a goal can be one for a table."""

    verdict: GoalVerdict = Field(
        description='"bare": nothing is on the table; "elsewhere": not the table as its camera would see it; '
        '"others": not these objects.'
    )
    refused: bool = Field(description="Whether episodes refuse it unless they are told to go on despite doubts.")
    text: str = Field(description="What is wrong and what to do; empty if nothing is.")
    scene: str | None = Field(description="The table that it was made for, if that is another one and still there.")

    @staticmethod
    def of(check: GoalCheck) -> GoalCheckOut:
        """From the service's own."""
        return GoalCheckOut(verdict=check.verdict, refused=check.is_refused, text=check.text, scene=check.scene)


class GoalOut(BaseModel):
    """A goal image that is kept."""

    id: str
    name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    source: Source = Field(
        description="An uploaded photo, a layout by hand or at random, or found in a photo of a table."
    )
    scene: str | None = Field(description="That it was made from; null for an upload.")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")
    camera: CameraJson = Field(description="That took the image.")
    objects: list[ObjectJson] | None = Field(description="Where they are in the image; null where nobody knows.")
    photo: PhotoOut | None = Field(description="That the image was cut out of; null if it was made here.")

    @staticmethod
    def of(record: GoalRecord) -> GoalOut:
        """From the record on disk."""
        return GoalOut(
            id=record.id,
            name=record.name,
            created_at=record.created_at,
            source=record.source,
            scene=record.scene,
            width=record.camera.width,
            height=record.camera.height,
            camera=CameraJson.of(record.camera),
            objects=None if record.poses is None else [ObjectJson.of(*placed) for placed in record.poses],
            photo=None if record.photo is None else PhotoOut.model_validate(asdict(record.photo)),
        )


class GoalList(PageOut):
    """Goals, newest first."""

    goals: list[GoalOut]
    damaged: list[DamagedOut] = Field(description="What can only be deleted, on each page.")


class DraftOut(BaseModel):
    """A goal that is being composed, the same for all visitors."""

    scene: str
    objects: list[SceneObject]
    problem: str = Field(description="Why the objects cannot be there; empty if they can.")
    revision: int = Field(description="Grows with every change.")

    @staticmethod
    def of(draft: Draft, labels: dict[str, str]) -> DraftOut:
        """From the service's own."""
        objects = [SceneObject.labelled(name, pose, labels) for name, pose in draft.poses]
        return DraftOut(scene=draft.scene, objects=objects, problem=draft.problem, revision=draft.revision)
