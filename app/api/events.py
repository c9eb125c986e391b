"""The event stream: jobs with replay after a reconnect, the current scene, live images, notices."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import ExitStack
from functools import partial
from typing import Annotated, Any, Literal

import anyio
from fastapi import APIRouter, Depends, Header, HTTPException, Query
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Receive, Scope, Send

from osfcore.control.events import Looking
from osfcore.errors import OsfError, UnknownName
from osfcore.io.image_file import encode_jpeg

from ..jobs.job import Job, JobChanged, JobForgotten, JobView, job_from_fields
from ..jobs.kinds import KINDS
from ..processes.messages.scene_messages import FramesTaken, SceneChanged
from ..services.driver import DriverChanged
from ..services.event_hub import CurrentScene, Notice
from ..services.goals import Draft, DraftChanged, GoalsChanged
from ..services.photos import PhotosChanged
from ..services.pushes import Push, PushChanged
from ..storage.paths import without_places
from .dependencies import Services, ServicesDep, TooManyStreams
from .goals import DraftOut
from .jobs import JobOut
from .models import Visitor
from .page import DriverOut
from .predictions import PushOut
from .problems import problems
from .scenes import scene_out


class FrameEvent(BaseModel):
    """Live images, the data of a "frame" event."""

    scene: str
    revision: int
    cameras: dict[str, str] = Field(description="Camera name to JPEG data URL.")


Points = list[tuple[float, float]]


class ObjectOutlinesOut(BaseModel):
    """An object in one picture; coordinates are shares of its width and height."""

    name: str
    best: Points = Field(description="Outline of where it is taken to be; empty for what was not looked at yet.")
    tried: list[Points] = Field(description="The same of some candidates.")


class LookEvent(BaseModel):
    """An estimator at work, the data of a "look" event."""

    look: Literal["first", "goal", "next", "search"] = Field(description="At what: first frame, goal image, ...")
    share: float = Field(description="Of the work that is done.")
    loss: float | None = Field(description="Of the whole, in units of its stage.")
    difference: float | None = Field(
        description="Of the rendered scene from the images: root of the mean square over all pixels, 0 to 1."
    )
    stage: str = Field(description="Of the method; losses of one stage can be compared.")
    is_over: bool = Field(description="Whether this is the result.")
    light_deg: tuple[float, float] = Field(description="Azimuth and elevation of the light so far.")
    cameras: dict[str, list[ObjectOutlinesOut]] = Field(description='By camera; "goal" is the goal image.')
    pictures: dict[str, str] = Field(
        default_factory=dict, description="The best scene so far as each camera would see it: JPEG data URLs."
    )


class ForgottenEvent(BaseModel):
    """A job was removed for good, the data of a "forgotten" event."""

    job: str


class NoticeEvent(BaseModel):
    """A sentence for whoever watches, the data of a "notice" event."""

    level: Literal["info", "warning", "error"]
    text: str


router = APIRouter(prefix="/api", tags=["events"], responses=problems())
SCENE_INTERVAL_S = 0.1
FRAME_INTERVAL_S = 0.2
LOOK_INTERVAL_S = 0.3
_MAX_WAITING = 1000  # job events that a slow page may lag behind; the oldest are dropped
_WAIT_S = 0.5  # for something to come, before a stream looks whether the service ends
_MAX_EVENT = 2**63 - 1
_END = "end"  # the identifier of the last event of a job's own stream
LastEventId = Annotated[str | None, Header(description="Identifier of the last event that was seen.")]
SEEN: dict[int | str, dict[str, Any]] = {204: {"description": "The end of it was seen already."}}
Letter = JobChanged | JobForgotten | Notice | GoalsChanged | PhotosChanged | DriverChanged


async def _counted(services: ServicesDep) -> AsyncIterator[None]:
    if not services.streams.acquire(blocking=False):
        raise TooManyStreams
    try:
        yield
    finally:
        services.streams.release()


StreamDep = Annotated[None, Depends(_counted)]


class DepartureMiddleware:
    """Lets the clients of event streams leave whenever they like.

    FastAPI closes the queue between a stream's generator and its answer before it stops what fills the queue, so that
    most streams that a client leaves would end in an error of the service.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request."""
        if scope["type"] != "http" or not scope["path"].endswith("/events"):
            await self._app(scope, receive, send)
            return
        try:
            await self._app(scope, receive, send)
        except* anyio.BrokenResourceError:
            pass


class Mailbox:
    """What has not been sent to one page yet: all jobs and notices, but only the latest of what is drawn anew."""

    def __init__(self, current: str | None) -> None:
        self._loop = asyncio.get_running_loop()
        self._current = current
        self.letters: deque[Letter] = deque(maxlen=_MAX_WAITING)
        self.draft: DraftChanged | None = None
        self.push: PushChanged | None = None
        self.is_scene_new = True
        self.frames: FramesTaken | None = None
        self.look: Looking | None = None
        self.arrived = asyncio.Event()

    def put(self, event: object) -> None:
        """Take note of an event, in whatever thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put, event)

    async def wait(self) -> None:
        """Wait until something comes, for a while."""
        self.arrived.clear()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.arrived.wait(), _WAIT_S)

    def _put(self, event: object) -> None:
        match event:
            case JobChanged() | JobForgotten() | Notice() | GoalsChanged() | PhotosChanged() | DriverChanged():
                self.letters.append(event)
            case DraftChanged():
                self.draft = event
            case PushChanged():
                self.push = event
            case CurrentScene(record):
                self._current = None if record is None else record.id
                self.is_scene_new, self.frames, self.look = True, None, None
            case SceneChanged(record) if record.id == self._current:
                self.is_scene_new = True
            case JobView(job, Looking() as look) if job.scene in (None, self._current):
                self.look = look
            case FramesTaken() if event.scene == self._current:
                self.frames = event
        self.arrived.set()


@router.get("/events", response_class=EventSourceResponse, responses=problems(503))
async def stream(
    services: ServicesDep,
    _: StreamDep,
    frames: Annotated[bool, Query(description="Whether live images are wanted.")] = False,
    visitor: Annotated[Visitor | None, Query(description="What the page calls itself.")] = None,
    last_event_id: Annotated[str | None, Header(description="Number of the last job event that was seen.")] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Follow what happens: job, look, forgotten, scene, frame, goals, photos, draft, push, driver, notice."""
    mailbox = Mailbox(services.runner.scenes.current)
    with ExitStack() as departure:
        departure.callback(services.runner.hub.subscribe(mailbox.put))
        if frames:
            # In this order: a page that leaves while it is counted in must be counted out again.
            departure.callback(services.runner.scenes.watch_frames, -1)
            await run_in_threadpool(services.runner.scenes.watch_frames, 1)
        if visitor is not None:
            departure.callback(services.driver.leave, visitor)
            services.driver.arrive(visitor)
        yield ServerSentEvent(comment="connected", retry=1000)
        for entry in services.store.set_aside:
            yield ServerSentEvent(event="notice", data=NoticeEvent(level="warning", text=entry.sentence))
        if services.goals.draft is not None:
            yield _draft_event(services, services.goals.draft)
        if services.pushes.current is not None:
            yield await run_in_threadpool(_push_event, services, services.pushes.current)
        last = 0
        if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
            last = min(int(last_event_id[:19]), _MAX_EVENT)
            for number, fields in await run_in_threadpool(services.store.events_after, last):
                last = number
                replayed = _replayed(services, number, fields)
                if replayed is not None:
                    yield replayed
        async for event in _follow(services, mailbox, last, wants_frames=frames):
            yield event


async def _follow(
    services: Services, mailbox: Mailbox, last: int, *, wants_frames: bool
) -> AsyncIterator[ServerSentEvent]:
    scene_at = frame_at = look_at = 0.0
    while not services.closing.is_set():
        while mailbox.letters:
            letter = mailbox.letters.popleft()
            match letter:
                case Notice():
                    text = without_places(letter.text, services.settings.data_dir)
                    notice = NoticeEvent.model_validate({"level": letter.level, "text": text})
                    yield ServerSentEvent(event="notice", data=notice)
                case GoalsChanged():
                    yield ServerSentEvent(event="goals", raw_data="null")
                case PhotosChanged():
                    yield ServerSentEvent(event="photos", raw_data="null")
                case DriverChanged():
                    yield ServerSentEvent(event="driver", data=DriverOut.model_validate(letter, from_attributes=True))
                case JobChanged() if letter.event == 0 or letter.event > last:  # not replayed already
                    yield _job_event(services, letter.job, str(letter.event) if letter.event else None)
                case JobForgotten() if letter.event > last:
                    yield _forgotten(letter.event, letter.job.id)
        if mailbox.draft is not None:
            changed, mailbox.draft = mailbox.draft, None
            yield _draft_event(services, changed.draft)
        if mailbox.push is not None:
            tried, mailbox.push = mailbox.push, None
            yield await run_in_threadpool(_push_event, services, tried.push)
        now = time.monotonic()
        if mailbox.is_scene_new and now >= scene_at:
            mailbox.is_scene_new, scene_at = False, now + SCENE_INTERVAL_S
            yield _scene_event(services)
        if mailbox.frames is not None and now >= frame_at:
            taken, mailbox.frames, frame_at = mailbox.frames, None, now + FRAME_INTERVAL_S
            if wants_frames:
                yield ServerSentEvent(event="frame", raw_data=services.event_texts.of(taken, _frame))
        if mailbox.look is not None and (now >= look_at or mailbox.look.step.estimate is not None):
            look, mailbox.look, look_at = mailbox.look, None, now + LOOK_INTERVAL_S
            text = await run_in_threadpool(services.event_texts.of, look, partial(_look, services))
            yield ServerSentEvent(event="look", raw_data=text)
        due = [scene_at] * mailbox.is_scene_new + [frame_at] * (mailbox.frames is not None)
        due += [look_at] * (mailbox.look is not None)
        if due:
            await asyncio.sleep(min(max(min(due) - time.monotonic(), 0.001), _WAIT_S))
        elif not mailbox.letters:
            await mailbox.wait()


async def followed(services: Services, job: Job) -> AsyncIterator[ServerSentEvent]:
    """Events of one job, from how it is now to its end."""
    mailbox = Mailbox(None)
    leave = services.runner.hub.subscribe(mailbox.put)
    try:
        with contextlib.suppress(UnknownName):  # one that was just removed for good ends as it was
            job = services.runner.jobs.get(job.id)  # again, now that nothing is missed
        yield _job_event(services, job, _END if job.is_finished else None)
        while not job.is_finished and not services.closing.is_set():
            if not mailbox.letters:
                await mailbox.wait()
                continue
            letter = mailbox.letters.popleft()
            if isinstance(letter, JobChanged) and letter.job.id == job.id:
                job = letter.job
                yield _job_event(services, job, _END if job.is_finished else None)
    finally:
        leave()


def unended(job: Job, last_event_id: str | None) -> Job:
    """The job that a stream is about.

    Raises:
        HTTPException: 204 if the client has seen its end, which keeps EventSource from connecting again.
    """
    if job.is_finished and last_event_id == _END:
        raise HTTPException(204)
    return job


def _job_event(services: Services, job: Job, identifier: str | None) -> ServerSentEvent:
    return ServerSentEvent(event="job", id=identifier, raw_data=services.event_texts.of(job, JobOut.of))


def _forgotten(number: int, job: str) -> ServerSentEvent:
    return ServerSentEvent(event="forgotten", id=str(number), data=ForgottenEvent(job=job))


def _replayed(services: Services, number: int, fields: dict[str, Any]) -> ServerSentEvent | None:
    """An event as it was sent; None if another version wrote it in a way that makes no sense to this one.

    Args:
        services: of the app.
        number: of the event.
        fields: what the store keeps of it.
    """
    if "forgotten" in fields:
        return _forgotten(number, fields["forgotten"])
    try:
        job = job_from_fields(fields)
        return _job_event(services, job, str(number)) if job.kind in KINDS else None
    except (OsfError, TypeError):
        return None


def _scene_event(services: Services) -> ServerSentEvent:
    current = services.runner.scenes.current
    record = next((r for r in services.runner.scenes.all() if r.id == current), None)
    if record is None:
        return ServerSentEvent(event="scene", raw_data="null")
    text = services.event_texts.of(record, partial(scene_out, services))
    return ServerSentEvent(event="scene", raw_data=text)


def _draft_event(services: Services, draft: Draft | None) -> ServerSentEvent:
    if draft is None:
        return ServerSentEvent(event="draft", raw_data="null")
    return ServerSentEvent(event="draft", data=DraftOut.of(draft, services.objects.labels()))


def _push_event(services: Services, push: Push | None) -> ServerSentEvent:
    if push is None:
        return ServerSentEvent(event="push", raw_data="null")
    return ServerSentEvent(event="push", data=PushOut.of(services, push))


def _look(services: Services, look: Looking) -> LookEvent:
    outlines = LookEvent.model_validate(services.outliner.outlines(look), from_attributes=True)
    return outlines.model_copy(
        update={"pictures": {name: _jpeg_url(encode_jpeg(image)) for name, image in look.rendered.items()}}
    )


def _jpeg_url(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def _frame(taken: FramesTaken) -> FrameEvent:
    urls = map(_jpeg_url, taken.jpegs)
    return FrameEvent(scene=taken.scene, revision=taken.revision, cameras=dict(zip(taken.names, urls, strict=True)))
