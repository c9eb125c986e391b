"""HTTP as any client knows it, whatever the path: HEAD, Allow, compression, what is known already."""

import gzip
import re
import urllib.request

import pytest

from app.api.app_factory import create_app
from app.storage.paths import static_folder
from tests.app.api.test_problems import is_problem

SCHEMA = create_app().openapi()
PLAIN = [path for path, methods in SCHEMA["paths"].items() if "get" in methods and "{" not in path]
ENDLESS = "/api/events"


@pytest.mark.parametrize("path", ["/", "/docs", "/viewer/", "/api/openapi.json", *PLAIN])
def test_head_is_answered_as_get_without_the_body(service, path):
    head = service.head(path)
    assert head.content == b""
    if path == ENDLESS:
        assert head.status_code == 200
        assert head.headers["content-type"].startswith("text/event-stream")
        return
    get = service.get(path)
    assert head.status_code == get.status_code
    assert head.headers["content-type"] == get.headers["content-type"]
    if path not in ("/api/health", "/api/metrics", "/api/storage"):  # their figures change
        assert head.headers["content-length"] == get.headers["content-length"]


def test_a_head_of_the_event_stream_leaves_no_stream_behind(live):
    for _ in range(120):  # more than there may be at once
        with urllib.request.urlopen(urllib.request.Request(f"{live.url}{ENDLESS}", method="HEAD"), timeout=20) as head:
            assert head.status == 200


@pytest.mark.parametrize("path", SCHEMA["paths"])
def test_a_wrong_method_is_answered_with_all_that_the_path_offers(service, path):
    offered = {method.upper() for method in SCHEMA["paths"][path]}
    wrong = next(method for method in ("PUT", "POST", "GET", "TRACE") if method not in offered)
    answer = service.request(wrong, re.sub(r"\{[^}]*\}", "1", path))
    is_problem(answer, 405)
    allowed = set(answer.headers["allow"].split(", "))
    assert offered | ({"HEAD"} if "GET" in offered else set()) <= allowed
    assert wrong not in allowed


def test_pages_scripts_and_json_are_compressed(service):
    for path in ("/", "/js/main.js", "/api/openapi.json"):
        plain = service.get(path, headers={"Accept-Encoding": "identity"})
        with service.stream("GET", path, headers={"Accept-Encoding": "gzip"}) as answer:
            packed = b"".join(answer.iter_raw())
        assert "content-encoding" not in plain.headers
        assert answer.headers["content-encoding"] == "gzip"
        assert "Accept-Encoding" in answer.headers["vary"]
        assert gzip.decompress(packed) == plain.content
        assert len(packed) < len(plain.content) / 2


def test_what_is_compressed_already_streams_or_is_a_part_is_not(service, live):
    picture = next(path for path in (static_folder() / "presets").glob("*.webp"))
    assert "content-encoding" not in service.get(f"/presets/{picture.name}").headers
    assert "content-encoding" not in service.get("/api/photos/board.pdf").headers
    part = service.get("/js/main.js", headers={"Range": "bytes=0-999"})
    assert (part.status_code, len(part.content)) == (206, 1000)
    assert "content-encoding" not in part.headers
    request = urllib.request.Request(f"{live.url}{ENDLESS}", headers={"Accept-Encoding": "gzip"})
    with urllib.request.urlopen(request, timeout=20) as stream:
        assert stream.getheader("content-encoding") is None
        assert b"connected" in stream.readline() + stream.readline()


def test_a_compressed_file_is_known_again_but_no_part_of_it_is_mixed_with_the_plain_one(service):
    tag = service.get("/js/main.js").headers["etag"]
    assert tag.startswith('W/"')
    assert service.get("/js/main.js", headers={"If-None-Match": tag}).status_code == 304
    whole = service.get("/js/main.js", headers={"If-Range": tag, "Range": "bytes=0-9"})
    assert whole.status_code == 200


BODIED = [
    (method, path)
    for path, methods in SCHEMA["paths"].items()
    for method in methods
    if method in ("post", "put", "patch") and path != "/api/robot/stop"
]


@pytest.mark.parametrize(("method", "path"), BODIED)
@pytest.mark.parametrize(
    ("body", "headers"),
    [
        (gzip.compress(b"{}"), {"Content-Encoding": "gzip"}),
        (gzip.compress(b"{}")[:-9], {"Content-Encoding": "gzip"}),
        (b"[" * 50_000, {}),
        (b'{"a":' * 50_000, {}),
        (b'{"objects": ' + b"[" * 20_000 + b"]" * 20_000 + b"}", {}),
        (b"\xff\xfe", {}),
    ],
    ids=["gzip", "half a gzip", "deep", "deep objects", "deep within", "no text"],
)
def test_no_body_is_a_defect_of_the_service(service, method, path, body, headers):
    address = re.sub(r"\{[^}]*\}", "1", path)
    answer = service.request(method, address, content=body, headers={"Content-Type": "application/json", **headers})
    assert 400 <= answer.status_code < 500 or answer.status_code in (204, 503), answer.text
