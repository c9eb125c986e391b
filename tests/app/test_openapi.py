"""Whatever the schema allows, and much that it does not, is answered as the schema says and never with a defect."""

from pathlib import Path

import numpy as np
import openapi_spec_validator
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
)

from app.api.app_factory import create_app
from app.episodes.file_names import FRAMES_FOLDER, REPORT_FILE
from app.episodes.frames import HEIGHT, WIDTH
from app.services.episodes import FILES
from app.services.service_settings import Settings
from osfcore.io.files import write_json
from osfcore.io.image_file import write_png
from tests.app.conftest import keep_busy, leave_running, running
from tests.app.services.test_goals import photo

CHECKS = (
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    negative_data_rejection,
)
STREAMS = r"/events$"  # they do not end
EXAMPLES = 12
LOCAL = {"Host": "localhost"}
PHOTOS = [photo(64, 64), photo(64, 64, "JPEG"), photo(64, 48), photo(8, 8), photo(64, 64)[:90], b""]
for kind in ("application/zip", "model/gltf-binary", "image/png", "image/jpeg"):
    schemathesis.serializer.alias(kind, "application/octet-stream")
for kind in ("image/png", "image/jpeg"):
    schemathesis.openapi.media_type(kind, st.sampled_from(PHOTOS))


class Stand:
    """An app for schemathesis that is the running service once there is one; its lifespan is the fixture's business."""

    def __init__(self, app):
        self.app = app

    async def __call__(self, scope, receive, send):
        if scope["type"] != "lifespan":
            await self.app(scope, receive, send)
            return
        while (await receive())["type"] == "lifespan.startup":
            await send({"type": "lifespan.startup.complete"})
        await send({"type": "lifespan.shutdown.complete"})


stand = Stand(create_app(Settings(data_dir=Path("nowhere"))))
schema = schemathesis.openapi.from_asgi("/api/openapi.json", stand, headers=LOCAL).exclude(path_regex=STREAMS)


@pytest.fixture(scope="module")
def made(library, tmp_path_factory):
    """Something that exists for each kind of identifier, so that examples reach past "not found".

    A paused job keeps its turn: whatever examples queue never runs.
    """
    data_dir = tmp_path_factory.mktemp("openapi")
    with running(library, data_dir, max_scenes=400) as client:
        scene = client.post("/api/scenes", json={"seed": 3, "count": 2}).json()
        keep_busy(client)
        goal = client.post("/api/goals", json={"random": {}}).json()
        episode = client.post("/api/episodes", json={"goal": goal["id"]}).json()
        leave_results(client.app.state.services.runner.jobs.folder(episode["id"]))
    leave_running(data_dir, episode["id"])
    with running(library, data_dir, max_scenes=400) as client:
        stand.app = client.app
        job = keep_busy(client)
        estimate = client.post("/api/estimates").json()
        yield {
            "scene": scene["id"],
            "job": job,
            "camera": "0",
            "estimate": estimate["id"],
            "goal": goal["id"],
            "episode": episode["id"],
            "preset_id": "pair",
        }


def leave_results(folder):
    """As an episode does after its first look."""
    write_png(folder / FRAMES_FOLDER / "000.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_json(folder / REPORT_FILE, {"steps": [], "noticed": []})


def reach(case, made):
    """Let an example name what exists wherever it names something that could."""
    if case.method != "DELETE" and case.path_parameters:
        given = case.path_parameters
        given |= {key: made[key] for key in given if key in made}
        if isinstance(given.get("step"), int) and given["step"] >= 0:
            given["step"] = 0
        if "/episodes/" in case.path and "name" in given:
            given["name"] = FILES[len(str(given["name"])) % len(FILES)]
    if isinstance(case.body, dict):
        for key in ("scene", "goal"):
            if isinstance(case.body.get(key), str) and 1 <= len(case.body[key]) <= 64:
                case.body[key] = made[key]


# A thread of the running service may draw from `random` while an example is made, which Hypothesis takes for the
# example's own doing.
@pytest.mark.filterwarnings("ignore:Do not use the `random` module inside strategies")
@pytest.mark.slow
@schema.parametrize()
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
def test_every_operation_keeps_to_the_schema(case, made):
    reach(case, made)
    services = stand.app.state.services
    if "/draft" in case.path and services.goals.draft is None:
        services.goals.begin_draft(made["scene"])
    response = case.call(headers=LOCAL)
    case.validate_response(response, checks=CHECKS)
    jobs = services.runner.jobs
    for job in jobs.all():
        if job.state == "queued":
            jobs.cancel(job.id)


def test_operation_names_are_unique_and_every_error_is_a_problem():
    paths = stand.app.openapi()["paths"]
    operations = [operation for path in paths.values() for operation in path.values()]
    assert len({operation["operationId"] for operation in operations}) == len(operations)
    for operation in operations:
        assert operation["tags"]
        for status, answer in operation["responses"].items():
            if not status.startswith("2"):
                assert list(answer["content"]) == ["application/problem+json"]


@pytest.mark.slow
def test_schema_is_valid_openapi():
    openapi_spec_validator.validate(create_app().openapi())
