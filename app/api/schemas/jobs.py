"""Requests and responses that concern jobs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, model_validator

from app.api.schemas.common import ImageSize, Input, ObjectName, Seed
from app.api.schemas.limits import (
    FETCHED,
    IMAGES,
    NAME,
    OBJECTS,
    PUSH_EPISODES,
    PUSH_STEPS,
    TRAINING_MINUTES,
    sized,
    within,
)
from app.api.schemas.paging import JobPageOut
from app.jobs.job import Job, State
from app.jobs.kinds import KindName
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE
from osfcore.paper.method import Method


class CollectPushesParams(Input):
    """Episodes of random pushes for learning dynamics, as one HDF5 file."""

    episodes: int = Field(1000, **within(PUSH_EPISODES))
    steps: int = Field(50, **within(PUSH_STEPS), description="Actions of 0.2 s an episode.")
    objects: int = Field(3, **within(OBJECTS), description="Objects a scene, drawn at random.")
    policy: Literal["paper", "directed"] = Field(
        "paper", description="Uniform random velocities, or a pusher that seeks sustained contact."
    )
    seed: Seed = 0
    images: bool = Field(False, description="Keep frames of camera 0 as well.")


class CollectTableParams(Input):
    """Images of the bare table under many lights."""

    images: int = Field(300, **within(IMAGES))
    size: ImageSize = DEFAULT_IMAGE_SIDE
    seed: Seed = 0


class CollectObjectParams(CollectTableParams):
    """Images of one object from all sides under many lights."""

    name: ObjectName


class FetchAssetsParams(Input):
    """Objects to fetch from the package index."""

    names: list[ObjectName] = Field(default=[], **sized(FETCHED), description="Empty for all that it has.")


class FieldSource(Input):
    """What to learn a field from: a mesh, of which images are then taken first, or an uploaded image set."""

    mesh: ObjectName | None = Field(None, description="An object whose mesh is on this machine.")
    set: str | None = Field(None, **sized(NAME), description="Identifier of an uploaded image set.")

    @model_validator(mode="after")
    def _names_one(self) -> FieldSource:
        if (self.mesh is None) == (self.set is None):
            raise ValueError("give either mesh or set")
        return self


class TrainFieldParams(Input):
    """A field to train. It replaces one of this name only if it is no worse on the same held-out images.

    But for one as published: that takes the place of an earlier one as published, and never that of ours.
    """

    name: ObjectName = Field(description="Of the field; scenes need a mesh of the same name.")
    source: FieldSource
    minutes: float = Field(30, **within(TRAINING_MINUTES), description="How long to train [min].")
    seed: Seed = 0
    images: int = Field(300, **within(IMAGES), description="Images to take of a mesh; a set has its own.")
    hollow: bool = Field(False, description="The object has hollows that no silhouette shows, such as a bowl's.")
    method: Method = Field(
        "ours",
        description='Whose field: "ours", or "paper", a KiloOSF as published, which is kept beside ours, uncompared.',
    )

    @model_validator(mode="after")
    def _fits(self) -> TrainFieldParams:
        if self.method == "paper" and self.hollow:
            raise ValueError("hollow is of our method alone; leave it out with the one as published")
        return self


class CollectPushesJob(Input):
    """Collect pushes."""

    kind: Literal["collect_pushes"]
    params: CollectPushesParams = CollectPushesParams()  # pyright: ignore[reportCallIssue]


class CollectObjectJob(Input):
    """Collect images of an object."""

    kind: Literal["collect_object"]
    params: CollectObjectParams


class CollectTableJob(Input):
    """Collect images of the table."""

    kind: Literal["collect_table"]
    params: CollectTableParams = CollectTableParams()  # pyright: ignore[reportCallIssue]


class FetchAssetsJob(Input):
    """Fetch objects."""

    kind: Literal["fetch_assets"]
    params: FetchAssetsParams = FetchAssetsParams()


class TrainFieldJob(Input):
    """Train a field."""

    kind: Literal["train_field"]
    params: TrainFieldParams


JobIn = Annotated[
    CollectPushesJob | CollectObjectJob | CollectTableJob | FetchAssetsJob | TrainFieldJob, Field(discriminator="kind")
]


class JobOut(BaseModel):
    """A job as it is now."""

    id: str
    kind: KindName
    params: dict[str, Any]
    state: State
    position: int | None = Field(description="Place in the queue, 1 is next; null when not queued.")
    done: int = Field(description="Units finished.")
    total: int = Field(description="Units in all; 0 before it is known.")
    note: str
    eta_s: float | None = Field(description="Estimated time left [s].")
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: str | None
    result: dict[str, Any] | None
    files: list[str] = Field(description="Names to download from /api/jobs/{id}/files/{name}.")

    @staticmethod
    def of(job: Job) -> JobOut:
        """From the registry's job."""
        return JobOut.model_validate(job, from_attributes=True)


class JobList(JobPageOut):
    """Jobs, newest first."""

    jobs: list[JobOut]
