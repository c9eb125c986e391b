import io
import json
import zipfile

import h5py
import pytest
from pydantic import TypeAdapter, ValidationError

from app.api.jobs import JobIn, JobOut
from app.jobs.job import Job
from tests.app.api.test_problems import is_problem
from tests.app.conftest import LONG, full_disk, keep_busy, until

TABLE = {"kind": "collect_table", "params": {"images": 60, "size": 16}}


def finished(service, address, timeout_s=60):
    def is_over():
        job = service.get(address).json()
        return job if job["state"] in ("done", "failed", "cancelled") else None

    return until(is_over, timeout_s)


def test_a_collection_runs_to_its_end_and_can_be_downloaded(service):
    accepted = service.post("/api/jobs", json=TABLE)
    assert accepted.status_code == 202
    assert accepted.json()["state"] in ("queued", "running")
    job = finished(service, accepted.headers["location"])
    assert (job["state"], job["done"], job["total"], job["error"]) == ("done", 60, 60, None)
    assert job["files"] == ["table.zip"]
    file = service.get(f"/api/jobs/{job['id']}/files/table.zip")
    names = zipfile.ZipFile(io.BytesIO(file.content)).namelist()
    assert {"table/train/anno.json", "table/test/anno.json"} <= set(names)
    annotations = json.loads(zipfile.ZipFile(io.BytesIO(file.content)).read("table/test/anno.json"))
    assert annotations[0]["resolution"] == 16
    is_problem(service.get(f"/api/jobs/{job['id']}/files/anno.json"), 404)
    is_problem(service.get(f"/api/jobs/{job['id']}/files/..%2f..%2fservice.sqlite3"), 404)
    is_problem(service.delete(accepted.headers["location"]), 409)


@pytest.mark.slow
def test_pushes_end_in_one_file(service):
    body = {"kind": "collect_pushes", "params": {"episodes": 2, "steps": 3, "objects": 2, "seed": 1}}
    job = finished(service, service.post("/api/jobs", json=body).headers["location"])
    assert (job["state"], job["files"]) == ("done", ["pushes.h5"])
    assert 0 <= job["result"]["contact_share"] <= 1
    with h5py.File(io.BytesIO(service.get(f"/api/jobs/{job['id']}/files/pushes.h5").content)) as file:
        assert len(file.keys()) > 0


@pytest.mark.slow
def test_one_runs_the_rest_wait_with_their_places(service, services):
    first = service.post("/api/jobs", json=LONG).json()
    until(lambda: service.get(f"/api/jobs/{first['id']}").json()["done"] > 0)
    second, third = (service.post("/api/jobs", json=TABLE).json() for _ in range(2))
    assert (second["position"], third["position"]) == (1, 2)
    listed = [job["id"] for job in service.get("/api/jobs").json()["jobs"][:3]]
    assert listed == [third["id"], second["id"], first["id"]]

    assert service.delete(f"/api/jobs/{second['id']}").json()["state"] == "cancelled"
    assert service.get(f"/api/jobs/{third['id']}").json()["position"] == 1
    is_problem(service.post(f"/api/jobs/{third['id']}/pause"), 409)

    assert service.post(f"/api/jobs/{first['id']}/pause").json()["state"] == "paused"
    is_problem(service.post(f"/api/jobs/{first['id']}/pause"), 409)
    assert service.post(f"/api/jobs/{first['id']}/resume").json()["state"] == "running"
    ended = service.delete(f"/api/jobs/{first['id']}").json()
    assert (ended["state"], ended["files"]) == ("cancelled", [])
    assert not services.runner.jobs.folder(first["id"]).exists()
    assert finished(service, f"/api/jobs/{third['id']}")["state"] == "done"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"kind": "dance"}, "kind"),
        ({"kind": "collect_object", "params": {"name": "teapot"}}, "teapot"),
        ({"kind": "collect_object", "params": {"name": "006_mustard_bottle", "images": 10}}, "images"),
        ({"kind": "collect_pushes", "params": {"objects": 8}}, "at most 5"),
        ({"kind": "fetch_assets", "params": {"names": ["teapot"]}}, "teapot"),
    ],
)
def test_what_cannot_be_is_refused_at_once(service, body, words):
    assert words in str(is_problem(service.post("/api/jobs", json=body), 422))


@pytest.mark.parametrize(("method", "tail"), [("get", ""), ("delete", ""), ("post", "/pause"), ("get", "/files/x")])
def test_missing_jobs_are_not_found(service, method, tail):
    is_problem(getattr(service, method)(f"/api/jobs/none{tail}"), 404)


def test_a_job_that_cannot_be_stored_is_not_answered_202(service, services):
    before = service.get("/api/jobs").json()
    with full_disk():
        answer = service.post("/api/jobs", json=TABLE)
    detail = is_problem(answer, 507)["detail"]
    assert "service.sqlite3 cannot be written" in detail
    assert str(services.settings.data_dir) not in detail
    assert service.get("/api/jobs").json() == before


@pytest.mark.slow
def test_a_finished_job_is_removed_for_good_and_a_live_one_is_not(service, services):
    busy = keep_busy(service)
    detail = is_problem(service.delete(f"/api/jobs/{busy}", params={"forget": True}), 409)["detail"]
    assert detail == "This data collection is paused, so it cannot be removed; cancel it first."
    service.delete(f"/api/jobs/{busy}")
    is_problem(service.delete(f"/api/jobs/{busy}"), 409)
    gone = service.delete(f"/api/jobs/{busy}", params={"forget": True})
    assert (gone.status_code, gone.content) == (204, b"")
    is_problem(service.get(f"/api/jobs/{busy}"), 404)
    is_problem(service.delete(f"/api/jobs/{busy}", params={"forget": True}), 404)
    assert busy not in [job["id"] for job in service.get("/api/jobs").json()["jobs"]]
    assert not services.runner.jobs.folder(busy).exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["episodes", "estimates"])
def test_finished_episodes_and_estimates_are_removed_for_good(service, services, scene, kind):
    busy = keep_busy(service)
    poses = [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in scene["objects"]]
    body = {"scene": scene["id"], **({"poses": poses} if kind == "episodes" else {})}
    made = service.post(f"/api/{kind}", json=body).json()["id"]
    assert "queued" in is_problem(service.delete(f"/api/{kind}/{made}", params={"forget": True}), 409)["detail"]
    assert service.delete(f"/api/{kind}/{made}").json()["status"] == "cancelled"
    assert service.delete(f"/api/{kind}/{made}", params={"forget": True}).status_code == 204
    is_problem(service.get(f"/api/{kind}/{made}"), 404)
    assert not services.runner.jobs.folder(made).exists()
    service.delete(f"/api/jobs/{busy}")


def test_jobs_are_told_apart_by_kind():
    adapter = TypeAdapter(JobIn)
    job = adapter.validate_python({"kind": "collect_pushes", "params": {"episodes": 2}})
    assert job.params.model_dump()["steps"] == 50
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "collect_object"})
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "collect_pushes", "params": {"out": "/etc/passwd"}})


def test_a_job_says_what_the_registry_says():
    out = JobOut.of(Job("a", "collect_table", {"images": 60}, files=("table.zip",), position=2))
    assert (out.files, out.position, out.state) == (["table.zip"], 2, "queued")


def test_a_field_is_learned_from_a_mesh_or_from_a_set_and_never_both():
    adapter = TypeAdapter(JobIn)
    order = {"kind": "train_field", "params": {"name": "mug", "source": {"mesh": "025_mug"}, "minutes": 1}}
    params = adapter.validate_python(order).params.model_dump()
    assert params["source"] == {"mesh": "025_mug", "set": None}
    assert (params["minutes"], params["images"], params["seed"]) == (1, 300, 0)
    for source in ({}, {"mesh": "a", "set": "b"}, {"folder": "/etc"}):
        with pytest.raises(ValidationError):
            adapter.validate_python({"kind": "train_field", "params": {"name": "mug", "source": source}})
    with pytest.raises(ValidationError, match="minutes"):
        adapter.validate_python({"kind": "train_field", "params": {**order["params"], "minutes": 0}})
