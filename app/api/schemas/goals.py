"""Requests and responses that concern goals."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field, model_validator

from app.api.schemas.common import Input, LightIn, ObjectPose, SceneObject, Seed
from app.api.schemas.limits import GOAL_NAME, NAME, OBJECTS, sized, within
from app.api.schemas.paging import PageOut
from app.services.goals import Draft
from app.storage.goal_store import GoalRecord, Source
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


class GoalOut(BaseModel):
    """A goal image that is kept."""

    id: str
    name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    source: Source = Field(description="An uploaded photo, a layout by hand, or a random one.")
    scene: str | None = Field(description="That it was made from; null for an upload.")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")
    camera: CameraJson = Field(description="That took the image.")
    objects: list[ObjectJson] | None = Field(description="Where they are in the image; null where nobody knows.")

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
        )


class GoalList(PageOut):
    """Goals, newest first."""

    goals: list[GoalOut]


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
