import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from app.api.app_factory import create_app
from app.api.goals import DraftIn, DraftKeep, DraftOut, DraftPatch, GoalIn, GoalOut
from app.services.goals import Draft
from app.services.service_settings import Settings
from app.storage.records import GoalRecord
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.scene_file import camera_to_json
from tests.app.api.test_problems import is_problem
from tests.app.conftest import LONG, until
from tests.app.services.test_goals import photo
from tests.app.storage.test_photos import ODD_ANY, ODD_TURNED, ODD_UPRIGHT, jpeg_with

BOX, MUSTARD = "003_cracker_box", "006_mustard_bottle"
PNG = {"Content-Type": "image/png"}


@pytest.fixture(autouse=True)
def tidy(service):
    """Goals are few, so each test removes its own."""
    before = {goal["id"] for goal in service.get("/api/goals").json()["goals"]}
    yield
    for goal in service.get("/api/goals").json()["goals"]:
        if goal["id"] not in before:
            service.delete(f"/api/goals/{goal['id']}")
    service.delete("/api/goals/draft")


def upload(service, data, headers=PNG, **params):
    return service.post("/api/goals", content=data, headers=headers, params=params)


def pixels(answer):
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), float)


def aside(entry, x_m):
    """Where an object is, and a little to the side."""
    x, y, z = entry["position"]
    return {"name": entry["name"], "position": [x + x_m, y, z], "quaternion": entry["quaternion"]}


def changed(before, after):
    """Objects that lie elsewhere."""
    apart = {one["name"]: np.array(one["position"]) for one in before["objects"]}
    return {one["name"] for one in after["objects"] if np.linalg.norm(apart[one["name"]] - one["position"]) > 0.01}


@pytest.fixture
def held(service, services, scene):
    """The scene, while a job drives it."""
    job = service.post("/api/jobs", json=LONG).json()
    until(lambda: service.get(f"/api/jobs/{job['id']}").json()["done"] > 0)
    services.runner.jobs.change(job["id"], {"scene": scene["id"]})
    yield scene
    service.delete(f"/api/jobs/{job['id']}")


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_photo_is_kept_as_it_looks(service, kind):
    made = upload(service, photo(640, 640, kind), {"Content-Type": f"image/{kind.lower()}"}, name="From above")
    assert made.status_code == 201
    goal = made.json()
    assert made.headers["location"] == f"/api/goals/{goal['id']}"
    assert (goal["name"], goal["source"], goal["scene"], goal["objects"]) == ("From above", "upload", None, None)
    assert (goal["width"], goal["height"], goal["camera"]["name"]) == (512, 512, "goal")
    assert service.get(made.headers["location"]).json() == goal == service.get("/api/goals").json()["goals"][0]
    seen = pixels(service.get(f"{made.headers['location']}/image.png"))
    assert seen.shape == (512, 512, 3)
    assert np.abs(seen.mean(axis=(0, 1)) - [200, 100, 50]).max() < 4
    assert service.delete(made.headers["location"]).status_code == 204
    is_problem(service.get(made.headers["location"]), 404)


def test_a_photo_may_bring_its_own_camera(service):
    camera = camera_to_json(replace(goal_camera(96), name="mine", height=64))
    goal = upload(service, photo(96, 64), camera=json.dumps(camera)).json()
    assert (goal["width"], goal["height"], goal["camera"]["name"]) == (96, 64, "mine")
    assert goal["photo"]["crop"] == {"left": 0, "top": 0, "width": 96, "turn_deg": 0}


def test_a_photo_is_cropped_in_its_own_pixels(service):
    made = upload(service, photo(96, 64)).json()
    assert made["photo"] == {"width": 96, "height": 64, "crop": {"left": 16, "top": 0, "width": 64, "turn_deg": 0}}
    path = f"/api/goals/{made['id']}"
    cropped = service.patch(path, json={"crop": {"left": 0, "top": 10, "width": 50}}).json()
    assert (cropped["width"], cropped["photo"]["crop"]["top"]) == (50, 10)
    assert service.get(path).json() == cropped
    with Image.open(io.BytesIO(service.get(f"{path}/photo.jpg").content)) as whole:
        assert whole.size == (96, 64)
    beside = is_problem(service.patch(path, json={"crop": {"left": 60, "top": 0, "width": 50}}), 422)
    assert "within the photo's 96 x 64" in beside["detail"]


def test_a_goal_that_was_made_here_has_no_photo(service, scene):
    made = service.post("/api/goals", json={"random": {"seed": 1}}).json()
    path = f"/api/goals/{made['id']}"
    assert made["photo"] is None
    is_problem(service.get(f"{path}/photo.jpg"), 404)
    crop = {"crop": {"left": 0, "top": 0, "width": 50}}
    assert "nothing to crop" in is_problem(service.patch(path, json=crop), 409)["detail"]
    assert service.get(f"{path}/check").json() == {"verdict": "shown", "refused": False, "text": "", "scene": None}


@pytest.mark.slow
def test_a_photo_of_nothing_is_refused_by_the_check_and_by_episodes(service, scene):
    goal = upload(service, photo(96, 96)).json()["id"]
    check = service.get(f"/api/goals/{goal}/check").json()
    assert (check["verdict"], check["refused"]) == ("bare", True)
    assert is_problem(service.post("/api/episodes", json={"goal": goal}), 409)["detail"] == check["text"]
    is_problem(service.get(f"/api/goals/{goal}/check", params={"scene": "nowhere"}), 422)


def test_odd_metadata_is_no_defect_of_the_service(service):
    for name, odd in (ODD_TURNED | ODD_UPRIGHT | ODD_ANY).items():
        made = upload(service, jpeg_with(odd, size=(64, 64)), {"Content-Type": "image/jpeg"})
        if name in ODD_ANY and made.status_code == 422:
            continue
        assert made.status_code == 201, name
        service.delete(made.headers["location"])


@pytest.mark.parametrize(
    "camera",
    [
        "",
        "{",
        "[]",
        "5",
        "null",
        "{}",
        "[" * 3000,
        "9" * 3999,
        '{"name": "\\ud800"}',
        json.dumps({**camera_to_json(goal_camera(64)), "width": 10**30}),
        json.dumps({**camera_to_json(goal_camera(64)), "width": True}),
        json.dumps({**camera_to_json(goal_camera(64)), "height": -64}),
        json.dumps({**camera_to_json(goal_camera(64)), "K": [[1e999, 0, 0], [0, 1, 0], [0, 0, 1]]}),
        json.dumps({**camera_to_json(goal_camera(64)), "K": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}),
        json.dumps({**camera_to_json(goal_camera(64)), "T_world_camera": [[0] * 4] * 4}),
    ],
    ids=lambda text: text[:12],
)
def test_a_camera_that_makes_no_sense_is_refused(service, camera):
    is_problem(upload(service, photo(), camera=camera), 422)


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"content": b"GIF89a", "headers": PNG}, 422, "no picture that can be read here"),
        ({"content": photo()[:100], "headers": PNG}, 422, "damaged or incomplete"),
        ({"content": photo(31, 31), "headers": PNG}, 422, "31 x 31"),
        ({"content": b"", "headers": PNG}, 422, "picture"),
        ({"content": photo(), "headers": PNG, "params": {"name": ""}}, 422, "name"),
        ({"content": photo(), "headers": PNG, "params": {"name": "x" * 101}}, 422, "name"),
        ({"content": photo(), "headers": {"Content-Type": "video/mp4"}}, 415, "such as a JPEG"),
        ({"content": photo()}, 415, "Send a photo"),
        ({"json": {}}, 422, "either objects or random"),
        ({"json": {"random": {}, "objects": []}}, 422, "#/objects"),
        ({"json": {"random": {"moved": 3}}}, 422, "between 1 and 2"),
        ({"json": {"random": {}, "scene": "nowhere"}}, 422, "no such scene"),
        ({"json": {"random": {}, "light": {"position": [1, 0, 0]}}}, 422, "light"),
        ({"content": b"{", "headers": {"Content-Type": "application/json"}}, 422, "JSON"),
        ({"content": b"0" * (5 << 20), "headers": {"Content-Type": "application/json"}}, 413, "larger"),
        ({"content": b"0" * (21 << 20), "headers": PNG}, 413, "larger"),
    ],
)
def test_mistakes_are_told(service, scene, request_, status, words):
    assert words in str(is_problem(service.post("/api/goals", **request_), status))
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene


def test_a_layout_by_hand_becomes_a_goal_and_the_scene_stays(service, scene):
    body = {"objects": [aside(scene["objects"][0], 0.1)], "name": "Aside"}
    made = service.post("/api/goals", json=body)
    assert made.status_code == 201
    goal = made.json()
    assert (goal["source"], goal["scene"], goal["name"]) == ("composed", scene["id"], "Aside")
    assert changed(scene, goal) == {scene["objects"][0]["name"]}
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene
    view = service.get(f"/api/scenes/{scene['id']}/images/goal.png", params={"size": goal["width"]})
    assert np.abs(pixels(view) - pixels(service.get(f"{made.headers['location']}/image.png"))).max() > 50


def test_a_random_goal_moves_as_many_as_asked_under_any_light(service, scene):
    plain, dark = (
        service.post("/api/goals", json={"random": {"seed": 4, "moved": 1}, **light}).json()
        for light in ({}, {"light": {"position": [0.5, 0.5, 0.3]}})
    )
    assert plain["source"] == "drawn"
    assert len(changed(scene, plain)) == 1
    assert changed(plain, dark) == set()
    one, other = (pixels(service.get(f"/api/goals/{goal['id']}/image.png")) for goal in (plain, dark))
    assert np.abs(one - other).mean() > 1
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene


@pytest.mark.parametrize(
    ("objects", "words"),
    [
        (lambda box, bottle: [{**box, "position": bottle["position"]}], "verlap"),
        (lambda box, _: [{**box, "position": [5, 0, 0.1]}], "over the table"),
        (lambda box, _: [{**box, "name": "teapot"}], "teapot"),
        (lambda box, _: [{**box, "quaternion": [0, 0, 0, 0]}], "unit quaternion"),
        (lambda box, _: [box, box], "without repetition"),
    ],
)
def test_layouts_that_cannot_be_are_refused_and_nothing_moves(service, scene, objects, words):
    body = {"objects": objects(*(aside(entry, 0.0) for entry in scene["objects"]))}
    assert words in is_problem(service.post("/api/goals", json=body), 422)["detail"]
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene


def test_a_draft_is_laid_out_looked_at_and_kept(service, scene):
    is_problem(service.get("/api/goals/draft"), 404)
    begun = service.post("/api/goals/draft", json={})
    assert begun.status_code == 201
    draft = begun.json()
    assert (draft["scene"], draft["problem"], draft["revision"]) == (scene["id"], "", 1)
    assert changed(scene, draft) == set()
    assert all(entry["label"] for entry in draft["objects"])
    before = pixels(service.get("/api/goals/draft/image.png?v=1"))

    patch = {"objects": [aside(scene["objects"][0], 0.1)]}
    moved = service.patch("/api/goals/draft", json=patch).json()
    assert changed(scene, moved) == {scene["objects"][0]["name"]}
    assert np.abs(pixels(service.get("/api/goals/draft/image.png?v=2")) - before).max() > 50
    assert service.get("/api/goals/draft").json() == moved

    kept = service.post("/api/goals/draft/save", json={"name": "By hand"})
    assert kept.status_code == 201
    assert kept.headers["location"] == f"/api/goals/{kept.json()['id']}"
    assert changed(moved, kept.json()) == set()
    assert service.get("/api/goals").json()["goals"][0] == kept.json()
    is_problem(service.get("/api/goals/draft"), 404)
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene


def test_a_draft_tells_its_problem_until_it_is_gone(service, scene):
    service.post("/api/goals/draft", json={"scene": scene["id"]})
    box, bottle = scene["objects"]
    into = {**aside(box, 0.0), "position": bottle["position"]}
    bad = service.patch("/api/goals/draft", json={"objects": [into]})
    assert bad.status_code == 200
    assert "verlap" in bad.json()["problem"]
    assert bad.json()["objects"][0]["position"] == bottle["position"]
    assert "verlap" in is_problem(service.post("/api/goals/draft/save", json={}), 409)["detail"]
    pixels(service.get("/api/goals/draft/image.png"))
    good = service.patch("/api/goals/draft", json={"objects": [aside(box, 0.1)]}).json()
    assert good["problem"] == ""
    assert good["revision"] > bad.json()["revision"]


def test_without_a_draft_there_is_nothing_to_change(service, scene):
    patch = {"objects": [aside(scene["objects"][0], 0.0)]}
    is_problem(service.patch("/api/goals/draft", json=patch), 404)
    is_problem(service.post("/api/goals/draft/save", json={}), 404)
    is_problem(service.get("/api/goals/draft/image.png"), 404)
    assert service.delete("/api/goals/draft").status_code == 204
    service.post("/api/goals/draft", json={})
    for objects in ([{**patch["objects"][0], "name": "teapot"}], [{**patch["objects"][0], "quaternion": [9, 0, 0, 0]}]):
        is_problem(service.patch("/api/goals/draft", json={"objects": objects}), 422)
    assert service.get("/api/goals/draft").json()["revision"] == 1
    assert service.delete("/api/goals/draft").status_code == 204
    is_problem(service.get("/api/goals/draft"), 404)


@pytest.mark.slow
def test_a_scene_that_a_job_drives_is_left_alone(service, held):
    for method, address, body in (
        ("post", "/api/goals", {"random": {}}),
        ("post", "/api/goals", {"objects": [aside(held["objects"][0], 0.1)]}),
        ("post", "/api/goals/draft", {}),
    ):
        assert "pause or cancel" in is_problem(getattr(service, method)(address, json=body), 409)["detail"]
    assert upload(service, photo()).status_code == 201  # has nothing to do with it


@pytest.mark.parametrize(("method", "tail"), [("get", ""), ("delete", ""), ("get", "/image.png")])
def test_missing_goals_are_not_found(service, method, tail):
    is_problem(getattr(service, method)(f"/api/goals/none{tail}"), 404)


def test_a_goal_with_half_a_picture_is_listed_as_damaged_until_it_is_deleted(service, services):
    path = f"/api/goals/{upload(service, photo()).json()['id']}"
    image = services.goals.image(path.rpartition("/")[2])
    image.write_bytes(image.read_bytes()[:-200])
    listed = service.get("/api/goals").json()
    assert [path.endswith(each["id"]) and each["reason"] != "" for each in listed["damaged"]] == [True]
    assert not any(path.endswith(each["id"]) for each in listed["goals"])
    for tail in ("", "/image.png", "/check"):
        assert "delete it" in is_problem(service.get(path + tail), 409)["detail"]
    assert service.delete(path).status_code == 204
    assert service.get("/api/goals").json()["damaged"] == []
    is_problem(service.get(path), 404)


def test_photos_may_be_larger_than_other_bodies():
    limit_of = next(
        own.kwargs["limit_of"] for own in create_app(Settings()).user_middleware if "limit_of" in own.kwargs
    )
    assert limit_of("/api/goals") == limit_of("/api/goals/") == Settings().max_photo_bytes
    assert limit_of("/api/goals/draft") == limit_of("/api/episodes") < limit_of("/api/predictions")


PLACED = {"name": "box", "position": [0.1, 0.2, 0.3], "quaternion": [1, 0, 0, 0]}
POSES = (("box", Pose(np.array([0.1, 0.2, 0.3]), np.array([1.0, 0, 0, 0]))),)


def goal(**changes):
    at = "2026-01-01T00:00:00.000Z"
    return replace(GoalRecord("a", "Mine", at, "composed", "s", goal_camera(64), POSES), **changes)


@pytest.mark.parametrize("body", [{"objects": [PLACED]}, {"random": {}}, {"scene": None, "random": {"moved": None}}])
def test_a_goal_is_either_laid_out_or_drawn(body):
    assert GoalIn.model_validate(body).name == "Goal"


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"objects": [PLACED], "random": {}},
        {"objects": []},
        {"objects": [PLACED] * (MAX_OBJECTS + 1)},
        {"objects": [{**PLACED, "position": [0, 0]}]},
        {"objects": [{**PLACED, "position": [0, 0, float("nan")]}]},
        {"random": {"seed": -1}},
        {"random": {"moved": 0}},
        {"random": {"moved": MAX_OBJECTS + 1}},
        {"random": {}, "name": ""},
        {"random": {}, "name": "x" * 101},
        {"random": {}, "scene": ""},
        {"random": {}, "more": 1},
    ],
)
def test_anything_else_is_refused(body):
    with pytest.raises(ValidationError):
        GoalIn.model_validate(body)


def test_drafts_name_a_scene_objects_and_in_the_end_themselves():
    assert DraftIn.model_validate({}).scene is None
    ((name, pose),) = DraftPatch.model_validate({"objects": [PLACED]}).named_poses()
    assert (name, pose.position.tolist()) == ("box", PLACED["position"])
    assert DraftKeep.model_validate({}).name
    for model, body in ((DraftPatch, {}), (DraftPatch, {"objects": []}), (DraftKeep, {"name": ""})):
        with pytest.raises(ValidationError):
            model.model_validate(body)


def test_a_goal_is_told_with_what_is_known_of_it():
    told = GoalOut.of(goal())
    assert (told.width, told.height, told.camera.name, told.scene) == (64, 64, "goal", "s")
    assert [entry.model_dump() for entry in told.objects] == [PLACED]
    photo = GoalOut.of(goal(source="upload", scene=None, poses=None))
    assert (photo.scene, photo.objects) == (None, None)
    assert GoalOut.model_validate_json(told.model_dump_json()) == told


def test_a_draft_is_told_in_words_for_people():
    told = DraftOut.of(Draft("s", (*POSES, ("mug", POSES[0][1])), "They overlap.", 4), {"box": "A box"})
    assert [entry.label for entry in told.objects] == ["A box", "mug"]
    assert (told.scene, told.problem, told.revision) == ("s", "They overlap.", 4)
