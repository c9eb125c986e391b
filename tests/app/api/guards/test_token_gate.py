import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from app.api.app_factory import create_app
from app.api.guards.token_gate import COOKIE, TokenMiddleware
from app.services.service_settings import Settings

TOKEN = "open-sesame"


async def inside(scope, _receive, send):
    """An app that lets everybody in."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        await send({"type": "websocket.close", "code": 1000})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


@pytest.fixture
def client():
    return TestClient(TokenMiddleware(inside, token=TOKEN), base_url="http://localhost", follow_redirects=False)


@pytest.mark.parametrize("path", ["/", "/api/scenes", "/docs", "/viewer", "/js/main.js"])
def test_nothing_opens_without_the_token(client, path):
    answer = client.get(path)
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"
    assert "token" in answer.json()["detail"]
    assert TOKEN not in answer.text


@pytest.mark.parametrize("header", ["", "Bearer", "Bearer wrong", f"Basic {TOKEN}", TOKEN, f"Bearer {TOKEN}x"])
def test_a_wrong_token_does_not_help(client, header):
    assert client.get("/api/scenes", headers={"Authorization": header}).status_code == 401


def test_programs_send_it_as_a_header(client):
    assert client.get("/api/scenes", headers={"Authorization": f"Bearer {TOKEN}"}).text == "inside"
    assert client.post("/api/scenes", headers={"authorization": f"bearer {TOKEN}"}).text == "inside"


def test_a_browser_opens_the_page_with_it_once_and_keeps_a_cookie(client):
    answer = client.get(f"/?token={TOKEN}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert TOKEN not in client.cookies[COOKIE]
    assert "secure" not in cookie
    assert client.get("/").text == "inside"


def test_each_session_is_another_and_one_is_signed(client):
    sessions = {client.get(f"/?token={TOKEN}").cookies[COOKIE] for _ in range(2)}
    assert len(sessions) == 2
    for cookie in ("", TOKEN, sessions.pop()[:-1], "a.b.c"):
        client.cookies.clear()
        client.cookies.set(COOKIE, cookie)
        assert client.get("/").status_code == 401


def test_a_session_outlives_a_restart_but_not_another_token(client):
    client.get(f"/?token={TOKEN}")
    session = client.cookies[COOKIE]
    for token, status in ((TOKEN, 200), ("another-one", 401)):
        again = TestClient(TokenMiddleware(inside, token=token), base_url="http://localhost")
        again.cookies.set(COOKIE, session)
        assert again.get("/").status_code == status


def test_behind_https_the_cookie_is_secure():
    client = TestClient(TokenMiddleware(inside, token=TOKEN), base_url="https://localhost", follow_redirects=False)
    assert "secure" in client.get(f"/?token={TOKEN}").headers["set-cookie"].lower()


@pytest.mark.parametrize("path", ["//evil.example/x", "/%2Fevil.example/x", "/%5Cevil.example", "///evil.example"])
def test_a_login_leads_nowhere_else(client, path):
    location = client.get(f"http://localhost{path}?token={TOKEN}").headers["location"]
    assert location.startswith("/")
    assert not location.startswith(("//", "/\\"))


@pytest.mark.parametrize("token", ["pässwörter", "密码密码密码密码", "a b+c%d&e=f"])
def test_a_token_may_have_any_characters(token):
    client = TestClient(TokenMiddleware(inside, token=token), base_url="http://localhost", follow_redirects=False)
    assert client.get("/", headers={"Authorization": f"Bearer {token}".encode()}).status_code == 200
    assert client.get("/", params={"token": token}).status_code == 303
    assert client.get("/").status_code == 200


def test_wrong_tokens_are_limited_and_sessions_are_not(client):
    client.get(f"/?token={TOKEN}")
    other = TestClient(client.app, base_url="http://localhost")
    guesses = [{"Authorization": f"Bearer guess-{number}"} for number in range(20)]
    statuses = [other.get("/", headers=guess).status_code for guess in guesses]
    assert statuses[0] == 401
    assert statuses[-1] == 429
    assert other.get("/", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 429
    assert client.get("/").status_code == 200


def test_the_same_wrong_token_again_and_again_keeps_nobody_out(client):
    wrong = {"Authorization": "Bearer of-yesterday"}
    assert {client.get("/", headers=wrong).status_code for _ in range(30)} == {401}
    assert client.get("/", headers={"Authorization": f"Bearer {TOKEN}"}).text == "inside"


def test_a_wrong_token_in_the_address_sets_no_cookie(client):
    answer = client.get("/?token=wrong")
    assert answer.status_code == 401
    assert "set-cookie" not in answer.headers


def test_changes_are_not_made_by_addresses_with_a_token(client):
    assert client.post(f"/api/scenes?token={TOKEN}").status_code == 401


def test_the_viewer_needs_it_too(client):
    with pytest.raises(WebSocketDisconnect) as refused, client.websocket_connect("/viewer"):
        pass
    assert refused.value.code == 1008
    session = client.get(f"/?token={TOKEN}").cookies[COOKIE]
    with client.websocket_connect("/viewer", headers={"Cookie": f"{COOKIE}={session}"}):
        pass


def test_health_is_open():
    app = create_app(Settings(token=TOKEN, demo_scene=False, data_dir="unused"))
    paths = {"/api/health": 500, "/api/scenes": 401}  # the service itself was not started, so health has no answer
    client = TestClient(app, base_url="http://localhost", raise_server_exceptions=False)
    assert {path: client.get(path).status_code for path in paths} == paths


def test_a_short_token_is_refused():
    with pytest.raises(ValueError, match="token"):
        Settings(token="short")
