import pytest

from app.jobs.job import Job, ended, job_fields
from app.storage.database import Store
from app.storage.field_files import open_workshop
from tests.app.api.routes.test_jobs import TABLE
from tests.app.api.test_problems import is_problem
from tests.app.conftest import keep_busy, running
from tests.app.services.goals.test_goals import photo

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
