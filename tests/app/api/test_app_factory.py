import itertools
import re

from app.api.app_factory import create_app
from app.services.service_settings import Settings
from app.storage.paths import static_folder


def test_documentation_works_offline(service):
    page = service.get("/docs")
    assert page.status_code == 200
    addresses = re.findall(r"""(?:src|href|url)["']?\s*[=:]\s*["']([^"']+)["']""", page.text)
    assert len(addresses) >= 4
    for address in addresses:
        assert address.startswith("/")
        assert service.get(address).status_code == 200
    assert "http" not in re.sub(r"<!DOCTYPE html>", "", page.text).replace("http-equiv", "")


def test_the_schema_tells_every_model(service):
    schema = service.get("/api/openapi.json").json()
    text = str(schema)
    for name in re.findall(r"#/components/schemas/(\w+)", text):
        assert name in schema["components"]["schemas"]
    assert {"Problem", "FrameEvent", "NoticeEvent"} <= set(schema["components"]["schemas"])


def test_the_page_lies_beside_the_package():
    assert static_folder().name == "static"


def test_an_app_can_be_made_without_starting_anything(tmp_path):
    app = create_app(Settings(data_dir=tmp_path / "data"))
    assert not (tmp_path / "data").exists()
    assert app.openapi()["info"]["title"] == "OSF manipulation"


def test_the_schema_states_licence_tags_and_who_may_call():
    schema = create_app().openapi()
    assert schema["info"]["license"]["identifier"] == "MIT"
    described = {tag["name"] for tag in schema["tags"] if tag["description"]}
    assert set(schema["components"]["securitySchemes"]) == {name for need in schema["security"] for name in need}
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            assert set(operation["tags"]) <= described
            assert ("401" in operation["responses"]) == (path != "/api/health")


def test_no_two_paths_of_the_schema_can_be_the_same():
    """Placeholders stand for any text; at the first place where two paths differ, neither may be one of both."""
    paths = [path.split("/") for path in create_app().openapi()["paths"]]
    for one, other in itertools.combinations(paths, 2):
        if len(one) == len(other):
            pairs = [(a, b) for a, b in zip(one, other, strict=True) if a != b]
            crossed = {a.startswith("{") for a, b in pairs if "{" in a + b}
            assert len(crossed) < 2 or any("{" not in a + b for a, b in pairs), (one, other)
