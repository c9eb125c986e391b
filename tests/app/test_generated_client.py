"""A client that a program makes of the OpenAPI document understands what the service says."""

import subprocess
import sys

import pytest

BINARY = ("image/*", "image/png", "image/jpeg", "model/gltf-binary", "text/csv", "video/mp4", "application/pdf")
CONFIG = "post_hooks: []\ncontent_type_overrides:\n" + "".join(
    f"  {kind}: application/octet-stream\n" for kind in (*BINARY, "application/zip")
)


@pytest.fixture(scope="module")
def generated(service, tmp_path_factory):
    """The package of the client, on the path."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "openapi.json").write_text(service.get("/api/openapi.json").text)
    (folder / "config.yaml").write_text(CONFIG)
    generator = [sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none", "--fail-on-warning"]
    places = ["--path", "openapi.json", "--config", "config.yaml", "--output-path", "generated_client"]
    done = subprocess.run([*generator, *places], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    with pytest.MonkeyPatch.context() as path:
        path.syspath_prepend(folder)
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("generated")
def test_it_makes_and_lists_scenes_and_asks_for_estimates_with_the_declared_defaults(service, scene):
    from generated_client import Client
    from generated_client.api.estimates import estimates_create
    from generated_client.api.scenes import scenes_delete, scenes_get, scenes_image, scenes_list_all
    from generated_client.models import Problem

    client = Client("http://localhost").set_httpx_client(service)
    found = scenes_get.sync(scene["id"], client=client)
    assert found.to_dict() == service.get(f"/api/scenes/{scene['id']}").json()
    assert scene["id"] in [each.id for each in scenes_list_all.sync(client=client).scenes]
    assert scenes_image.sync(scene["id"], "goal", client=client).payload.read().startswith(b"\x89PNG")
    asked = estimates_create.sync_detailed(client=client)
    assert asked.status_code == 202
    assert asked.parsed.mode == "first"
    service.delete(f"/api/estimates/{asked.parsed.id}")
    refused = scenes_delete.sync("nowhere", client=client)
    assert isinstance(refused, Problem)
    assert refused.status == 404
