"""Episodes: start one, follow it, pause and step it, change how it goes, look at what came of it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, Depends, Path, Query, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, Field, ValidationError

from osfcore.control.events import CostKind, EpisodeSettings, Matter
from osfcore.errors import CorruptFile
from osfcore.paper.method import METHODS, Method

from ..episodes.file_names import REPORT_FILE
from ..episodes.frames import Part
from ..episodes.settings import ChosenSettings
from ..jobs.job import Job
from ..jobs.kinds.episodes import EpisodeParams
from ..jobs.params import Identifier, Seed
from .bodies import FORGOTTEN, PNG, BoundedRoute, Forget, OpenFile, binary
from .dependencies import Services, ServicesDep, slow, urgent
from .events import SEEN, LastEventId, StreamDep, followed, unended
from .jobs import JobOut, ProgressOut, progress_of
from .models import HORIZON, SAMPLES, STEPS, DisplayName, Horizon, Input, Poses, Samples, SceneRef, Steps
from .paging import DEFAULT_PAGE, AfterJob, JobPageOut, Limit
from .problems import named_in_path, problems

_TEMPERATURE = (1e-6, 1e6)


class SettingsIn(Input):
    """What shall be other than by default, or than before."""

    method: Method | None = Field(
        None,
        description='"ours", or "paper": as published, which is slower and knows no goal poses; chosen before an '
        "episode, with a cost of images, a plan for each action, and no changes on the way.",
    )
    steps: Steps | None = Field(
        None, description="Actions at most, of 0.2 s each, counted anew after each disturbance."
    )
    replan_every: Steps | None = Field(None, description="Actions executed of each plan.")
    cost: CostKind | None = Field(
        None, description='"pose" compares futures with where things are in the goal image, "image" rendered pixels.'
    )
    samples: Samples | None = Field(None, description="Sequences of actions in each round of a plan.")
    horizon: Horizon | None = Field(None, description="Actions in each.")
    temperature: float | None = Field(
        None, ge=_TEMPERATURE[0], le=_TEMPERATURE[1], description="Of the softmax, as a share of the spread of costs."
    )
    planning: bool | None = Field(None, description="Draw plans; where not, the last plan is followed to its end.")
    acting: bool | None = Field(None, description="Execute plans; where not, the table is only watched.")
    despite_doubts: bool | None = Field(None, description="Go on with a goal image that is not explained well.")

    def given(self) -> dict[str, Any]:
        """Those that were."""
        return self.model_dump(exclude_none=True)


class EpisodeIn(Input):
    """An episode: give either goal or poses."""

    scene: SceneRef
    goal: Identifier | None = Field(None, description="Identifier of a goal image.")
    poses: Poses | None = Field(None, description="Where all objects shall be.")
    seed: Seed = 0
    settings: SettingsIn = SettingsIn()  # pyright: ignore[reportCallIssue]

    def chosen(self) -> ChosenSettings:
        """Return the settings, as by default where nothing is said.

        Raises:
            InvalidInput: if one means something that the method does not have.
        """
        return ChosenSettings.defaults(self.settings.method or "ours").changed(self.settings.given())


Bounds = Annotated[list[float], Field(min_length=2, max_length=2, description="Least and most.")]


class SettingBounds(BaseModel):
    """Which numbers are allowed."""

    steps: Bounds
    replan_every: Bounds
    samples: Bounds
    horizon: Bounds
    temperature: Bounds


class EpisodeSettingsOut(BaseModel):
    """Defaults and bounds of an episode's settings."""

    defaults: ChosenSettings
    published: ChosenSettings = Field(description="Defaults of the method as published.")
    reached_mm: float = Field(description="Objects as near as this to their goals, as estimated, have arrived [mm].")
    reached_deg: float = Field(description="Likewise for how they are turned [deg].")
    bounds: SettingBounds


class ServiceSettings(BaseModel):
    """What can be set, and what it is where nothing is said."""

    episode: EpisodeSettingsOut

    @staticmethod
    def now() -> ServiceSettings:
        """Of this version."""
        bounds = SettingBounds(
            steps=list(STEPS),
            replan_every=list(STEPS),
            samples=list(SAMPLES),
            horizon=list(HORIZON),
            temperature=list(_TEMPERATURE),
        )
        ours, published = map(ChosenSettings.defaults, METHODS)
        rule = EpisodeSettings()
        reached_mm, reached_deg = 1000 * rule.reached_m, math.degrees(rule.reached_rad)
        return ServiceSettings(
            episode=EpisodeSettingsOut(
                defaults=ours, published=published, reached_mm=reached_mm, reached_deg=reached_deg, bounds=bounds
            )
        )


class RenameIn(Input):
    """What to call an episode."""

    name: DisplayName = Field(description="For people.")


class NoticeOut(BaseModel):
    """Something that was noticed on the way."""

    step: int
    matter: str = Field(description=f"One of {', '.join(get_args(Matter))}.")
    text: str


class EpisodeStepOut(BaseModel):
    """One round of the loop, or how it was before the first."""

    step: int = Field(description="Actions executed so far.")
    seconds: dict[str, float] = Field(description='Spent on "first", "goal", "estimate", "plan" and "act" [s].')
    image_cost: float = Field(description="Mean squared difference of goal image and rendered estimate.")
    ssim: float | None = Field(
        None, description="Their structural similarity, 1 for equal images; null in episodes of earlier versions."
    )
    to_goal_mm: dict[str, float] | None = Field(
        description="Of each object, as estimated [mm]; null where the method looks at images alone."
    )
    to_goal_deg: dict[str, float] | None = Field(description="Likewise [deg].")
    estimate_off_mm: dict[str, float] = Field(description="Simulation only: errors of the estimate [mm].")
    light_off_deg: float | None = Field(
        None, description="Simulation only: error of the estimated light [deg]; null in episodes of earlier versions."
    )
    truly_to_goal_mm: dict[str, float] | None = Field(
        None, description="Simulation only: true distances [mm]; null where nobody knows the truth of the goal."
    )


class EpisodeOut(ProgressOut):
    """An episode as it is now."""

    name: str = Field(description="For people.")
    scene: str
    goal: str | None = Field(description="Identifier of the goal image; null where poses were given.")
    objects: list[str]
    seed: int
    settings: ChosenSettings
    done: int = Field(description="Actions executed.")
    total: int = Field(description="Actions at most.")
    stage: Literal["first", "goal", "plan", "act", "next", "search"] | None
    eta_s: float | None = Field(description="Estimated time left [s].")
    outcome: Literal["reached", "out of steps", "refused"] | None
    text: str | None = Field(description="The outcome in a sentence.")
    notices: list[NoticeOut]
    seconds: float | None = Field(description="Spent so far, without pauses [s]; null before the first look.")
    steps: list[EpisodeStepOut]
    step_s: list[float] = Field(description="When each step is over in the episode's replay, see /api/views [s].")
    files: list[str] = Field(description="Names to download from /api/episodes/{id}/files/{name}.")

    @staticmethod
    def of_job(job: Job, name: str, report: dict[str, Any] | None, files: tuple[str, ...]) -> EpisodeOut:
        """From the registry's job and what it has written so far.

        Args:
            job: of the kind "episode".
            name: for people.
            report: what report.json holds; None before there is one, or where steps are not asked for.
            files: names that can be downloaded.
        """
        report, result, params = report or {}, job.result or {}, EpisodeParams.from_json(job.params)
        return EpisodeOut(
            **progress_of(job),
            name=name,
            scene=params.scene,
            goal=params.goal.id,
            objects=list(params.names),
            seed=params.seed,
            settings=params.settings,
            done=job.done,
            total=job.total,
            stage=result.get("stage"),
            eta_s=result.get("left_s") if job.state == "running" else None,
            outcome=result.get("outcome"),
            text=result.get("text"),
            notices=[NoticeOut(**notice) for notice in report.get("noticed", ())],
            seconds=report.get("seconds", result.get("seconds")),
            steps=[EpisodeStepOut.model_validate(step) for step in report.get("steps", ())],
            step_s=report.get("step_s", []),
            files=list(files),
        )


class EpisodeList(JobPageOut):
    """Episodes, newest first, without their steps."""

    episodes: list[EpisodeOut]


router = APIRouter(prefix="/api/episodes", tags=["episodes"], responses=problems(), route_class=BoundedRoute)
_MEDIA_TYPES = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".png": "image/png",
    ".mp4": "video/mp4",
    ".viser": "application/octet-stream",
    ".zip": "application/zip",
}
_FILE = binary("The file.", *_MEDIA_TYPES.values())
_FILE[200]["content"]["application/json"] = {"schema": {"type": "object"}}


async def _known_job(
    services: ServicesDep, episode: Annotated[str, Path(description="Identifier of an episode.")]
) -> Job:
    with named_in_path():
        return services.episodes.get(episode)


FoundDep = Annotated[Job, Depends(_known_job)]


@router.post("", status_code=202, responses=problems(409, 429, 507))
@slow
def create(services: ServicesDep, body: EpisodeIn, response: Response) -> EpisodeOut:
    """Queue an episode: look, predict, plan, push and look again until the scene is as the goal shows it."""
    poses = None if body.poses is None else tuple(entry.named_pose() for entry in body.poses)
    job = services.episodes.start(body.chosen(), body.scene, body.goal, poses, body.seed)
    response.headers["Location"] = f"{router.prefix}/{job.id}"
    return _out(services, job)


@router.get("")
def list_all(
    services: ServicesDep,
    limit: Limit = DEFAULT_PAGE,
    after: AfterJob = None,
    search: Annotated[str, Query(max_length=200, description="Words that name or objects hold, all of them.")] = "",
    outcome: Annotated[
        Literal["reached", "out of steps", "refused", "cancelled", "failed", "interrupted"] | None,
        Query(description="Only those that ended so."),
    ] = None,
) -> EpisodeList:
    """List episodes, newest first, without their steps."""
    episodes, page = services.episodes, services.episodes.page(limit, after, search, outcome)
    listed = [EpisodeOut.of_job(job, episodes.name(job), None, episodes.files(job)) for job in page.jobs]
    return EpisodeList(episodes=listed, total=page.total, next=page.next)


@router.get("/{episode}", responses=problems(404, 409))
def get(services: ServicesDep, job: FoundDep) -> EpisodeOut:
    """Return how an episode is: its steps so far with distances, costs and times, and how it ended."""
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
        return Response(status_code=204)
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


@router.post("/{episode}/clip", status_code=202, responses=problems(404, 409, 429, 507))
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


async def _unended(job: FoundDep, last_event_id: LastEventId = None) -> Job:
    return unended(job, last_event_id)


@router.get("/{episode}/events", response_class=EventSourceResponse, responses={**problems(404, 503), **SEEN})
async def follow(
    services: ServicesDep, job: Annotated[Job, Depends(_unended)], _: StreamDep
) -> AsyncIterator[ServerSentEvent]:
    """Follow one episode: "job" events as at /api/events, from how it is now to its end."""
    async for event in followed(services, job):
        yield event


@router.get("/{episode}/frames/{step}.png", response_class=Response, responses={**problems(404, 409), **PNG})
async def frame(
    services: ServicesDep,
    job: FoundDep,
    step: Annotated[int, Path(ge=0, le=100_000, description="Which of `steps`, from 0; one may be several actions.")],
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


@router.get("/{episode}/files/{name}", response_class=Response, responses={**problems(404, 409, 507), **_FILE})
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
    files, report = episodes.files(job), episodes.report(job)
    try:
        return EpisodeOut.of_job(job, episodes.name(job), report, files)
    except (ValidationError, TypeError) as error:
        if report is None:
            raise
        raise CorruptFile(services.runner.jobs.folder(job.id) / REPORT_FILE, "it does not describe steps") from error
