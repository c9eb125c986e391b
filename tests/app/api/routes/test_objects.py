import shutil

import numpy as np

from osfcore.objects.catalogue import CATALOGUE
from tests.app.api.test_problems import is_problem


def test_the_list_holds_what_can_be_fetched_and_what_is_here(service, library):
    objects = {o["name"]: o for o in service.get("/api/objects").json()["objects"]}
    assert set(objects) >= set(CATALOGUE)
    assert {name for name, o in objects.items() if o["available"]} == set(library.names())
    assert all((o["size_m"] is None) != o["available"] for o in objects.values())


def test_one_object_has_its_size(service, library):
    found = service.get("/api/objects/006_mustard_bottle").json()
    assert np.allclose(found["size_m"], library.size_m("006_mustard_bottle"))
    assert found["mass_kg"] == CATALOGUE["006_mustard_bottle"].mass_kg
    assert found["licence"] == "CC-BY-4.0"


def test_a_damaged_object_does_not_hide_the_others(service, services, library):
    damaged = services.runner.library.root / "zz"
    damaged.mkdir()
    (damaged / "object.json").write_text('{"format_version": 1}')
    try:
        listed = {o["name"] for o in service.get("/api/objects").json()["objects"]}
    finally:
        shutil.rmtree(damaged)
    assert listed >= set(library.names())


def test_unknown_objects_are_not_found(service):
    for name in ("teapot", ".hidden", "%2e%2e%2fservice.sqlite3", "a" * 300, "\N{SNOWMAN}"):
        is_problem(service.get(f"/api/objects/{name}"), 404)
    assert "teapot" in service.get("/api/objects/teapot").json()["detail"]
