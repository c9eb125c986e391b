"""What an operator watches: the service's state and its requests, in the format of Prometheus."""

from __future__ import annotations

import time
from collections import Counter as Tally
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.services.runner import Runner

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
_UNMEASURED = ("/events", "/viewer")  # they last as long as their page


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
        """Also tell about scenes and jobs from now on."""
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
            ("osf_scenes", "Scenes that are kept.", len(runner.scenes())),
            ("osf_stage_ready", "1 while the simulation takes commands.", runner.simulation_status == "ready"),
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
            self._metrics.answered(_known(scope["method"]), status, time.perf_counter() - began)


def _known(method: str) -> str:
    """Anybody may invent methods; each would be kept for ever."""
    return method if method in ("GET", "HEAD", "POST", "PATCH", "PUT", "DELETE", "OPTIONS") else "other"
