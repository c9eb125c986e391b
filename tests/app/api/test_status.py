import asyncio
from importlib.metadata import version

import pytest
from prometheus_client.parser import text_string_to_metric_families

from app.api.episodes import SettingsIn
from app.api.status import Metrics, MetricsMiddleware
from app.episodes.settings import ChosenSettings
from app.jobs.job import Job, ended, job_fields
from app.storage.database import Store
from app.storage.field_files import open_workshop
from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput
from tests.app.api.test_jobs import TABLE
from tests.app.api.test_problems import is_problem
from tests.app.conftest import full_disk, keep_busy, running, until
from tests.app.services.test_goals import photo


def test_health_tells_version_objects_and_stage(service, library):
    health = until(lambda: (h := service.get("/api/health").json())["stage"] == "ready" and h)
    assert health["version"] == version("osf-manipulation")
    assert health["status"] == "ok"
    assert health["objects_available"] == len(library.names())
    assert health["uptime_s"] > 0


def test_the_figures_are_plain_text_for_prometheus(service):
    answer = service.get("/api/metrics")
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert answer.text.startswith("# HELP")
    assert "osf_uptime_seconds" in answer.text


def test_defaults_and_bounds_are_told(service):
    told = service.get("/api/settings").json()["episode"]
    assert told["defaults"]["steps"] == EpisodeSettings().steps
    assert set(told["bounds"]) == {"steps", "replan_every", "samples", "horizon", "temperature"}
    for name, (least, most) in told["bounds"].items():
        assert least <= told["defaults"][name] <= most


@pytest.mark.parametrize("name", ["steps", "replan_every", "samples", "horizon", "temperature"])
@pytest.mark.parametrize("end", [0, 1])
def test_what_is_at_a_bound_is_taken_and_what_is_beyond_is_refused_before_anything_begins(service, name, end):
    bound = service.get("/api/settings").json()["episode"]["bounds"][name][end]
    whole = int if name != "temperature" else float
    assert SettingsIn.model_validate({name: whole(bound)}).given() == {name: bound}
    beyond = bound * 2 if end else bound / 2 if name == "temperature" else bound - 1
    answer = service.post("/api/episodes", json={"goal": "g", "settings": {name: whole(beyond)}})
    assert f"settings/{name}" in is_problem(answer, 422)["errors"][0]["pointer"]


def test_the_bounds_are_those_of_the_settings_themselves(service):
    ours = ChosenSettings.defaults()
    for name, bounds in service.get("/api/settings").json()["episode"]["bounds"].items():
        whole = int if name != "temperature" else float
        for bound in bounds:
            ours.changed({name: whole(bound)})
        for beyond in (whole(bounds[1] * 2), whole(bounds[0] / 2)):
            with pytest.raises(InvalidInput):
                ours.changed({name: beyond})


def test_health_tells_of_what_could_not_be_stored_until_it_is(service, scene):
    with full_disk():
        assert service.post(f"/api/scenes/{scene['id']}/actions", json={"actions": [[0.05, 0, 0]]}).status_code == 200
        health = service.get("/api/health").json()
    assert health["status"] == "degraded"
    assert "What has become of one scene or job could not be stored" in " ".join(health["problems"])
    until(lambda: "could not be stored" not in " ".join(service.get("/api/health").json()["problems"]))


PNG = {"content-type": "image/png"}
ZIP = {"content-type": "application/zip"}
BOX = "003_cracker_box"


@pytest.fixture
def left(services):
    """What a training that failed has left."""
    data_dir = services.settings.data_dir
    (open_workshop(data_dir, "my_mug", {}) / "checkpoint").write_bytes(b"x" * 1000)
    return "my_mug"


def test_the_data_directory_is_told_by_kind(service, services):
    told = service.get("/api/storage").json()
    assert told["total"] == sum(told["bytes"].values()) > told["bytes"]["objects"] > 0
    assert set(told["bytes"]) == {
        "objects", "fields", "goals", "photos", "sets", "jobs", "training", "downloads", "other"
    }  # fmt: skip
    assert told["allowed"] == services.settings.max_data_bytes
    assert told["free"] > told["must_stay_free"] == services.settings.min_free_bytes


def test_leftovers_of_training_are_told_and_deleted(service, services, left):
    listed = {entry["name"]: entry for entry in service.get("/api/storage/training").json()["leftovers"]}
    assert listed[left]["bytes"] > 1000
    assert listed[left]["job"] is None
    assert service.delete(f"/api/storage/training/{left}").status_code == 204
    assert left not in [entry["name"] for entry in service.get("/api/storage/training").json()["leftovers"]]
    assert list((services.settings.data_dir / "training").glob("*my_mug*")) == []
    is_problem(service.delete(f"/api/storage/training/{left}"), 404)


@pytest.mark.slow
def test_leftovers_that_a_waiting_training_goes_on_from_stay(service, left):
    busy = keep_busy(service)
    params = {"name": left, "source": {"mesh": BOX}, "minutes": 0.1}
    job = service.post("/api/jobs", json={"kind": "train_field", "params": params}).json()["id"]
    (entry,) = (one for one in service.get("/api/storage/training").json()["leftovers"] if one["name"] == left)
    assert entry["job"] == job
    detail = is_problem(service.delete(f"/api/storage/training/{left}"), 409)["detail"]
    assert detail == f"The training of {left} that is queued needs these files; cancel it first."
    for one in (job, busy):
        service.delete(f"/api/jobs/{one}")


@pytest.mark.parametrize("name", ["..", "..%2fobjects", ".hidden", "nothing"])
def test_only_what_is_listed_is_deleted(service, services, name):
    (services.settings.data_dir / "training" / ".hidden").mkdir(parents=True, exist_ok=True)
    is_problem(service.delete(f"/api/storage/training/{name}"), 405 if name.startswith("..") else 404)
    assert (services.settings.data_dir / "objects").is_dir()
    assert (services.settings.data_dir / "training" / ".hidden").is_dir()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"max_data_bytes": 1000, "min_free_bytes": 0}, "but it may hold 1000 bytes (OSF_MAX_DATA_BYTES)"),
        ({"max_data_bytes": 0, "min_free_bytes": 1 << 62}, "must stay free (OSF_MIN_FREE_BYTES)"),
    ],
)
def test_where_there_is_no_room_whatever_writes_is_refused(library, tmp_path, limits, words):
    with running(library, tmp_path, **limits) as client:
        scene = client.post("/api/scenes", json={"seed": 1, "objects": [BOX]}).json()
        poses = [{key: scene["objects"][0][key] for key in ("name", "position", "quaternion")}]
        for path, request in (
            ("jobs", {"json": TABLE}),
            ("episodes", {"json": {"poses": poses}}),
            ("estimates", {"json": {"mode": "first"}}),
            ("estimates", {"content": b"PK", "headers": ZIP}),
            ("goals", {"json": {"random": {"moved": 1}}}),
            ("goals", {"content": photo(64, 64), "headers": PNG}),
            ("fields/sets", {"content": b"PK", "headers": ZIP}),
        ):
            detail = is_problem(client.post(f"/api/{path}", **request), 507)["detail"]
            assert words in detail
            assert "; delete some finished jobs" in detail
            assert str(tmp_path) not in detail
        assert client.get("/api/jobs").json()["total"] == client.get("/api/goals").json()["total"] == 0
        collections = tmp_path / "collections"
        assert not collections.exists() or list(collections.iterdir()) == []


def test_after_a_job_was_deleted_there_is_room_at_once(library, tmp_path):
    with running(library, tmp_path, max_data_bytes=0) as client:
        held = client.get("/api/storage").json()["total"]
    done = ended(Job("done", "collect_table", {}), "done")
    store = Store(tmp_path)
    store.save_job("done", 1, job_fields(done))
    store.close()
    (tmp_path / "collections" / "done").mkdir(parents=True)
    (tmp_path / "collections" / "done" / "table.zip").write_bytes(bytes(2_000_000))
    with running(library, tmp_path, max_data_bytes=held + 1_000_000) as client:
        is_problem(client.post("/api/jobs", json=TABLE), 507)
        client.delete("/api/jobs/done", params={"forget": True})
        assert client.post("/api/jobs", json=TABLE).status_code == 202


def test_the_figures_for_prometheus_tell_room(service):
    service.get("/api/storage")
    text = service.get("/api/metrics").text
    assert 'osf_data_bytes{kind="objects"}' in text
    assert "osf_disk_free_bytes" in text


def test_health_tells_that_there_is_no_room(library, tmp_path):
    with running(library, tmp_path, min_free_bytes=1 << 60) as client:
        health = client.get("/api/health").json()
        is_problem(client.post("/api/jobs", json=TABLE), 507)
    assert health["status"] == "degraded"
    assert "OSF_MIN_FREE_BYTES" in health["problems"][0]


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
