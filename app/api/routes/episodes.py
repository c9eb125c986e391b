"""Episodes: start one, follow it, pause and step it, change how it goes, look at what came of it."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Path, Query, Response, status
from fastapi.responses import FileResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import ValidationError

from app.api.bodies import BoundedRoute
from app.api.dependencies import Services, ServicesDep
from app.api.lanes import slow, urgent
from app.api.open_file import OpenFile
from app.api.problems import named_in_path
from app.api.routes import FORGOTTEN, PNG, Forget, problems
from app.api.routes.events import StreamDep, followed
from app.api.schemas.episodes import EpisodeIn, EpisodeList, EpisodeOut, RenameIn, SettingsIn
from app.api.schemas.jobs import JobOut
from app.api.schemas.limits import SEARCH, STEP, sized, within
from app.api.schemas.paging import DEFAULT_PAGE, AfterJob, Limit
from app.episodes.file_names import REPORT_FILE
from app.episodes.frames import Part
from app.jobs.job import Job
from osfcore.errors import CorruptFile

router = APIRouter(prefix="/api/episodes", tags=["episodes"], responses=problems(), route_class=BoundedRoute)
_MEDIA_TYPES = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".png": "image/png",
    ".mp4": "video/mp4",
    ".viser": "application/octet-stream",
    ".zip": "application/zip",
}
_FILE = {
    200: {
        "content": {
            **{kind: {"schema": {"type": "string", "format": "binary"}} for kind in _MEDIA_TYPES.values()},
            "application/json": {"schema": {"type": "object"}},
        },
        "description": "The file.",
    }
}


async def _known_job(
    services: ServicesDep, episode: Annotated[str, Path(description="Identifier of an episode.")]
) -> Job:
    with named_in_path():
        return services.episodes.get(episode)


FoundDep = Annotated[Job, Depends(_known_job)]


@router.post("", status_code=status.HTTP_202_ACCEPTED, responses=problems(409, 429, 507))
@slow
def create(services: ServicesDep, body: EpisodeIn, response: Response) -> EpisodeOut:
    """Queue an episode: look, predict, plan, push and look again until the scene is as the goal shows it."""
    job = services.episodes.start(body.asked())
    response.headers["Location"] = f"{router.prefix}/{job.id}"
    return _out(services, job)


@router.get("")
def list_all(
    services: ServicesDep,
    limit: Limit = DEFAULT_PAGE,
    after: AfterJob = None,
    search: Annotated[str, Query(**sized(SEARCH), description="Words that name or objects hold, all of them.")] = "",
    outcome: Annotated[
        Literal["reached", "out of steps", "refused", "cancelled", "failed", "interrupted"] | None,
        Query(description="Only those that ended so."),
    ] = None,
) -> EpisodeList:
    """List episodes, newest first, without their steps."""
    episodes, page = services.episodes, services.episodes.page(limit, after, search, outcome)
    listed = [
        EpisodeOut.of_job(job, episodes.name(job), episodes.settings(job), None, episodes.files(job))
        for job in page.jobs
    ]
    return EpisodeList(episodes=listed, total=page.total, next=page.next)


@router.get("/{episode}", responses=problems(404, 409))
def get(services: ServicesDep, job: FoundDep) -> EpisodeOut:
    """Tell how an episode is: its steps so far with distances, costs and times, and how it ended."""
    return _out(services, job)


@router.patch("/{episode}", responses=problems(404, 409, 507))
@urgent
def rename(services: ServicesDep, job: FoundDep, body: RenameIn) -> EpisodeOut:
    """Call an episode something else."""
    return _out(services, services.episodes.rename(job, body.name))


@router.delete("/{episode}", response_model=EpisodeOut, responses={**problems(404, 409, 507), **FORGOTTEN})
@urgent
def cancel(services: ServicesDep, job: FoundDep, forget: Forget = False) -> EpisodeOut | Response:
    """End an episode, within a second. The steps that it has done are kept."""
    if forget:
        services.runner.forget_job(job.id)
        return Response(status_code=status.HTTP_204_NO_CONTENT)
    return _out(services, services.runner.jobs.cancel(job.id))


@router.post("/{episode}/pause", responses=problems(404, 409))
@urgent
def pause(services: ServicesDep, job: FoundDep) -> EpisodeOut:
    """Let a running episode rest. Lamp and objects may be moved by hand meanwhile."""
    return _out(services, services.runner.jobs.pause(job.id))


@router.post("/{episode}/resume", responses=problems(404, 409))
@urgent
def resume(services: ServicesDep, job: FoundDep) -> EpisodeOut:
    """Let a paused episode go on."""
    return _out(services, services.runner.jobs.resume(job.id))


@router.post("/{episode}/clip", status_code=status.HTTP_202_ACCEPTED, responses=problems(404, 409, 429, 507))
@slow
def clip(services: ServicesDep, job: FoundDep) -> JobOut:
    """Make a clip in 1080p of an episode that is over; then it is one of the episode's files, `clip.mp4`."""
    return JobOut.of(services.episodes.make_clip(job))


@router.post("/{episode}/step", responses=problems(404, 409))
@urgent
def step(services: ServicesDep, job: FoundDep) -> EpisodeOut:
    """Let a paused episode go on to the end of the round, and rest again."""
    return _out(services, services.runner.jobs.step(job.id))


@router.patch("/{episode}/settings", responses=problems(404, 409))
@urgent
def change(services: ServicesDep, job: FoundDep, body: SettingsIn) -> EpisodeOut:
    """Let an episode that runs or pauses go on with other settings; what is left out stays."""
    return _out(services, services.episodes.change(job, body.given()))


@router.get("/{episode}/events", response_class=EventSourceResponse, responses=problems(404, 503))
async def follow(services: ServicesDep, job: FoundDep, counted: StreamDep) -> AsyncIterator[ServerSentEvent]:
    """Follow one episode: "job" events as at /api/events, from how it is now to its end."""
    del counted
    async for event in followed(services, job):
        yield event


@router.get("/{episode}/frames/{step}.png", response_class=Response, responses={**problems(404, 409), **PNG})
async def frame(
    services: ServicesDep,
    job: FoundDep,
    step: Annotated[int, Path(**within(STEP), description="Which of `steps`, from 0; one may be several actions.")],
    part: Annotated[
        Part,
        Query(description="The goal image, the table then, the estimate as the goal camera would see it, how much "
              "that differs from the goal image, or all of them with the cameras' images."),
    ] = "all",
) -> Response:  # fmt: skip
    """Show one step."""
    with named_in_path():
        png = await asyncio.to_thread(services.episodes.frame, job, step, part)
    return Response(png, media_type="image/png", headers={"Cache-Control": "max-age=3600"})


@router.get("/{episode}/thumbnail.png", response_class=Response, responses={**problems(404, 409), **PNG})
async def thumbnail(
    services: ServicesDep,
    job: FoundDep,
    at: Annotated[Literal["start", "end"], Query(description="The table before, or so far.")] = "end",
) -> Response:
    """Show the table in small, as the goal camera saw it."""
    with named_in_path():
        png = await asyncio.to_thread(services.episodes.thumbnail, job, at)
    kept = "max-age=3600" if job.is_finished or at == "start" else "no-cache"
    return Response(png, media_type="image/png", headers={"Cache-Control": kept})


@router.get("/{episode}/files/{name}", response_class=FileResponse, responses={**problems(404, 409, 507), **_FILE})
def file(
    services: ServicesDep, job: FoundDep, name: Annotated[str, Path(description="One of the episode's files.")]
) -> OpenFile:
    """Download what an episode has left: report, table of steps, goal image, video, and a recording for the viewer."""
    with named_in_path():
        path = services.episodes.file(job, name)
    gone = f"{name} of this episode has been removed from the data directory."
    return OpenFile(path, gone, media_type=_MEDIA_TYPES[path.suffix], filename=name, disposition="inline")


def _out(services: Services, job: Job) -> EpisodeOut:
    episodes = services.episodes
    settings, files, report = episodes.settings(job), episodes.files(job), episodes.report(job)
    try:
        return EpisodeOut.of_job(job, episodes.name(job), settings, report, files)
    except (ValidationError, TypeError) as error:
        if report is None:
            raise
        raise CorruptFile(services.runner.jobs.folder(job.id) / REPORT_FILE, "it does not describe steps") from error
