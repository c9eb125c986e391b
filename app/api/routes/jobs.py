"""Long work: start, follow, pause, cancel, download."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Response, status
from fastapi.responses import FileResponse

from app.api.bodies import BoundedRoute
from app.api.dependencies import Services, ServicesDep
from app.api.lanes import urgent
from app.api.open_file import OpenFile
from app.api.problems import named_in_path
from app.api.routes import FORGOTTEN, PNG, Forget, problems
from app.api.schemas.jobs import JobIn, JobList, JobOut
from app.api.schemas.paging import DEFAULT_PAGE, AfterJob, Limit
from app.jobs.job import Job, check_file_name
from app.jobs.kinds.fields import COMPARISON, PREVIEW

router = APIRouter(prefix="/api/jobs", tags=["jobs"], responses=problems(), route_class=BoundedRoute)
FileName = Annotated[str, Path(description="One of the job's files.")]
JobId = Annotated[str, Path(description="Identifier of a job.")]
_FILE = {
    200: {
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        "description": "The file.",
    }
}


@router.post("", status_code=status.HTTP_202_ACCEPTED, responses=problems(409, 429, 507))
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
async def get(services: ServicesDep, job: JobId) -> JobOut:
    """Tell how a job is."""
    return JobOut.of(_known_job(services, job))


@router.delete("/{job}", response_model=JobOut, responses={**problems(404, 409, 507), **FORGOTTEN})
@urgent
def cancel(services: ServicesDep, job: JobId, forget: Forget = False) -> JobOut | Response:
    """Take a job out of the queue or end it; what it has made is removed. It stays listed as cancelled."""
    _known_job(services, job)
    if forget:
        services.runner.forget_job(job)
        return Response(status_code=status.HTTP_204_NO_CONTENT)
    return JobOut.of(services.runner.jobs.cancel(job))


@router.post("/{job}/pause", responses=problems(404, 409))
@urgent
def pause(services: ServicesDep, job: JobId) -> JobOut:
    """Let a running job rest after its current step. It keeps its turn."""
    _known_job(services, job)
    return JobOut.of(services.runner.jobs.pause(job))


@router.post("/{job}/resume", responses=problems(404, 409))
@urgent
def resume(services: ServicesDep, job: JobId) -> JobOut:
    """Let a paused job go on."""
    _known_job(services, job)
    return JobOut.of(services.runner.jobs.resume(job))


@router.get("/{job}/files/{name}", response_class=FileResponse, responses={**problems(404), **_FILE})
def file(services: ServicesDep, job: JobId, name: FileName) -> OpenFile:
    """Download what a job has made."""
    known_job = _known_job(services, job)
    with named_in_path():
        path = services.runner.jobs.folder(job) / check_file_name(known_job, name)
    gone = f"{name} of this job has been removed from the data directory."
    return OpenFile(path, gone, media_type="application/octet-stream", filename=name)


@router.get("/{job}/preview.png", response_class=FileResponse, responses={**problems(404), **PNG})
def preview(services: ServicesDep, job: JobId) -> OpenFile:
    """Show one unseen image of a field in training: the truth, the field's, and their difference times four."""
    _known_job(services, job)
    path = services.runner.jobs.folder(job) / PREVIEW
    gone = "This job has no preview; training a field makes one, some seconds after it has begun."
    return OpenFile(path, gone, media_type="image/png", headers={"Cache-Control": "no-store"})


def _known_job(services: Services, job: str) -> Job:
    with named_in_path():
        return services.runner.jobs.get(job)


@router.get("/{job}/comparison.png", response_class=FileResponse, responses={**problems(404), **PNG})
def comparison(services: ServicesDep, job: JobId) -> OpenFile:
    """Show held-out images beside what the former and the new field make of them."""
    with named_in_path():
        folder = services.runner.jobs.folder(services.runner.jobs.get(job).id)
    gone = "This job has compared nothing; training a field of which there was one already does, at its end."
    return OpenFile(folder / COMPARISON, gone, media_type="image/png")
