import numpy as np
import pytest

from app.services.examples import PRESETS, preset
from osfcore.errors import OsfError
from tests.app.api.test_events import Stream
from tests.app.api.test_problems import is_problem
from tests.app.conftest import until


@pytest.mark.slow
def test_pages_come_take_over_and_go(live):
    assert live.request("GET", "/api/driver")[1] == {"driver": None, "visitors": 0}
    with Stream(live, "?visitor=one") as one:
        assert one.next("driver")[2] == {"driver": "one", "visitors": 1}
        with Stream(live, "?visitor=two") as two:
            assert one.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert two.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert live.request("POST", "/api/driver", {"visitor": "two"}) == (200, {"driver": "two", "visitors": 2})
            assert one.next("driver")[2] == two.next("driver")[2] == {"driver": "two", "visitors": 2}
        # The wheel is kept for a moment: the page may only be loading again.
        assert one.next("driver")[2] == {"driver": "two", "visitors": 1}
        assert one.next("driver")[2] == {"driver": "one", "visitors": 1}
    until(lambda: live.request("GET", "/api/driver")[1] == {"driver": None, "visitors": 0})


def test_programs_do_not_count_and_are_never_refused(live):
    with Stream(live, "?visitor=one") as page, Stream(live) as program:
        page.next("driver")
        program.next("scene")
        assert live.request("GET", "/api/driver")[1] == {"driver": "one", "visitors": 1}
        status, scene = live.request("POST", "/api/scenes", {"count": 1, "seed": 1})
        assert status == 201
        live.request("DELETE", f"/api/scenes/{scene['id']}")
    until(lambda: live.request("GET", "/api/driver")[1]["visitors"] == 0)


def test_a_page_that_watches_can_look_at_everything_and_change_nothing(live):
    def request(method, path, body=None, visitor="two"):
        return live.request(method, path, body, headers={"X-OSF-Visitor": visitor})

    with Stream(live, "?visitor=one") as page:
        page.next("driver")
        assert request("GET", "/api/scenes")[0] == 200
        for method, path, body in (
            ("POST", "/api/scenes", {"count": 1}),
            ("POST", "/api/jobs", {"kind": "fetch_assets", "params": {}}),
            ("DELETE", "/api/goals/draft", None),
            ("POST", "/api/presets/first", None),
        ):
            status, problem = request(method, path, body)
            assert (status, problem["detail"]) == (409, "Someone else is driving; take over first.")
        assert request("PUT", "/api/views/two", {"replay": None})[0] == 200
        assert request("POST", "/api/driver", {"visitor": "two"})[0] == 200
        assert request("DELETE", "/api/goals/draft")[0] < 300
        assert request("DELETE", "/api/goals/draft", visitor="one")[0] == 409
    until(lambda: live.request("GET", "/api/driver")[1]["visitors"] == 0)


@pytest.mark.parametrize("visitor", ["", "a b", "x" * 65, "<b>", "é", None, 5])
def test_odd_names_of_pages_are_refused(service, visitor):
    is_problem(service.post("/api/driver", json={"visitor": visitor}), 422)
    if isinstance(visitor, str):
        is_problem(service.get("/api/events", params={"visitor": visitor}), 422)
    is_problem(service.post("/api/driver", json={}), 422)
    assert service.get("/api/driver").json()["visitors"] == 0


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
    assert services.runner.scenes.current == scene["id"]
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
    assert services.runner.scenes.current == scene


def test_a_table_that_is_the_presets_already_becomes_its_own_until_it_is_touched(service, services):
    one = preset("pair")
    asked = {"objects": list(one.objects), "seed": one.seed, "light": {"position": one.light.position.tolist()}}
    touched, fresh = (service.post("/api/scenes", json=asked).json()["id"] for _ in range(2))
    service.patch(f"/api/scenes/{touched}", json={"light": {"position": [0, 0, 1]}})
    made = service.post("/api/presets/pair").json()
    assert made["scene"]["id"] == services.runner.scenes.current == fresh
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
    assert "osf assets fetch" in is_problem(service.post(f"/api/presets/{missing.id}"), 409)["detail"]

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
