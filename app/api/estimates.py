"""Poses and light from images: ask for an estimate, follow it, look at it, cancel it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, Field

from osfcore.errors import OsfError
from osfcore.io.scene_file import EstimateJson
from osfcore.paper.method import Method

from ..jobs.job import Job
from ..jobs.kinds.estimates import EstimateParams, Mode
from ..jobs.params import Identifier, Seed
from ..services.estimates import Asked, Estimates
from .bodies import (
    BINARY,
    FORGOTTEN,
    JSON,
    SMALL_BODY_BYTES,
    Forget,
    OpenFile,
    kind_of,
    parsed,
    refuse_form,
    whole_body,
)
from .dependencies import ServicesDep, urgent
from .events import SEEN, LastEventId, StreamDep, followed, unended
from .jobs import ProgressOut, progress_of
from .models import FileName, Input
from .paging import DEFAULT_PAGE, AfterJob, JobPageOut, Limit
from .problems import named_in_path, problems
from .scenes import COMPARED, compared, compared_png

METHOD = '"ours", or "paper": CMA-ES alone with fields as published, which is slower; not for mode "goal".'


class EstimateIn(Input):
    """An estimate of what the cameras see of a scene."""

    mode: Mode = Field(
        "first",
        description='"first" from masks alone, "next" without masks from an earlier estimate, "goal" from one view '
        "without masks and without the pusher.",
    )
    scene: Identifier | None = Field(None, description="Null for the one that is shown.")
    prior: Identifier | None = Field(None, description="The earlier estimate; null for the latest one of the scene.")
    seed: Seed = 0
    method: Method = Field("ours", description=METHOD)

    def asked(self) -> Asked:
        """What the service's own modules take."""
        return Asked(self.mode, self.seed, self.prior, self.method)


class ObservedOut(BaseModel):
    """What was looked at."""

    scene: str | None = Field(description="Identifier of the scene; null for an upload.")
    revision: int | None = Field(description="Of the scene when its images were taken.")
    file_name: str | None = Field(description="Of the upload; null for a scene.")


class StepOut(BaseModel):
    """One step of an estimate."""

    step: int = Field(description="From 1; names the step's images.")
    stage: str = Field(description='"orientations", "light", "objects", "together", "polish" or "done".')
    note: str
    done: int
    total: int
    losses: list[float | None] = Field(description="Of each object, in the units of the stage.")
    loss: float | None = Field(description="Of the whole, likewise; null where only objects are looked at.")


class ObjectError(BaseModel):
    """How far one object is from where it truly is."""

    name: str
    position_mm: float
    rotation_deg: float = Field(description="Least angle over all orientations that look like the true one.")


class SimulationErrors(BaseModel):
    """Errors against the truth, which only a simulation knows and no estimator sees."""

    objects: list[ObjectError]
    light_deg: float


class EstimateOut(ProgressOut):
    """An estimate as it is now."""

    mode: Mode
    method: Method
    seed: int
    of: ObservedOut
    objects: list[str] = Field(description="Names, in the order of losses.")
    cameras: list[str] = Field(description="Names, in the order of views.")
    done: int = Field(description="Units finished.")
    total: int = Field(description="Units in all; 0 before it is known.")
    stage: str | None
    eta_s: float | None = Field(description="Estimated time left [s].")
    steps: list[StepOut] = Field(description="All steps so far, with their losses.")
    estimate: EstimateJson | None = Field(description="The result, as in state.json; null until it is there.")
    simulation: SimulationErrors | None = Field(
        description="Simulation only: errors against the truth; null for uploads and before the result is there."
    )
    files: list[str] = Field(description="Names to download from /api/jobs/{id}/files/{name}.")

    @staticmethod
    def of_job(
        job: Job, steps: tuple[dict[str, Any], ...], estimate: EstimateJson | None, errors: dict[str, Any] | None
    ) -> EstimateOut:
        """From the registry's job and what it has made.

        Args:
            job: of the kind "estimate".
            steps: as from `read_steps`; none where they are not asked for.
            estimate: the result; None before it is there, or where it is not asked for.
            errors: against the truth, as from `errors_of`; None where nobody knows it.
        """
        params = EstimateParams.from_json(job.params)
        return EstimateOut(
            **progress_of(job),
            mode=params.mode,
            method=params.method,
            seed=params.seed,
            of=ObservedOut(**dict(params.of)),
            objects=list(params.names),
            cameras=list(params.cameras),
            done=job.done,
            total=job.total,
            stage=steps[-1]["stage"] if steps else None,
            eta_s=job.eta_s,
            steps=[StepOut(**{key: step[key] for key in StepOut.model_fields}) for step in steps],
            estimate=estimate,
            simulation=None if errors is None else SimulationErrors.model_validate(errors),
            files=list(job.files),
        )


class EstimateList(JobPageOut):
    """Estimates, newest first, without their steps."""

    estimates: list[EstimateOut]


UPLOAD_PATH = "/api/estimates"
_ZIP = "application/zip"
_BODY = {
    "requestBody": {
        "description": "JSON for a scene of the simulation, or a zipped observation folder, as /docs and README say.",
        "content": {
            JSON: {"schema": {"$ref": "#/components/schemas/EstimateIn"}, "example": {"mode": "first"}},
            _ZIP: BINARY,
        },
    }
}
router = APIRouter(prefix=UPLOAD_PATH, tags=["estimates"], responses=problems())
_UPLOAD_DEFAULTS = {"mode": "first", "seed": "0", "file_name": "observation.zip", "method": "ours"}


async def _known_job(
    services: ServicesDep, estimate: Annotated[str, Path(description="Identifier of an estimate.")]
) -> Job:
    with named_in_path():
        return services.estimates.get(estimate)


FoundDep = Annotated[Job, Depends(_known_job)]


@router.post(
    "",
    status_code=202,
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
        Identifier | None, Query(description="Of an upload: the earlier estimate, else its prior.json.")
    ] = None,
    file_name: Annotated[FileName, Query(description="Of an upload, for people.")] = "observation.zip",
    method: Annotated[Method, Query(description=f"Of an upload: {METHOD}")] = "ours",
) -> EstimateOut:
    """Queue an estimate of the current scene (JSON, or no body at all) or of a zipped observation folder.

    The zip holds observation.json and the PNGs that it names, in the format of `osf estimate`; for the modes "next" and
    "goal" also prior.json, a state.json or scene.json of how the objects lay, unless `prior` names an estimate.
    """
    refuse_form(request, _ZIP)
    kind = kind_of(request)
    if kind == _ZIP:
        job = await services.estimates.of_upload(Asked(mode, seed, prior, method), request.stream(), file_name)
    else:
        request_body = await _body(request, kind)
        job = await services.slow_lane.run(services.estimates.of_scene, request_body.asked(), request_body.scene)
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
    """Return how an estimate is: its steps with their losses and, at the end, what it found and how sure it is."""
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
        return Response(status_code=204)
    return _out(services.estimates, services.runner.jobs.cancel(job.id))


async def _unended(job: FoundDep, last_event_id: LastEventId = None) -> Job:
    return unended(job, last_event_id)


@router.get("/{estimate}/events", response_class=EventSourceResponse, responses={**problems(404, 503), **SEEN})
async def follow(
    services: ServicesDep, job: Annotated[Job, Depends(_unended)], _: StreamDep
) -> AsyncIterator[ServerSentEvent]:
    """Follow one estimate: "job" events as at /api/events, from how it is now to its end."""
    async for event in followed(services, job):
        yield event


@router.get("/{estimate}/images/{view}.png", response_class=Response, responses={**problems(404, 409, 503), **COMPARED})
async def image(
    services: ServicesDep,
    job: FoundDep,
    view: Annotated[int, Path(ge=0, le=1000, description="Number of the camera, from 0.")],
    kind: Annotated[
        Literal["observed", "rendered", "difference", "comparison"],
        Query(description="The difference is absolute, times 4; a comparison is all three side by side."),
    ] = "comparison",
    step: Annotated[
        int | None, Query(ge=1, le=100_000, description="Whose guess is rendered; the latest if left out.")
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
    """The JSON of a request; nothing at all asks for the defaults.

    The query is for uploads, but generated clients send its defaults along.
    """
    body = await whole_body(request, SMALL_BODY_BYTES)
    if not body and not kind:
        return EstimateIn.model_validate({})
    if kind != JSON:
        allowed = f"{JSON} for a scene, or {_ZIP} for an observation folder"
        raise HTTPException(415, f"The body is {kind or 'untyped'}, but it must be {allowed}.")
    for name, value in request.query_params.items():
        if value != _UPLOAD_DEFAULTS.get(name):
            raise OsfError(f"{name} stands in the query, which is for uploads; use the body.")
    return parsed(EstimateIn, body)
