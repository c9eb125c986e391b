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
