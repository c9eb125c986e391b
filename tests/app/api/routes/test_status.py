from importlib.metadata import version

import pytest

from app.api.schemas.episodes import SettingsIn
from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput
from tests.app.api.test_problems import is_problem
from tests.app.conftest import full_disk, until


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
    from app.jobs.kinds.episodes import settings_of
    from app.services.episodes import nested

    for name, bounds in service.get("/api/settings").json()["episode"]["bounds"].items():
        whole = int if name != "temperature" else float
        for bound in bounds:
            settings_of(nested({name: whole(bound)}))
        for beyond in (whole(bounds[1] * 2), whole(bounds[0] / 2)):
            with pytest.raises(InvalidInput):
                settings_of(nested({name: beyond}))


def test_health_tells_of_what_could_not_be_stored_until_it_is(service, scene):
    with full_disk():
        assert service.post(f"/api/scenes/{scene['id']}/actions", json={"actions": [[0.05, 0, 0]]}).status_code == 200
        health = service.get("/api/health").json()
    assert health["status"] == "degraded"
    assert "What has become of one scene or job could not be stored" in " ".join(health["problems"])
    until(lambda: "could not be stored" not in " ".join(service.get("/api/health").json()["problems"]))
