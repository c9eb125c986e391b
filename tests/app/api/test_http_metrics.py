import asyncio

import pytest
from prometheus_client.parser import text_string_to_metric_families

from app.api.http_metrics import Metrics, MetricsMiddleware


def samples(metrics):
    found = {}
    for family in text_string_to_metric_families(metrics.text().decode()):
        for sample in family.samples:
            found[sample.name, *sorted(sample.labels.items())] = sample.value
    return found


def ask(metrics, path="/api/scenes", method="GET", status=200, kind="http"):
    async def app(_scope, _receive, send):
        await send({"type": "http.response.start", "status": status, "headers": []})
        if status == 599:
            raise RuntimeError

    async def send(_message):
        pass

    scope = {"type": kind, "path": path, "method": method}
    asyncio.run(MetricsMiddleware(app, metrics=metrics)(scope, None, send))


def count(metrics, method, status):
    return samples(metrics).get(("osf_request_seconds_count", ("method", method), ("status", str(status))), 0)


def test_requests_are_counted_by_method_and_status():
    metrics = Metrics()
    for status in (200, 200, 404):
        ask(metrics, status=status)
    ask(metrics, method="POST", status=202)
    assert (count(metrics, "GET", 200), count(metrics, "GET", 404), count(metrics, "POST", 202)) == (2, 1, 1)


def test_a_request_that_breaks_down_counts_too():
    metrics = Metrics()
    with pytest.raises(RuntimeError):
        ask(metrics, status=599)
    assert count(metrics, "GET", 599) == 1


@pytest.mark.parametrize("what", [{"path": "/api/events"}, {"path": "/viewer", "kind": "websocket"}])
def test_what_streams_is_not_timed(what):
    metrics = Metrics()
    ask(metrics, **what)
    assert count(metrics, "GET", 200) == 0


def test_methods_that_somebody_invents_are_not_kept_apart():
    metrics = Metrics()
    for number in range(50):
        ask(metrics, method=f"M{number}")
    assert count(metrics, "other", 200) == 50


def test_a_service_tells_its_scenes_jobs_and_memory(service, scene):
    answer = service.get("/api/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    text = answer.text
    assert "osf_stage_ready 1.0" in text
    assert "process_resident_memory_bytes" in text
    scenes = next(line for line in text.splitlines() if line.startswith("osf_scenes "))
    assert float(scenes.split()[1]) == len(service.get("/api/scenes").json()["scenes"])
