import collections
import re
import socket
import urllib.error
import urllib.request

import msgspec
import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from app.viewer.private_server import SECRET_HEADER
from tests.app.conftest import until
from tests.app.viewer.conftest import CAMERA, uuid_of

PROTOCOL = f"viser-v{viser.__version__}"


def viewer_socket(live, protocol=PROTOCOL, **options):
    return connect(
        f"ws://127.0.0.1:{live.port}/viewer",
        subprotocols=[protocol],
        compression=None,
        max_size=None,
        proxy=None,
        **options,
    )


def test_the_client_page_is_served_and_not_kept(service):
    for path in ("/viewer", "/viewer/", "/viewer/page-1", "/viewer/page-1/"):
        page = service.get(path)
        assert page.status_code == 200
        assert page.headers["content-type"].startswith("text/html")
        assert page.headers["cache-control"] == "no-cache"
        assert "'unsafe-inline'" in page.headers["content-security-policy"]  # it is one file of inline script


def test_a_script_for_browsers_without_a_graphics_card_comes_before_the_client(service):
    first = re.search("<script[^>]*>", service.get("/viewer/").text)
    assert first is not None
    source = re.search('src="([^"]*)"', first[0])
    assert source is not None
    assert "javascript" in service.get(source[1]).headers["content-type"]


@pytest.mark.parametrize(
    "query",
    [
        {"websocket": "ws://evil.example"},
        {"websocket": "ws://evil.example/viewer"},
        {"websocket": "ws://localhost@evil.example/viewer"},
        {"websocket": "http://localhost/viewer"},
        {"websocket": "ws://localhost/viewer?x=1"},
        {"websocket": "ws://localhost/other"},
        {"websocket": "ws://localhost/viewer/page/more"},
        {"websocket": "ws://["},
        {"playbackPath": "data:text/plain,x"},
        {"playbackPath": "http://localhost/api/episodes/e-1/files/episode.viser"},
        {"anything": "else"},
    ],
)
def test_the_client_page_is_not_opened_for_messages_from_elsewhere(service, query):
    answer = service.get("/viewer/", params=query)
    assert answer.status_code == 400
    assert "open it from the page" in answer.json()["detail"]


@pytest.mark.parametrize(
    "query",
    [
        "",
        "websocket=ws://localhost/viewer",
        "websocket=ws://localhost/viewer/",
        "hideViserLogo&darkMode",
        "websocket=ws://localhost/viewer/page-1/",
    ],
)
def test_the_client_page_is_opened_with_looks_and_the_own_relay(service, query):
    assert service.get(f"/viewer/?{query}").status_code == 200
    assert service.get(f"/viewer/page-1/?{query}").status_code == 200


@pytest.mark.parametrize("headers", [{}, {SECRET_HEADER: "guessed"}])
def test_the_inner_port_is_closed_to_all_but_the_relay(live, headers):
    address = f"127.0.0.1:{live.services.viewer.port}"
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{address}", subprotocols=[PROTOCOL], additional_headers=headers, proxy=None)
    assert refused.value.response.status_code == 403
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(f"http://{address}/", headers=headers))


def test_a_message_that_the_page_never_sends_changes_nothing(live):
    server = live.services.viewer.server
    button = server.gui.add_button("Test")
    try:
        with viewer_socket(live) as browser:
            browser.recv(timeout=10)
            for updates in ({"disabled": True}, {"update_cb": []}, {"value": True}):
                browser.send(
                    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid_of(button), "updates": updates})
                )
            browser.send(msgspec.msgpack.encode(CAMERA))  # is heard after the others
            until(lambda: any(client.camera.fov == CAMERA["fov"] for client in server.get_clients().values()))
            assert not button.value
            assert not button.disabled
    finally:
        button.remove()


def flood(browser):
    for _ in range(20_000):
        browser.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
    collections.deque(browser, maxlen=0)


def test_a_flood_ends_the_connection(live):
    with viewer_socket(live) as browser, pytest.raises(ConnectionClosed):
        flood(browser)


def test_frames_pass_with_the_protocol_of_the_client(live):
    with viewer_socket(live, origin=f"http://127.0.0.1:{live.port}") as browser:
        assert browser.subprotocol == PROTOCOL
        assert len(browser.recv(timeout=10)) > 0


def test_another_version_is_told_so(live):
    with viewer_socket(live, "viser-v0.0.1") as browser, pytest.raises(ConnectionClosed):
        collections.deque(browser, maxlen=0)
    assert browser.close_code == 1002


@pytest.mark.parametrize("origin", ["http://evil.example", "null"])
def test_other_sites_are_refused(live, origin):
    with pytest.raises(InvalidStatus) as refused:
        viewer_socket(live, origin=origin)
    assert refused.value.response.status_code == 403


def test_large_meshes_pass(live):
    blob = np.random.default_rng(0).bytes(30 << 20)  # does not shrink on the way
    node = live.services.viewer.server.scene.add_glb("/large", blob, visible=False)
    try:
        with viewer_socket(live) as browser:
            while len(browser.recv(timeout=20)) < len(blob):
                pass
    finally:
        node.remove()


def test_many_visits_leave_nothing_behind(live):
    viewer = live.services.viewer

    def open_connections():
        inner = viewer.port
        with open("/proc/net/tcp") as table:
            rows = [line.split() for line in table.readlines()[1:]]
        return sum(1 for row in rows if row[2].endswith(f":{inner:04X}") and row[3] == "01")

    before = open_connections()
    for _ in range(30):
        with viewer_socket(live) as browser:
            browser.recv(timeout=10)
    until(lambda: open_connections() <= before)
    assert viewer.server.get_clients() == {}


def test_a_browser_that_vanishes_is_let_go(live):
    browser = viewer_socket(live)
    browser.recv(timeout=10)
    browser.socket.shutdown(socket.SHUT_RDWR)
    browser.close()
    until(lambda: live.services.viewer.server.get_clients() == {})
