import io
import json
import shutil

import pytest
from PIL import Image

from app.api.fields import FieldOut, SetOut
from app.services.image_sets import SetRecord
from tests.app.api.test_jobs import finished
from tests.app.api.test_problems import is_problem
from tests.app.conftest import LONG, running, until
from tests.app.services.test_image_sets import zipped
from tests.support.ellipsoid_sets import write_set

GELATIN = "009_gelatin_box"
ZIP = {"Content-Type": "application/zip"}
MINUTES = 0.1


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return zipped(write_set(tmp_path_factory.mktemp("upload") / "mug"))


def upload(service, data, name="mug.zip"):
    return service.post("/api/fields/sets", params={"file_name": name}, content=data, headers=ZIP)


def train(service, name, source, **params):
    body = {"kind": "train_field", "params": {"name": name, "source": source, "minutes": MINUTES, **params}}
    return service.post("/api/jobs", json=body)


def test_an_uploaded_set_is_listed_shown_and_deleted(service, archive):
    answer = upload(service, archive)
    assert answer.status_code == 201
    made = answer.json()
    assert (made["train"], made["test"], made["file_name"]) == (12, 4, "mug.zip")
    assert service.get(answer.headers["location"]).json() == made
    assert made in service.get("/api/fields/sets").json()["sets"]
    overlay = service.get(f"/api/fields/sets/{made['id']}/overlay.png")
    assert overlay.headers["content-type"] == "image/png"
    assert min(Image.open(io.BytesIO(overlay.content)).size) >= 32
    assert service.delete(answer.headers["location"]).status_code == 204
    for address in (answer.headers["location"], f"{answer.headers['location']}/overlay.png"):
        is_problem(service.get(address), 404)
    is_problem(service.delete(answer.headers["location"]), 404)


@pytest.mark.slow
def test_a_bad_set_is_refused_in_one_sentence(service, tmp_path):
    folder = write_set(tmp_path / "bad")
    entries = json.loads((folder / "train" / "anno.json").read_text())
    entries[2]["light_pos"] = [0, 0, 0]
    (folder / "train" / "anno.json").write_text(json.dumps(entries))
    detail = is_problem(upload(service, zipped(folder)), 422)["detail"]
    assert detail.startswith("train/anno.json cannot be used: light_pos of entry 2")
    assert "\n" not in detail
    is_problem(upload(service, b"no zip at all"), 422)


def test_an_upload_may_be_larger_than_other_requests_but_not_without_end(library, tmp_path, archive):
    assert len(archive) > 10_000
    limits = {"max_body_bytes": 2000, "max_upload_bytes": 10_000}
    with running(library, tmp_path / "limits", **limits) as small:
        assert "10 KB" in is_problem(upload(small, archive), 413)["detail"]
        assert is_problem(upload(small, b"x" * 9_000), 422)["detail"].startswith("The uploaded file")
        assert "2 KB" in is_problem(small.post("/api/jobs", content=b"x" * 3000), 413)["detail"]
        assert list((tmp_path / "limits" / "sets").iterdir()) == []


@pytest.mark.slow
def test_from_a_mesh_to_a_field_that_can_be_seen_and_deleted(service, services):
    accepted = train(service, GELATIN, {"mesh": GELATIN}, images=60)
    assert accepted.status_code == 202
    assert "already" in is_problem(train(service, GELATIN, {"mesh": GELATIN}), 409)["detail"]
    job = finished(service, accepted.headers["location"], 240)
    assert (job["state"], job["error"]) == ("done", None)
    assert job["done"] == job["total"] > 0
    assert 10 < job["result"]["psnr_mask"] < job["result"]["psnr_full"] < 60
    preview = Image.open(io.BytesIO(service.get(f"/api/jobs/{job['id']}/preview.png").content))
    assert preview.width == 3 * preview.height

    assert job["files"] == [f"{GELATIN}.json", f"{GELATIN}.safetensors", "comparison.png", "preview.png"]

    result = job["result"]
    assert result["in_use"] is False  # some seconds of training against the shipped field's hour
    assert result["psnr_mask"] < result["before_mask"]
    pictures = Image.open(io.BytesIO(service.get(f"/api/jobs/{job['id']}/comparison.png").content))
    assert pictures.width == pictures.height
    assert service.get(f"/api/fields/{GELATIN}").json()["source"] == "shipped"
    assert not (services.settings.data_dir / "fields" / GELATIN).exists()
    other = service.post("/api/fields/006_mustard_bottle/use", json={"job": job["id"]})
    assert "no field of 006_mustard_bottle" in is_problem(other, 409)["detail"]
    is_problem(service.post(f"/api/fields/{GELATIN}/use", json={"job": "nobody"}), 422)
    used = service.patch(f"/api/fields/{GELATIN}", json={"job": job["id"]}).json()

    field = service.get(f"/api/fields/{GELATIN}").json()
    assert (field["source"], field["has_mesh"], field["note"]) == ("trained", True, None)
    assert field["label"] == "Gelatin box"
    assert used == field
    file = service.get(f"/api/jobs/{job['id']}/files/{GELATIN}.safetensors")
    assert 1000 < len(file.content) == field["bytes"] < 3_000_000
    assert field["metrics"]["psnr_mask"] == pytest.approx(job["result"]["psnr_mask"], abs=1e-3)
    assert field in service.get("/api/fields").json()["fields"]
    assert not (services.settings.data_dir / "training" / GELATIN).exists()
    assert service.delete(f"/api/fields/{GELATIN}").status_code == 204
    assert not (services.settings.data_dir / "fields" / GELATIN).exists()


@pytest.mark.slow
def test_from_a_set_to_a_field_that_needs_a_mesh_for_scenes(service, archive):
    made = upload(service, archive).json()
    accepted = train(service, "my_mug", {"set": made["id"]})
    assert "needs these images" in is_problem(service.delete(f"/api/fields/sets/{made['id']}"), 409)["detail"]
    job = finished(service, accepted.headers["location"], 240)
    assert (job["state"], job["error"]) == ("done", None)
    field = service.get("/api/fields/my_mug").json()
    assert (field["label"], field["has_mesh"]) == ("my_mug", False)
    assert "needs a mesh" in field["note"]
    assert service.delete("/api/fields/my_mug").status_code == 204
    is_problem(service.delete("/api/fields/my_mug"), 404)
    assert service.delete(f"/api/fields/sets/{made['id']}").status_code == 204


def test_a_cancelled_training_leaves_nothing(service, services):
    accepted = train(service, "short", {"mesh": GELATIN}, images=5000)
    until(lambda: "Image" in service.get(accepted.headers["location"]).json()["note"], 60)
    is_problem(service.get(f"{accepted.headers['location']}/preview.png"), 404)
    assert service.delete(accepted.headers["location"]).json()["state"] == "cancelled"
    assert not (services.settings.data_dir / "training" / "short").exists()


@pytest.mark.parametrize(
    ("name", "source", "words"),
    [
        ("../evil", {"mesh": GELATIN}, "lower-case letters"),
        ("Mug", {"mesh": GELATIN}, "lower-case letters"),
        ("table", {"mesh": GELATIN}, "another one"),
        ("sets", {"mesh": GELATIN}, "another one"),
        ("a", {"mesh": "teapot"}, "teapot"),
        ("a", {"set": "none"}, "no such image set"),
        ("a", {"set": "../../x"}, "no such image set"),
        ("a", {}, "either mesh or set"),
        ("a", {"mesh": GELATIN, "set": "b"}, "either mesh or set"),
    ],
)
def test_what_cannot_be_trained_is_refused_at_once(service, name, source, words):
    assert words in is_problem(train(service, name, source), 422)["detail"]


def test_missing_fields_and_previews_are_not_found(service):
    is_problem(service.get("/api/fields/none"), 404)
    is_problem(service.delete("/api/fields/none"), 404)
    is_problem(service.get("/api/fields/..%2f..%2fservice.sqlite3"), 404)
    is_problem(service.get("/api/jobs/none/preview.png"), 404)
    job = service.post("/api/jobs", json=LONG).json()
    assert "training a field" in is_problem(service.get(f"/api/jobs/{job['id']}/preview.png"), 404)["detail"]
    service.delete(f"/api/jobs/{job['id']}")


@pytest.mark.parametrize(
    "metrics", ['{"device": "\\ud800"}', '{"recipe": ' + "[" * 900 + "]" * 900 + "}", '{"psnr_full": NaN}']
)
def test_odd_metrics_do_not_hide_the_fields(service, services, metrics):
    folder = services.settings.data_dir / "fields" / "odd"
    folder.mkdir(parents=True)
    (folder / "field.safetensors").write_bytes(b"weights")
    (folder / "field.json").write_text(metrics)
    answer = service.get("/api/fields")
    assert answer.status_code == 200
    (found,) = [field for field in answer.json()["fields"] if field["name"] == "odd"]
    assert found["metrics"] == {}
    assert service.delete("/api/fields/odd").status_code == 204


def test_damaged_sets_do_not_hide_the_list(service, services):
    folder = services.settings.data_dir / "sets" / "odd"
    folder.mkdir(parents=True)
    (folder / "set.json").write_text(
        '{"id": 1, "file_name": 2, "created_at": 3, "train": "a", "test": [], "summary": {}}'
    )
    assert service.get("/api/fields/sets").status_code == 200
    shutil.rmtree(folder)


def test_a_set_says_what_the_store_says():
    record = SetRecord("a1", "mug.zip", "2026-01-01T00:00:00.000Z", 260, 40, "300 images")
    assert SetOut.of(record).model_dump()["train"] == 260


def test_metrics_that_are_no_numbers_go_out_as_null():
    out = FieldOut(
        name="a",
        label="A",
        source="trained",
        bytes=1,
        metrics={"psnr_full": float("nan")},
        published=None,
        has_mesh=True,
        note=None,
    )
    assert '"psnr_full":null' in out.model_dump_json()
