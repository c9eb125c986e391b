"""One running service for all tests that do not stop or break it."""

import os
import shutil
import time

import pytest
from starlette.testclient import TestClient

from app.main import create_app
from app.settings import Settings

LOCALHOST = "http://localhost"


def until(condition, timeout_s=20.0):
    """Wait until a condition holds; fails the test if it never does."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    pytest.fail(f"did not happen within {timeout_s:g} s")


def running(library, data_dir, **settings):
    """A client of a running service with real objects, as a context."""
    if not (data_dir / "objects").exists():
        shutil.copytree(library.root, data_dir / "objects", copy_function=os.link)
    app = create_app(Settings(data_dir=data_dir, **{"demo_scene": False, **settings}))
    return TestClient(app, base_url=LOCALHOST, raise_server_exceptions=False)


@pytest.fixture(scope="session")
def service(library, tmp_path_factory):
    """A service with real objects and no scene yet; scenes and jobs of other tests may be there."""
    with running(library, tmp_path_factory.mktemp("service"), max_scenes=200) as client:
        yield client


@pytest.fixture
def services(service):
    return service.app.state.services


@pytest.fixture
def scene(service):
    """A fresh scene of two objects, removed afterwards."""
    made = service.post("/api/scenes", json={"seed": 1, "objects": ["003_cracker_box", "006_mustard_bottle"]}).json()
    yield made
    service.delete(f"/api/scenes/{made['id']}")
