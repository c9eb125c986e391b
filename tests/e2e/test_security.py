"""A page of another site, open in the same browser, against the service on this machine."""

import contextlib
import shutil
import threading

import pytest
from websockets.sync.server import serve

from tests.live import live_service

pytestmark = pytest.mark.e2e
WAIT_MS = 20_000
SCRIPT = """() => {
  const script = document.createElement("script");
  script.textContent = `setTimeout(() => { window.inline = "ran"; eval("window.fromString = 'ran'"); })`;
  document.head.append(script);
}"""
CONNECT = """address => new Promise(done => {
  const socket = new WebSocket(address, ["viser-v0"]);
  socket.onopen = () => done("open");
  socket.onerror = () => done("closed");
})"""


@pytest.fixture(scope="module")
def service(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    with live_service(data_dir) as url:
        yield url


@pytest.fixture
def evil():
    """A websocket server elsewhere, and who came to it."""
    visitors = []

    def welcome(connection):
        visitors.append(connection.remote_address)
        with contextlib.suppress(Exception):
            connection.recv(timeout=1)

    with serve(welcome, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}", visitors
        server.shutdown()


@pytest.fixture
def page(browser):
    with contextlib.closing(browser.new_page()) as page:
        yield page


def test_a_link_cannot_bring_the_view_messages_from_elsewhere(service, page, evil):
    address, visitors = evil
    for query in (f"websocket={address}", "playbackPath=data:application/octet-stream,x"):
        answer = page.goto(f"{service}/viewer/?{query}")
        assert answer.status == 400
        page.wait_for_timeout(500)
    assert visitors == []


def test_scripts_of_the_view_reach_this_service_alone(service, page, evil):
    address, visitors = evil
    page.goto(f"{service}/viewer/?hideViserLogo")
    page.wait_for_selector("canvas", timeout=WAIT_MS)
    assert page.reload().ok  # viser has written the address of its messages into that of the page
    page.wait_for_selector("canvas", timeout=WAIT_MS)
    assert page.evaluate(CONNECT, address) == "closed"
    fetch = "address => fetch(address).then(() => 'open', () => 'closed')"
    assert page.evaluate(fetch, address.replace("ws", "http")) == "closed"
    page.evaluate(SCRIPT)
    page.wait_for_function("() => window.inline === 'ran'")  # later, for what a test evaluates is not under the policy
    assert page.evaluate("() => window.fromString") is None
    assert visitors == []


def test_a_page_of_another_site_reaches_neither_the_view_nor_its_inner_port(service, page, tmp_path):
    hostile = tmp_path / "hostile.html"
    hostile.write_text("<title>hostile</title>")
    page.goto(hostile.as_uri())
    host = service.removeprefix("http://")
    assert page.evaluate(CONNECT, f"ws://{host}/viewer") == "closed"
    post = "address => fetch(address, {method: 'POST', mode: 'no-cors', body: '{}'}).then(a => a.status, () => 0)"
    page.evaluate(post, f"{service}/api/scenes")
    page.goto(f"{service}/")
    scenes = page.evaluate("() => fetch('/api/scenes').then(a => a.json()).then(all => all.scenes.length)")
    assert scenes == 1  # the one that a service begins with
