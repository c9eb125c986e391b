"""The event stream: jobs with replay after a reconnect, the current scene, live images, notices."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.concurrency import run_in_threadpool

from app.job import Job, JobChanged, job_from_fields
from app.messages import CurrentScene, FramesTaken, Notice, SceneChanged
from app.routes import problems
from app.schemas import FrameEvent, NoticeEvent
from app.schemas_jobs import JobOut
from app.services import Services, ServicesDep

router = APIRouter(prefix="/api", tags=["events"], responses=problems())
SCENE_INTERVAL_S = 0.1
FRAME_INTERVAL_S = 0.2
_MAX_WAITING = 1000  # job events that a slow page may lag behind; the oldest are dropped
_LOOK_INTERVAL_S = 0.5
_MAX_EVENT = 2**63 - 1


class Mailbox:
    """What one page has not been told yet: all jobs and notices, but only the latest scene and images."""

    def __init__(self, current: str | None) -> None:
        self._loop = asyncio.get_running_loop()
        self._current = current
        self.letters: deque[JobChanged | Notice] = deque(maxlen=_MAX_WAITING)
        self.is_scene_new = True
        self.frames: FramesTaken | None = None
        self.arrived = asyncio.Event()

    def put(self, event: object) -> None:
        """Take note of an event, in whatever thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put, event)

    async def next_job(self, job: str) -> JobChanged | None:
        """The next letter about a job; None if there is none for a while."""
        while self.letters:
            letter = self.letters.popleft()
            if isinstance(letter, JobChanged) and letter.job.id == job:
                return letter
        self.arrived.clear()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.arrived.wait(), _LOOK_INTERVAL_S)
        return None

    def _put(self, event: object) -> None:
        match event:
            case JobChanged() | Notice():
                self.letters.append(event)
            case CurrentScene(record):
                self._current = None if record is None else record.id
                self.is_scene_new, self.frames = True, None
            case SceneChanged(record):
                self.is_scene_new = self.is_scene_new or record.id == self._current
            case FramesTaken():
                self.frames = event if event.scene == self._current else self.frames
        self.arrived.set()


@router.get("/events", response_class=EventSourceResponse)
async def stream(
    services: ServicesDep,
    frames: Annotated[bool, Query(description="Whether live images are wanted.")] = False,
    last_event_id: Annotated[str | None, Header(description="Number of the last job event that was seen.")] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Follow what happens: "job", "scene", "frame" and "notice" events."""
    mailbox = Mailbox(services.runner.current)
    leave = services.runner.hub.subscribe(mailbox.put)
    is_watching = False
    try:
        if frames:
            is_watching = True  # before the call: a page that leaves during it must be counted out again
            await run_in_threadpool(services.runner.watch_frames, 1)
        yield ServerSentEvent(comment="connected", retry=1000)
        last = 0
        if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
            last = min(int(last_event_id[:19]), _MAX_EVENT)
            for number, fields in await run_in_threadpool(services.store.events_after, last):
                last = number
                yield job_event(number, job_from_fields(fields))
        async for event in _follow(services, mailbox, last, wants_frames=frames):
            yield event
    finally:
        leave()
        if is_watching:
            services.runner.watch_frames(-1)


async def _follow(
    services: Services, mailbox: Mailbox, last: int, *, wants_frames: bool
) -> AsyncIterator[ServerSentEvent]:
    scene_at = frame_at = 0.0
    while not services.closing.is_set():
        while mailbox.letters:
            letter = mailbox.letters.popleft()
            if isinstance(letter, Notice):
                yield ServerSentEvent(event="notice", data=NoticeEvent.model_validate(letter, from_attributes=True))
            elif letter.event == 0 or letter.event > last:  # not replayed already
                yield job_event(letter.event, letter.job)
        now = time.monotonic()
        if mailbox.is_scene_new and now >= scene_at:
            mailbox.is_scene_new, scene_at = False, now + SCENE_INTERVAL_S
            yield _scene_event(services)
        if mailbox.frames is not None and now >= frame_at:
            taken, mailbox.frames, frame_at = mailbox.frames, None, now + FRAME_INTERVAL_S
            if wants_frames:
                yield ServerSentEvent(event="frame", data=_frame(taken))
        mailbox.arrived.clear()
        due = [scene_at] * mailbox.is_scene_new + [frame_at] * (mailbox.frames is not None)
        timeout = min([_LOOK_INTERVAL_S, *(max(at - time.monotonic(), 0.001) for at in due)])
        if due:
            await asyncio.sleep(timeout)
        elif not mailbox.letters:
            try:
                await asyncio.wait_for(mailbox.arrived.wait(), timeout)
            except TimeoutError:
                continue


def job_event(number: int, job: Job) -> ServerSentEvent:
    """A job as an event; the number is 0 where nothing came after it that could be asked for."""
    return ServerSentEvent(event="job", id=str(number) if number else None, data=JobOut.of(job))


def _scene_event(services: Services) -> ServerSentEvent:
    current = services.runner.current
    record = next((r for r in services.runner.scenes() if r.id == current), None)
    if record is None:
        return ServerSentEvent(event="scene", raw_data="null")
    return ServerSentEvent(event="scene", data=services.scene_out(record))


def _frame(taken: FramesTaken) -> FrameEvent:
    urls = ("data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii") for jpeg in taken.jpegs)
    return FrameEvent(scene=taken.scene, revision=taken.revision, cameras=dict(zip(taken.names, urls, strict=True)))
