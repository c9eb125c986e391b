import io
import json
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from app.api.app_factory import create_app
from app.api.estimates import EstimateIn, EstimateOut
from app.cli.collect import CollectObservationCommand
from app.jobs.job import Job
from app.services.estimates import Asked
from osfcore.geometry.cameras import default_cameras
from osfcore.io.files import write_json
from osfcore.io.observation_file import read_observation, write_observation
from osfcore.io.scene_file import estimated_from_json, read_estimated
from osfcore.objects.asset_library import AssetLibrary
from tests.app.api.test_jobs import finished
from tests.app.api.test_problems import is_problem
from tests.app.conftest import LONG, keep_busy, running, until
from tests.app.services.test_image_sets import zipped

MUSTARD = "006_mustard_bottle"
ZIP = {"Content-Type": "application/zip"}


def over(service, address, timeout_s=120):
    def is_over():
        found = service.get(address).json()
        return found if found["status"] in ("done", "failed", "cancelled") else None

    return until(is_over, timeout_s)


@pytest.fixture(scope="module")
def scene(service):
    made = service.post("/api/scenes", json={"seed": 2, "objects": [MUSTARD], "image_size": 64}).json()
    yield made
    service.delete(f"/api/scenes/{made['id']}")


@pytest.fixture(scope="module")
def first(service, scene):
    """A finished estimate of the scene."""
    accepted = service.post("/api/estimates", json={"scene": scene["id"], "seed": 1})
    assert accepted.status_code == 202
    assert accepted.headers["location"] == f"/api/estimates/{accepted.json()['id']}"
    return over(service, accepted.headers["location"])


@pytest.mark.slow
def test_a_scene_is_estimated_near_the_truth_that_only_the_simulation_tells(service, scene, first):
    assert (first["status"], first["error"], first["mode"]) == ("done", None, "first")
    assert first["of"] == {"scene": scene["id"], "revision": scene["revision"], "file_name": None}
    assert (first["objects"], first["cameras"]) == ([MUSTARD], ["0", "1", "2", "3"])
    (error,) = first["simulation"]["objects"]
    truth, found = scene["objects"][0], first["estimate"]["objects"][0]
    apart_mm = 1000 * np.linalg.norm(np.array(truth["position"]) - found["position"])
    assert error["position_mm"] == pytest.approx(apart_mm)
    assert error["position_mm"] < 10
    assert error["rotation_deg"] < 5
    assert first["simulation"]["light_deg"] < 5


@pytest.mark.slow
def test_the_result_is_exactly_the_state_file(service, first):
    file = service.get(f"/api/jobs/{first['id']}/files/state.json").json()
    assert first["estimate"] == file
    assert set(file["objects"][0]) == {"name", "position", "quaternion", "uncertainty", "doubt"}
    assert estimated_from_json(first["estimate"]).trusted is first["estimate"]["trusted"]


def test_every_step_is_told_with_its_losses(first):
    steps = first["steps"]
    assert [step["step"] for step in steps] == list(range(1, len(steps) + 1))
    assert steps[0]["stage"] == "orientations"
    assert steps[-1]["stage"] == first["stage"] == "done"
    assert first["done"] == first["total"] == steps[-1]["total"]
    objects = [step["losses"][0] for step in steps if step["stage"] == "objects"]
    assert min(objects[-3:]) <= objects[0]
    assert all(step["loss"] > 0 for step in steps if step["stage"] == "together")
    assert all(step["loss"] is None for step in steps if step["stage"] == "objects")


def pixels(answer):
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), float)


@pytest.mark.slow
def test_images_of_steps_come_closer_to_what_was_observed(service, scene, first):
    address = f"/api/estimates/{first['id']}/images"
    observed = pixels(service.get(f"{address}/1.png", params={"kind": "observed"}))
    np.testing.assert_array_equal(observed, pixels(service.get(f"/api/scenes/{scene['id']}/images/1.png")))
    three = service.get(f"{address}/1.png")
    assert pixels(three).shape == (64, 192, 3)
    np.testing.assert_array_equal(pixels(three)[:, :64], observed)
    early = service.get(f"{address}/1.png", params={"kind": "rendered", "step": 1})
    assert float(three.headers["X-PSNR-dB"]) > float(early.headers["X-PSNR-dB"]) + 3
    is_problem(service.get(f"{address}/4.png"), 404)
    is_problem(service.get(f"{address}/0.png", params={"step": 10_000}), 404)
    is_problem(service.get(f"{address}/0.png", params={"kind": "sketch"}), 422)


@pytest.mark.slow
def test_later_frames_and_goals_begin_with_an_estimate(service, scene, first):
    for mode, views in (("next", 4), ("goal", 1)):
        accepted = service.post("/api/estimates", json={"scene": scene["id"], "mode": mode})
        found = over(service, accepted.headers["location"])
        assert (found["status"], found["error"], found["mode"]) == ("done", None, mode)
        assert len(found["cameras"]) == views
        assert found["simulation"]["objects"][0]["position_mm"] < 20
        assert ("pusher" in found["estimate"]) == (mode == "next")
    listed = service.get("/api/estimates").json()["estimates"]
    assert listed[-1]["id"] == first["id"]
    assert listed[-1]["steps"] == []


@pytest.fixture(scope="module")
def folder(service, tmp_path_factory):
    """An observation folder, with truth.json, from elsewhere."""
    place = tmp_path_factory.mktemp("elsewhere") / "seen"
    data_dir = service.app.state.services.settings.data_dir
    CollectObservationCommand(place, (MUSTARD,), seed=4, size=64, data_dir=data_dir, json=True).run()
    return place


def upload(service, folder, **params):
    return service.post("/api/estimates", params=params, content=zipped(folder), headers=ZIP)


@pytest.mark.slow
def test_an_uploaded_folder_is_estimated_without_errors_against_a_truth(service, folder):
    accepted = upload(service, folder, file_name="mine.zip", seed=3)
    assert accepted.status_code == 202
    found = over(service, accepted.headers["location"])
    assert (found["status"], found["error"], found["simulation"]) == ("done", None, None)
    assert found["of"] == {"scene": None, "revision": None, "file_name": "mine.zip"}
    truth = json.loads((folder / "truth.json").read_text())
    apart = np.array(found["estimate"]["objects"][0]["position"]) - truth["objects"][0]["position"]
    assert np.linalg.norm(apart) < 0.01


@pytest.mark.slow
def test_masks_that_show_something_else_make_a_doubtful_estimate(service, folder, tmp_path):
    observation = read_observation(folder)
    masks = np.zeros_like(observation.masks)
    masks[:, :, 4:20, 4:20] = True  # a corner of the table
    write_observation(tmp_path / "seen", replace(observation, masks=masks))
    found = over(service, upload(service, tmp_path / "seen").headers["location"])
    assert found["status"] == "done"
    assert found["estimate"]["trusted"] is False
    assert found["estimate"]["objects"][0]["doubt"]
    assert MUSTARD in found["estimate"]["reason"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"masks": None}, "masks of the first frame is missing"),
        ({"names": ("spoon",)}, "There is no field named 'spoon'"),
    ],
)
def test_uploads_that_cannot_be_estimated_are_refused_in_one_sentence(service, folder, tmp_path, changes, words):
    write_observation(tmp_path / "seen", replace(read_observation(folder), **changes))
    detail = is_problem(upload(service, tmp_path / "seen"), 422)["detail"]
    assert words in detail
    assert "\n" not in detail


def test_images_of_different_sizes_are_refused(service, folder, tmp_path):
    observation = read_observation(folder)
    write_observation(tmp_path / "seen", observation)
    data = json.loads((tmp_path / "seen" / "observation.json").read_text())
    data["cameras"][1]["width"] = data["cameras"][1]["height"] = default_cameras(32)[1].width
    write_json(tmp_path / "seen" / "observation.json", data)
    detail = is_problem(upload(service, tmp_path / "seen"), 422)["detail"]
    assert "sizes of the cameras [px] is 64 x 64, 32 x 32, 64 x 64, 64 x 64, but it must be the same" in detail


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"json": {"mode": "third"}}, 422, "#/mode"),
        ({"json": {"mode": "first", "extra": 1}}, 422, "#/extra"),
        ({"json": {"scene": "nowhere"}}, 422, "no such scene"),
        ({"json": {"mode": "next", "prior": "x"}}, 422, "no such estimate"),
        ({"json": {}, "params": {"seed": 1}}, 422, "seed stands in the query"),
        ({"content": b"{", "headers": {"Content-Type": "application/json"}}, 422, "JSON"),
        ({"content": b"x", "headers": {"Content-Type": "text/plain"}}, 415, "application/zip for an observation"),
        ({"content": b"no zip", "headers": ZIP}, 422, "The uploaded file cannot be used: it is no zip"),
    ],
)
def test_mistakes_are_told(service, scene, request_, status, words):
    assert words in str(is_problem(service.post("/api/estimates", **request_), status))


def test_clients_may_send_the_defaults_of_the_query_with_json(service, scene):
    operation = create_app().openapi()["paths"]["/api/estimates"]["post"]
    declared = {one["name"]: one["schema"].get("default") for one in operation["parameters"]}
    assert declared["file_name"] == "observation.zip"
    params = {name: value for name, value in declared.items() if value is not None}
    answer = service.post("/api/estimates", json={"scene": "nowhere"}, params=params)
    assert "no such scene" in is_problem(answer, 422)["detail"]


@pytest.mark.parametrize(
    ("method", "tail"), [("get", ""), ("delete", ""), ("get", "/events"), ("get", "/images/0.png")]
)
def test_missing_estimates_are_not_found(service, method, tail):
    is_problem(getattr(service, method)(f"/api/estimates/none{tail}"), 404)


@pytest.mark.slow
def test_an_estimate_in_the_middle_of_a_step_is_cancelled(service, scene):
    accepted = service.post("/api/estimates", json={"scene": scene["id"]})
    address = accepted.headers["location"]
    until(lambda: service.get(address).json()["steps"])
    cancelled = service.delete(address).json()
    assert (cancelled["status"], cancelled["steps"], cancelled["estimate"]) == ("cancelled", [], None)
    is_problem(service.delete(address), 409)
    assert "was cancelled" in is_problem(service.get(f"{address}/images/0.png"), 404)["detail"]


def test_one_that_waits_is_cancelled_and_leaves_nothing(service, services, scene):
    running = service.post("/api/jobs", json=LONG).json()
    waiting = service.post("/api/estimates", json={"scene": scene["id"]}).json()
    assert (waiting["status"], waiting["position"]) == ("queued", 1)
    assert services.runner.jobs.inputs(waiting["id"]).is_dir()
    assert service.delete(f"/api/estimates/{waiting['id']}").json()["status"] == "cancelled"
    assert not services.runner.jobs.folder(waiting["id"]).exists()
    service.delete(f"/api/jobs/{running['id']}")
    finished(service, f"/api/jobs/{running['id']}")


@pytest.mark.slow
def test_an_estimate_can_be_followed_to_its_end(live):
    _, made = live.request("POST", "/api/scenes", {"seed": 2, "objects": [MUSTARD], "image_size": 32})
    status, asked = live.request("POST", "/api/estimates")  # no body at all: the scene that is shown
    assert (status, asked["of"]["scene"]) == (202, made["id"])
    told = []
    with urllib.request.urlopen(f"{live.url}/api/estimates/{asked['id']}/events", timeout=120) as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        for line in stream:  # it ends by itself
            if line.startswith(b"data:"):
                told.append(json.loads(line[5:]))
    assert {job["id"] for job in told} == {asked["id"]}
    assert told[-1]["state"] == "done"
    assert told[-1]["result"]["trusted"] in (True, False)
    assert [job["done"] for job in told] == sorted(job["done"] for job in told)
    assert len({job["result"]["stage"] for job in told if job["result"]}) >= 3
    live.request("DELETE", f"/api/scenes/{made['id']}")


def test_a_table_without_objects_has_no_estimate(tmp_path):
    (tmp_path / "objects").mkdir()
    with running(AssetLibrary(tmp_path / "objects"), tmp_path) as client:
        detail = is_problem(client.post("/api/estimates"), 409)["detail"]
    assert detail == "There is no scene to estimate; make one, or upload an observation."


def test_the_estimate_on_disk_is_what_was_told(services, first):
    path = services.runner.jobs.folder(first["id"]) / "state.json"
    assert read_estimated(path).trusted is first["estimate"]["trusted"]


@pytest.mark.slow
def test_the_method_as_published_is_told_and_refused_for_goals(service, scene):
    busy = keep_busy(service)
    asked = service.post("/api/estimates", json={"scene": scene["id"], "method": "paper"})
    assert asked.status_code == 202, asked.text
    assert asked.json()["method"] == "paper"
    service.delete(f"/api/estimates/{asked.json()['id']}")
    refused = service.post("/api/estimates", json={"scene": scene["id"], "method": "paper", "mode": "goal"})
    service.delete(f"/api/jobs/{busy}")
    assert is_problem(refused, 422)
    assert "method is paper, but it must be ours for a goal image" in refused.json()["detail"]


OF = {"scene": "s", "revision": 2, "file_name": None}
PARAMS = {"mode": "next", "seed": 3, "of": OF, "names": ["a"], "cameras": ["0"]}


def test_nothing_asks_for_the_first_frame_of_the_current_scene():
    assert EstimateIn().asked() == Asked("first", 0, None)
    assert EstimateIn().scene is None
    for wrong in ({"mode": "second"}, {"seed": -1}, {"scene": ""}, {"seed": "1"}, {"more": 1}):
        with pytest.raises(ValidationError):
            EstimateIn.model_validate(wrong)


def test_an_estimate_tells_what_the_job_knows_and_what_it_has_made():
    steps = tuple(
        {
            "step": n,
            "stage": stage,
            "note": "x",
            "done": n,
            "total": 9,
            "losses": [0.5, None],
            "loss": None,
            "guess": {},
        }
        for n, stage in ((1, "light"), (2, "objects"))
    )
    out = EstimateOut.of_job(Job("j", "estimate", PARAMS, "running", 2, 9, "x"), steps, None, None)
    assert (out.id, out.mode, out.status, out.stage, out.objects) == ("j", "next", "running", "objects", ["a"])
    assert out.steps[0].losses == [0.5, None]
    assert "guess" not in out.model_dump()["steps"][0]
    assert (out.estimate, out.simulation) == (None, None)


def test_the_result_keeps_the_form_of_a_state_file():
    state = {
        "objects": [
            {"name": "a", "position": [0.1, 0, 0], "quaternion": [1, 0, 0, 0], "doubt": "",
             "uncertainty": {"position_std_m": None, "rotation_std_rad": 0.1}}
        ],
        "light": {"position": [0, 0, 1], "uncertainty": {"direction_std_rad": 0.1}},
        "trusted": True,
        "reason": "",
    }  # fmt: skip
    out = EstimateOut.of_job(Job("j", "estimate", PARAMS, "done"), (), state, {"objects": [], "light_deg": 0.1})
    assert out.model_dump(exclude_unset=True)["estimate"] == state
