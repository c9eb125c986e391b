from importlib.metadata import version

from tests.app.conftest import until


def test_health_tells_version_objects_and_stage(service, library):
    health = until(lambda: (h := service.get("/api/health").json())["stage"] == "ready" and h)
    assert health["version"] == version("osf-manipulation")
    assert health["status"] == "ok"
    assert health["objects_available"] == len(library.names())
    assert health["uptime_s"] > 0
