"""Whether the service runs, what it holds, what an operator watches, and what can be set."""

from __future__ import annotations

import os
import pathlib
import shutil
import sys
import time
from collections import Counter as Tally
from collections.abc import Iterator
from importlib.metadata import version
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response
from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from pydantic import BaseModel, Field
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..jobs.kinds.fields import TrainFieldParams
from ..services.runner import Runner
from .dependencies import ServicesDep, urgent
from .episodes import ServiceSettings
from .problems import named_in_path, problems

LEAST_FREE_BYTES = 50 << 20  # on the disk of the data directory; with less, the next episode may not fit


def _disk_problem(data_dir: pathlib.Path) -> str | None:
    try:
        if sys.platform != "win32" and os.statvfs(data_dir).f_flag & os.ST_RDONLY:
            return "The disk of the data directory is read-only."
        free = shutil.disk_usage(data_dir).free
    except OSError as error:
        return f"The data directory cannot be reached ({error.strerror})."
    if free < LEAST_FREE_BYTES:
        return f"The disk of the data directory is nearly full: {free / 1e6:.0f} MB are left."
    return None


CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
_UNMEASURED = ("/events", "/viewer")  # they last as long as their page
_METHODS = ("GET", "HEAD", "POST", "PATCH", "PUT", "DELETE", "OPTIONS")


class Metrics:
    """The figures of one service."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._requests = Histogram(
            "osf_request_seconds", "Time to answer requests.", ("method", "status"), buckets=_BUCKETS_S,
            registry=self._registry,
        )  # fmt: skip

    def watch(self, runner: Runner) -> None:
        """Also count scenes and jobs from now on."""
        self._registry.register(_State(runner))

    def answered(self, method: str, status: int, seconds: float) -> None:
        """Take note of an answered request.

        Args:
            method: of HTTP; each one is counted for ever, so only known ones may come here.
            status: of the answer.
            seconds: from the request to the end of the answer [s].
        """
        self._requests.labels(method, str(status)).observe(seconds)

    def text(self) -> bytes:
        """All figures as of now."""
        return generate_latest(self._registry)


class _State(Collector):
    """Looks at the runner whenever somebody asks."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner

    def collect(self) -> Iterator[Metric]:
        """Figures as of now."""
        runner = self._runner
        for name, text, value in (
            ("osf_uptime_seconds", "Since the service was started.", runner.uptime_s),
            ("osf_scenes", "Scenes that are kept.", len(runner.scenes.all())),
            ("osf_stage_ready", "1 while the simulation takes commands.", runner.scenes.status == "ready"),
        ):
            yield GaugeMetricFamily(name, text, value=float(value))
        jobs = GaugeMetricFamily("osf_jobs", "Jobs by kind and state.", labels=("kind", "state"))
        for (kind, state), count in Tally((job.kind, job.state) for job in runner.jobs.all()).items():
            jobs.add_metric((kind, state), float(count))
        yield jobs
        yield GaugeMetricFamily("osf_disk_free_bytes", "On the disk of the data directory.", runner.storage.free_bytes)
        usage = runner.storage.usage(wait_s=0)
        if usage is not None:
            held = GaugeMetricFamily("osf_data_bytes", "That the data directory holds, by kind.", labels=("kind",))
            for kind, count in usage.bytes.items():
                held.add_metric((kind,), float(count))
            yield held


class MetricsMiddleware:
    """Times every request but those that stream."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request."""
        if scope["type"] != "http" or scope["path"].endswith(_UNMEASURED):
            await self._app(scope, receive, send)
            return
        began, status = time.perf_counter(), 500

        async def noting(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            method = scope["method"] if scope["method"] in _METHODS else "other"  # anybody may invent some
            self._metrics.answered(method, status, time.perf_counter() - began)


class Health(BaseModel):
    """Whether and how the service runs."""

    status: Literal["ok", "degraded"]
    problems: list[str] = Field(description="What is wrong now, a sentence each; it goes when its cause is gone.")
    version: str
    uptime_s: float = Field(description="Since the start [s].")
    objects_available: int
    stage: Literal["starting", "ready", "restarting"] = Field(description="The process that simulates.")


class StorageOut(BaseModel):
    """What the data directory holds; figures may be half a minute old."""

    bytes: dict[str, int] | None = Field(
        description='By kind: "objects", "fields", "goals", "sets", "jobs" (episodes and estimates, too), "training", '
        '"downloads", "other"; null until it has been measured.'
    )
    total: int | None = Field(description="Of all kinds [bytes].")
    seconds_ago: float | None = Field(description="When that was measured [s].")
    allowed: int | None = Field(description="That the directory may hold [bytes]; null for any.")
    free: int = Field(description="On its disk, now [bytes].")
    must_stay_free: int = Field(description="[bytes]")


class LeftoverOut(BaseModel):
    """Files of a training that has not finished; the same order goes on from them."""

    name: str = Field(description="Of the field.")
    bytes: int
    changed_at: str = Field(description="UTC, ISO 8601.")
    job: str | None = Field(description="That trains it or waits to; null where it can be deleted.")


class LeftoverList(BaseModel):
    """All of them, sorted by name."""

    leftovers: list[LeftoverOut]


router = APIRouter(prefix="/api", responses=problems())
VERSION = version("osf-manipulation")
_TEXT: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "The figures."}
}


@router.get("/health", tags=["health"])
@urgent
def health(services: ServicesDep) -> Health:
    """Return that the service runs, and what is wrong with it."""
    runner, disk = services.runner, _disk_problem(services.settings.data_dir)
    stage = runner.scenes.status
    simulation = "The simulation has stopped and is being restarted." if stage == "restarting" else None
    found = (runner.jobs.problem, disk, runner.storage.problem, runner.storing_problem(), simulation)
    wrong = [sentence for sentence in found if sentence is not None]
    return Health(
        status="degraded" if wrong else "ok",
        problems=wrong,
        version=VERSION,
        uptime_s=round(runner.uptime_s, 3),
        objects_available=len(services.objects.names()),
        stage=stage,
    )


@router.get("/metrics", tags=["metrics"], response_class=Response, responses=_TEXT)
def metrics(request: Request) -> Response:
    """Return scenes, jobs, request times and memory in the format of Prometheus."""
    return Response(request.app.state.metrics.text(), headers={"Content-Type": CONTENT_TYPE})


@router.get("/settings", tags=["settings"])
async def settings() -> ServiceSettings:
    """Return defaults and bounds of an episode's settings."""
    return ServiceSettings.now()


storage_router = APIRouter(prefix="/api/storage", tags=["storage"], responses=problems())


@storage_router.get("")
def usage(services: ServicesDep) -> StorageOut:
    """Return how much the data directory holds, by kind, and how much it may."""
    storage = services.runner.storage
    usage = storage.usage()
    return StorageOut(
        bytes=usage.bytes if usage else None,
        total=usage.total if usage else None,
        seconds_ago=round(usage.seconds_ago, 3) if usage else None,
        allowed=storage.max_bytes or None,
        free=storage.free_bytes,
        must_stay_free=storage.min_free_bytes,
    )


@storage_router.get("/training")
def leftovers(services: ServicesDep) -> LeftoverList:
    """List what trainings have left that failed, and what those that go on have made."""
    jobs = {TrainFieldParams.from_json(job.params).name: job.id for job in services.runner.jobs.live("train_field")}
    return LeftoverList(
        leftovers=[
            LeftoverOut(name=left.name, bytes=left.bytes, changed_at=left.changed_at, job=jobs.get(left.name))
            for left in services.runner.leftovers()
        ]
    )


@storage_router.delete("/training/{name}", status_code=204, responses=problems(404, 409, 507))
def delete_leftover(services: ServicesDep, name: Annotated[str, Path(description="Of a field.")]) -> None:
    """Delete what a training has left; the same order then begins anew."""
    with named_in_path():
        services.runner.remove_leftover(name)
