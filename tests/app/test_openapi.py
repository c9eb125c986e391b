"""Whatever the schema allows, and much that it does not, is answered as the schema says and never with a defect."""

from pathlib import Path

import openapi_spec_validator
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
)

from app.main import create_app
from app.settings import Settings
from tests.app.conftest import running, until
from tests.app.routes.test_jobs import LONG

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
schemathesis.serializer.alias("application/zip", "application/octet-stream")


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
    with running(library, tmp_path_factory.mktemp("openapi"), max_scenes=400) as client:
        stand.app = client.app
        scene = client.post("/api/scenes", json={"seed": 3, "count": 2}).json()
        job = client.post("/api/jobs", json=LONG).json()
        until(lambda: client.get(f"/api/jobs/{job['id']}").json()["done"] > 0)
        client.post(f"/api/jobs/{job['id']}/pause")
        estimate = client.post("/api/estimates").json()
        yield {"scene": scene["id"], "job": job["id"], "camera": "0", "estimate": estimate["id"]}


@schema.parametrize()
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
def test_every_operation_keeps_to_the_schema(case, made):
    if case.method != "DELETE" and case.path_parameters:
        case.path_parameters |= {key: made[key] for key in case.path_parameters if key in made}
    response = case.call(headers=LOCAL)
    case.validate_response(response, checks=CHECKS)
    jobs = stand.app.state.services.runner.jobs
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


def test_schema_is_valid_openapi():
    openapi_spec_validator.validate(create_app().openapi())
