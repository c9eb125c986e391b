"""Poses and light from images: ask for an estimate, follow it, look at it, cancel it."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response, status
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.requests import ClientDisconnect

from app.api.bodies import JSON, SMALL_BODY_BYTES, kind_of, parsed, whole_body
from app.api.dependencies import ServicesDep
from app.api.lanes import urgent
from app.api.open_file import OpenFile
from app.api.problems import named_in_path
from app.api.routes import FORGOTTEN, Forget, problems
from app.api.routes.comparisons import COMPARED, compared, compared_png
from app.api.routes.events import StreamDep, followed
from app.api.schemas.common import Seed
from app.api.schemas.estimates import METHOD, EstimateIn, EstimateList, EstimateOut
from app.api.schemas.limits import FILE_NAME, GUESS, NAME, VIEW, sized, within
from app.api.schemas.paging import DEFAULT_PAGE, AfterJob, Limit
from app.jobs.job import Job
from app.jobs.kinds.estimates import Mode
from app.services.estimates import Asked, Estimates
from osfcore.errors import OsfError
from osfcore.paper.method import Method

UPLOAD_PATH = "/api/estimates"
_ZIP = "application/zip"
_SCHEMA_REF = {"$ref": "#/components/schemas/EstimateIn"}
_BODY = {
    "requestBody": {
        "description": "JSON for a scene of the simulation, or a zipped observation folder, as /docs and README say.",
        "content": {
            JSON: {"schema": _SCHEMA_REF, "example": {"mode": "first"}},
            _ZIP: {"schema": {"type": "string", "format": "binary"}},
        },
    }
}
router = APIRouter(prefix=UPLOAD_PATH, tags=["estimates"], responses=problems())
View = Annotated[int, Path(**within(VIEW), description="Number of the camera, from 0.")]


async def _known_job(
    services: ServicesDep, estimate: Annotated[str, Path(description="Identifier of an estimate.")]
) -> Job:
    with named_in_path():
        return services.estimates.get(estimate)


FoundDep = Annotated[Job, Depends(_known_job)]


@router.post(
    "",
    status_code=status.HTTP_202_ACCEPTED,
    responses=problems(409, 415, 429, 503, 507),
    openapi_extra=_BODY,
    response_model_exclude_unset=True,  # what state.json leaves out is left out
)
async def create(
    services: ServicesDep,
    request: Request,
    response: Response,
    mode: Annotated[Mode, Query(description="Of an upload; JSON says it in the body.")] = "first",
    seed: Annotated[Seed, Query(description="Of an upload.")] = 0,
    prior: Annotated[
        str | None, Query(**sized(NAME), description="Of an upload: the earlier estimate, else its prior.json.")
    ] = None,
    file_name: Annotated[str, Query(**sized(FILE_NAME), description="Of an upload, for people.")] = "observation.zip",
    method: Annotated[Method, Query(description=f"Of an upload: {METHOD}")] = "ours",
) -> EstimateOut:
    """Queue an estimate of the current scene (JSON, or no body at all) or of a zipped observation folder.

    The zip holds observation.json and the PNGs that it names, in the format of `osf estimate`; for the modes "next" and
    "goal" also prior.json, a state.json or scene.json of how the objects lay, unless `prior` names an estimate.
    """
    kind = kind_of(request)
    if kind == _ZIP:
        try:
            job = await services.estimates.of_upload(Asked(mode, seed, prior, method), request.stream(), file_name)
        except ClientDisconnect:
            raise HTTPException(status.HTTP_400_BAD_REQUEST, "The upload broke off.") from None
    else:
        request_body = await _body(request, kind)
        job = await services.lanes.slow.run(services.estimates.of_scene, request_body.asked(), request_body.scene)
    response.headers["Location"] = f"{UPLOAD_PATH}/{job.id}"
    return await asyncio.to_thread(_out, services.estimates, job)


@router.get("")
def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterJob = None) -> EstimateList:
    """List estimates, newest first, without steps and results."""
    page = services.estimates.page(limit, after)
    listed = [EstimateOut.of_job(job, (), None, None) for job in page.jobs]
    return EstimateList(estimates=listed, total=page.total, next=page.next)


@router.get("/{estimate}", responses=problems(404, 409), response_model_exclude_unset=True)
def get(services: ServicesDep, job: FoundDep) -> EstimateOut:
    """Tell how an estimate is: its steps with their losses and, at the end, what it found and how sure it is."""
    return _out(services.estimates, job)


@router.delete(
    "/{estimate}",
    response_model=EstimateOut,
    responses={**problems(404, 409, 507), **FORGOTTEN},
    response_model_exclude_unset=True,
)
@urgent
def cancel(services: ServicesDep, job: FoundDep, forget: Forget = False) -> EstimateOut | Response:
    """End an estimate, within a second; what it was given is removed. It stays listed as cancelled."""
    if forget:
        services.runner.forget_job(job.id)
        return Response(status_code=status.HTTP_204_NO_CONTENT)
    return _out(services.estimates, services.runner.jobs.cancel(job.id))


@router.get("/{estimate}/events", response_class=EventSourceResponse, responses=problems(404, 503))
async def follow(services: ServicesDep, job: FoundDep, counted: StreamDep) -> AsyncIterator[ServerSentEvent]:
    """Follow one estimate: "job" events as at /api/events, from how it is now to its end."""
    del counted
    async for event in followed(services, job):
        yield event


@router.get("/{estimate}/images/{view}.png", response_class=Response, responses={**problems(404, 409, 503), **COMPARED})
async def image(
    services: ServicesDep,
    job: FoundDep,
    view: View,
    kind: Annotated[
        Literal["observed", "rendered", "difference", "comparison"],
        Query(description="The difference is absolute, times 4; a comparison is all three side by side."),
    ] = "comparison",
    step: Annotated[
        int | None, Query(**within(GUESS), description="Whose guess is rendered; the latest if left out.")
    ] = None,
) -> Response:
    """Show what a camera saw, and what it would see if a step's guess were true, by our fields."""
    with named_in_path():
        if kind == "observed":
            return await asyncio.to_thread(_observed, services.estimates, job, view)
        order = await asyncio.to_thread(services.estimates.comparison, job, view, step)
    return compared_png(await compared(services, order), kind)


def _observed(estimates: Estimates, job: Job, view: int) -> OpenFile:
    gone = "The images of this estimate have been removed from the data directory."
    return OpenFile(estimates.observed(job, view), gone, media_type="image/png")


def _out(estimates: Estimates, job: Job) -> EstimateOut:
    return EstimateOut.of_job(job, estimates.steps(job), estimates.result(job), estimates.simulation_errors(job))


async def _body(request: Request, kind: str) -> EstimateIn:
    """The JSON of a request; nothing at all asks for the defaults."""
    body = await whole_body(request, SMALL_BODY_BYTES)
    if not body and not kind:
        return EstimateIn.model_validate({})
    if kind != JSON:
        allowed = f"{JSON} for a scene, or {_ZIP} for an observation folder"
        raise HTTPException(
            status.HTTP_415_UNSUPPORTED_MEDIA_TYPE, f"The body is {kind or 'untyped'}, but it must be {allowed}."
        )
    if request.query_params:
        raise OsfError(f"{next(iter(request.query_params))} stands in the query, which is for uploads; use the body.")
    return parsed(EstimateIn, body)
