"""Nothing that is answered tells where on this machine the service keeps its files."""

import json

import pytest

from app.services.event_hub import Notice
from app.storage.database import CannotStore
from osfcore.errors import CannotWrite, CorruptFile
from tests.app.api.test_events import Stream
from tests.app.api.test_problems import is_problem
from tests.app.conftest import keep_busy, running, until
from tests.app.services.test_goals import photo

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"
PNG = {"Content-Type": "image/png"}


@pytest.fixture(scope="module")
def blocked(library, tmp_path_factory):
    """A service that can neither write goals nor read the mesh of an object."""
    data_dir = tmp_path_factory.mktemp("machine") / "data"
    with running(library, data_dir) as client:
        (data_dir / "goals").write_text("")
        damage(data_dir, BOX)
        yield client


def damage(data_dir, name):
    for mesh in (data_dir / "objects" / name).glob("*.npz"):
        mesh.unlink()  # a link to the same file of other tests
        mesh.write_bytes(b"damaged")


def hides(client, text):
    """Whether a text names neither the data directory nor a folder around it."""
    data_dir = client.app.state.services.settings.data_dir
    return not any(str(place) in text for place in (data_dir, *data_dir.parents) if place.name)


def test_a_place_that_cannot_be_written_is_named_from_the_data_directory_on(blocked):
    answer = blocked.post("/api/goals", content=photo(), headers=PNG)
    assert is_problem(answer, 507)["detail"].startswith("goals cannot be written (")
    assert hides(blocked, answer.text)


def test_a_file_that_is_damaged_is_named_from_the_data_directory_on(blocked):
    answer = blocked.post("/api/scenes", json={"objects": [BOX]})
    assert is_problem(answer, 409)["detail"].startswith(f"objects/{BOX}")
    assert hides(blocked, answer.text)


def test_what_a_job_failed_of_is_named_from_the_data_directory_on(blocked):
    busy = keep_busy(blocked)
    job = blocked.post("/api/jobs", json={"kind": "collect_object", "params": {"name": BOTTLE, "images": 60}}).json()
    damage(blocked.app.state.services.settings.data_dir, BOTTLE)
    blocked.delete(f"/api/jobs/{busy}")
    address = f"/api/jobs/{job['id']}"
    until(lambda: blocked.get(address).json()["state"] == "failed")
    assert blocked.get(address).json()["error"].startswith(f"objects/{BOTTLE}")
    assert hides(blocked, blocked.get(address).text + blocked.get("/api/jobs").text)
    replayed = blocked.app.state.services.store.events_after(0)
    assert f"objects/{BOTTLE}" in json.dumps(replayed)
    assert hides(blocked, json.dumps(replayed))


@pytest.mark.parametrize("kind", [CannotStore, CannotWrite, CorruptFile])
def test_notices_name_places_from_the_data_directory_on(live, kind):
    data_dir = live.services.settings.data_dir
    with Stream(live) as stream:
        stream.next("scene")
        live.services.runner.hub.publish(Notice("warning", str(kind(data_dir / "sets" / ".new-1", "it is full"))))
        assert stream.next("notice")[2]["text"].startswith("sets/.new-1 cannot be ")
        live.services.runner.hub.publish(Notice("warning", str(kind(data_dir, "it is full"))))
        assert stream.next("notice")[2]["text"].startswith("The data directory cannot be ")
