"""Long work: start, follow, pause, cancel, download."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Depends, Path, Response
from pydantic import BaseModel, Field

from ..jobs.job import Job, State, check_file_name
from ..jobs.kinds import KindName
from ..jobs.kinds.collections import CollectObjectParams, CollectPushesParams, CollectTableParams, FetchAssetsParams
from ..jobs.kinds.fields import COMPARISON, PREVIEW, TrainFieldParams
from .bodies import FORGOTTEN, PNG, BoundedRoute, Forget, OpenFile, binary
from .dependencies import ServicesDep, urgent
from .models import Input
from .paging import DEFAULT_PAGE, AfterJob, JobPageOut, Limit
from .problems import named_in_path, problems


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
    job = services.runner.submit_job(body.kind, body.params)
    response.headers["Location"] = f"/api/jobs/{job.id}"
    return JobOut.of(job)


@router.get("")
async def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterJob = None) -> JobList:
    """List jobs, newest first."""
    page = services.runner.jobs.page(limit, after)
    return JobList(jobs=[JobOut.of(job) for job in page.jobs], total=page.total, next=page.next)


@router.get("/{job}", responses=problems(404))
async def get(job: FoundDep) -> JobOut:
    """Return how a job is."""
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
