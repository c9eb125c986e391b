import pytest
from starlette.requests import HTTPConnection

from app.api.guards.security import is_known_host, is_same_origin


@pytest.mark.parametrize(
    "host",
    ["localhost", "localhost:8000", "127.0.0.1:8000", "[::1]:8000", "192.168.1.5", "app.localhost:1", "LAB.example:80"],
)
def test_own_names_are_known(host):
    assert is_known_host(host, ("lab.example",))


@pytest.mark.parametrize(
    "host", ["", "evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "[::1", "a b"]
)
def test_other_names_are_not(host):
    assert not is_known_host(host, ("lab.example",))


def test_all_names_may_be_allowed():
    assert is_known_host("evil.example", ("*",))


def connection(origin, host="localhost:8000"):
    headers = [(b"host", host.encode())] + ([(b"origin", origin.encode())] if origin else [])
    return HTTPConnection({"type": "http", "headers": headers})


@pytest.mark.parametrize("origin", [None, "http://localhost:8000", "https://LOCALHOST:8000", "https://lab.example"])
def test_own_pages_and_programs_may(origin):
    assert is_same_origin(connection(origin), ("https://lab.example",))


@pytest.mark.parametrize(
    "origin", ["null", "http://localhost", "http://localhost:8001", "http://evil.example", "http://[", "localhost:8000"]
)
def test_other_pages_may_not(origin):
    assert not is_same_origin(connection(origin), ("https://lab.example",))


def test_requests_from_elsewhere_are_refused_as_problems(service):
    foreign = service.post("/api/scenes", json={}, headers={"Origin": "http://evil.example"})
    assert foreign.status_code == 403
    assert foreign.headers["content-type"] == "application/problem+json"
    rebound = service.get("/api/health", headers={"Host": "evil.example"})
    assert rebound.status_code == 421
    assert service.get("/api/health", headers={"Origin": "http://evil.example"}).status_code == 200


def test_every_answer_carries_headers(service):
    for path in ("/api/health", "/viewer/", "/docs", "/nowhere"):
        headers = service.get(path).headers
        assert "frame-ancestors 'self'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
    viewer = service.get("/viewer/").headers["content-security-policy"]
    assert "connect-src 'self' data: blob:;" in viewer
    assert "'unsafe-eval'" not in viewer
    assert "unsafe" not in service.get("/api/health").headers["content-security-policy"]
