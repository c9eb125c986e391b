import numpy as np
import pytest

from app.services.examples.presets import PRESETS, preset
from osfcore.errors import OsfError
from tests.app.api.test_problems import is_problem


@pytest.fixture
def made(service):
    made = service.post("/api/presets/pair")
    yield made
    service.delete(f"/api/scenes/{made.json()['scene']['id']}")
    service.delete(f"/api/goals/{made.json()['goal']['id']}")


def test_all_are_listed_with_what_is_missing_for_them(service, library):
    listed = service.get("/api/presets").json()["presets"]
    assert [one["id"] for one in listed] == [one.id for one in PRESETS]
    for told, one in zip(listed, PRESETS, strict=True):
        assert (told["title"], told["text"], told["objects"]) == (one.title, one.text, len(one.objects))
        assert told["missing"] == [name for name in one.objects if not library.has(name)]
        if told["image"] is not None:
            assert service.get(f"/{told['image']}").headers["content-type"] == "image/webp"
    assert [one["id"] for one in listed if one["missing"] == []] != []


def test_a_preset_becomes_the_scene_that_is_shown_and_its_goal(service, services, made):
    one = preset("pair")
    assert made.status_code == 201
    scene, goal = made.json()["scene"], made.json()["goal"]
    assert services.runner.current == scene["id"]
    assert [entry["name"] for entry in scene["objects"]] == list(one.objects)
    np.testing.assert_allclose(scene["light"]["position"], one.light.position, atol=1e-9)
    assert (goal["scene"], goal["name"], goal["source"]) == (scene["id"], one.title, "composed")
    assert service.get(f"/api/goals/{goal['id']}").json() == goal
    here, there = (np.array([entry["position"] for entry in it["objects"]]) for it in (scene, goal))
    assert (np.linalg.norm(here - there, axis=1) > 0.05).sum() == len(one.shifts_m)


def check_same_tables(some, others):
    for part in ("scene", "goal"):
        for here, there in zip(some[part]["objects"], others[part]["objects"], strict=True):
            np.testing.assert_allclose(here["position"], there["position"], atol=1e-6)


def test_the_same_preset_is_its_table_put_back(service, services, made):
    scene = made.json()["scene"]["id"]
    service.patch(f"/api/scenes/{scene}", json={"light": {"position": [0, 0, 1]}})
    again = service.post("/api/presets/pair").json()
    assert [again[part]["id"] for part in ("scene", "goal")] == [scene, made.json()["goal"]["id"]]
    np.testing.assert_allclose(again["scene"]["light"]["position"], preset("pair").light.position, atol=1e-9)
    check_same_tables(again, made.json())
    assert services.runner.current == scene


def test_a_table_that_is_the_presets_already_becomes_its_own_until_it_is_touched(service, services):
    one = preset("pair")
    asked = {"objects": list(one.objects), "seed": one.seed, "light": {"position": one.light.position.tolist()}}
    touched, fresh = (service.post("/api/scenes", json=asked).json()["id"] for _ in range(2))
    service.patch(f"/api/scenes/{touched}", json={"light": {"position": [0, 0, 1]}})
    made = service.post("/api/presets/pair").json()
    assert made["scene"]["id"] == services.runner.current == fresh
    service.delete(f"/api/goals/{made['goal']['id']}")
    for scene in (touched, fresh):
        service.delete(f"/api/scenes/{scene}")


def test_where_its_table_is_gone_it_is_made_anew(service, made):
    service.delete(f"/api/scenes/{made.json()['scene']['id']}")
    again = service.post("/api/presets/pair").json()
    assert again["scene"]["id"] != made.json()["scene"]["id"]
    check_same_tables(again, made.json())
    for part in ("scene", "goal"):
        service.delete(f"/api/{part}s/{again[part]['id']}")


def test_what_cannot_be_made_is_told_and_leaves_nothing(service, services, monkeypatch):
    is_problem(service.post("/api/presets/seventh"), 404)
    missing = next(one for one in PRESETS if set(one.objects) - set(services.objects.names()))
    before = service.get("/api/scenes").json()
    assert "osf assets fetch" in is_problem(service.post(f"/api/presets/{missing.id}"), 422)["detail"]

    def refuse(*_):
        raise OsfError("There is no room.")

    monkeypatch.setattr(services.goals, "compose", refuse)
    assert is_problem(service.post("/api/presets/pair"), 422)["detail"] == "There is no room."
    assert service.get("/api/scenes").json()["scenes"] == before["scenes"]
    one = preset("pair")
    asked = {"objects": list(one.objects), "seed": one.seed, "light": {"position": one.light.position.tolist()}}
    there = service.post("/api/scenes", json=asked).json()["id"]
    is_problem(service.post("/api/presets/pair"), 422)
    assert service.delete(f"/api/scenes/{there}").is_success  # what was there before is still there
