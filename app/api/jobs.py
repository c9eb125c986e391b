"""Long work: start, follow, pause, cancel, download."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Depends, Path, Response
from pydantic import BaseModel, Field, model_validator

from app.api.bodies import FORGOTTEN, PNG, BoundedRoute, Forget, OpenFile, binary
from app.api.dependencies import ServicesDep, urgent
from app.api.models import Identifier, ImageCount, ImageSize, Input, ObjectCount, ObjectName, Seed
from app.api.paging import DEFAULT_PAGE, AfterJob, JobPageOut, Limit
from app.api.problems import named_in_path, problems
from app.jobs.job import Job, State, check_file_name
from app.jobs.kinds import KindName
from app.jobs.kinds.fields import COMPARISON, PREVIEW
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE
from osfcore.paper.method import Method


class CollectPushesParams(Input):
    """Episodes of random pushes for learning dynamics, as one HDF5 file."""

    episodes: int = Field(1000, ge=1, le=100_000)
    steps: int = Field(50, ge=1, le=1000, description="Actions of 0.2 s an episode.")
    objects: ObjectCount = Field(3, description="Objects a scene, drawn at random.")
    policy: Literal["paper", "directed"] = Field(
        "paper", description="Uniform random velocities, or a pusher that seeks sustained contact."
    )
    seed: Seed = 0
    images: bool = Field(False, description="Keep frames of camera 0 as well.")


class CollectTableParams(Input):
    """Images of the bare table under many lights."""

    images: ImageCount = 300
    size: ImageSize = DEFAULT_IMAGE_SIDE
    seed: Seed = 0


class CollectObjectParams(CollectTableParams):
    """Images of one object from all sides under many lights."""

    name: ObjectName


class FetchAssetsParams(Input):
    """Objects to fetch from the package index."""

    names: list[ObjectName] = Field(default=[], max_length=64, description="Empty for all that it has.")


class FieldSource(Input):
    """What to learn a field from: a mesh, of which images are then taken first, or an uploaded image set."""

    mesh: ObjectName | None = Field(None, description="An object whose mesh is on this machine.")
    set: Identifier | None = Field(None, description="Identifier of an uploaded image set.")

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
    minutes: float = Field(30, ge=0.1, le=1440, description="How long to train [min].")
    seed: Seed = 0
    images: ImageCount = Field(300, description="Images to take of a mesh; a set has its own.")
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


class ProgressOut(BaseModel):
    """How far a job is whose nouns are others: an episode, an estimate."""

    id: str
    status: State
    position: int | None = Field(description="Place in the queue, 1 is next; null when not queued.")
    note: str
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: str | None


def progress_of(job: Job) -> dict[str, Any]:
    """The fields of `ProgressOut`."""
    return {"status": job.state, **{name: getattr(job, name) for name in ProgressOut.model_fields if name != "status"}}


class JobList(JobPageOut):
    """Jobs, newest first."""

    jobs: list[JobOut]


router = APIRouter(prefix="/api/jobs", tags=["jobs"], responses=problems(), route_class=BoundedRoute)
_FILE = binary("The file.", "application/octet-stream")


async def _known_job(services: ServicesDep, job: Annotated[str, Path(description="Identifier of a job.")]) -> Job:
    with named_in_path():
        return services.runner.jobs.get(job)


FoundDep = Annotated[Job, Depends(_known_job)]


@router.post("", status_code=202, responses=problems(409, 429, 507))
def create(services: ServicesDep, body: Annotated[JobIn, Body()], response: Response) -> JobOut:
    """Queue a job; one runs at a time. Outputs go to the data directory's collections/ID."""
    job = services.runner.submit_job(body.kind, body.params.model_dump())
    response.headers["Location"] = f"/api/jobs/{job.id}"
    return JobOut.of(job)


@router.get("")
async def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterJob = None) -> JobList:
    """List jobs, newest first."""
    page = services.runner.jobs.page(limit, after)
    return JobList(jobs=[JobOut.of(job) for job in page.jobs], total=page.total, next=page.next)


@router.get("/{job}", responses=problems(404))
async def get(job: FoundDep) -> JobOut:
    """Tell how a job is."""
    return JobOut.of(job)


@router.delete("/{job}", response_model=JobOut, responses={**problems(404, 409, 507), **FORGOTTEN})
@urgent
def cancel(services: ServicesDep, job: FoundDep, forget: Forget = False) -> JobOut | Response:
    """Take a job out of the queue or end it; what it has made is removed. It stays listed as cancelled."""
    if forget:
        services.runner.forget_job(job.id)
        return Response(status_code=204)
    return JobOut.of(services.runner.jobs.cancel(job.id))


@router.post("/{job}/pause", responses=problems(404, 409))
@urgent
def pause(services: ServicesDep, job: FoundDep) -> JobOut:
    """Let a running job rest after its current step. It keeps its turn."""
    return JobOut.of(services.runner.jobs.pause(job.id))


@router.post("/{job}/resume", responses=problems(404, 409))
@urgent
def resume(services: ServicesDep, job: FoundDep) -> JobOut:
    """Let a paused job go on."""
    return JobOut.of(services.runner.jobs.resume(job.id))


@router.get("/{job}/files/{name}", response_class=Response, responses={**problems(404), **_FILE})
def file(
    services: ServicesDep, job: FoundDep, name: Annotated[str, Path(description="One of the job's files.")]
) -> OpenFile:
    """Download what a job has made."""
    with named_in_path():
        path = services.runner.jobs.folder(job.id) / check_file_name(job, name)
    gone = f"{name} of this job has been removed from the data directory."
    return OpenFile(path, gone, media_type="application/octet-stream", filename=name)


@router.get("/{job}/preview.png", response_class=Response, responses={**problems(404), **PNG})
def preview(services: ServicesDep, job: FoundDep) -> OpenFile:
    """Show one unseen image of a field in training: the truth, the field's, and their difference times four."""
    path = services.runner.jobs.folder(job.id) / PREVIEW
    gone = "This job has no preview; training a field makes one, some seconds after it has begun."
    return OpenFile(path, gone, media_type="image/png", headers={"Cache-Control": "no-store"})


@router.get("/{job}/comparison.png", response_class=Response, responses={**problems(404), **PNG})
def comparison(services: ServicesDep, job: FoundDep) -> OpenFile:
    """Show held-out images beside what the former and the new field make of them."""
    path = services.runner.jobs.folder(job.id) / COMPARISON
    gone = "This job has compared nothing; training a field of which there was one already does, at its end."
    return OpenFile(path, gone, media_type="image/png")
