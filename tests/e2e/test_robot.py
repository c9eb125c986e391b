"""A robot driven from the page: a real browser, the real service, the example's robot on a simulated table."""

import contextlib
import re
import shutil
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from tests.e2e.conftest import ARTIFACTS, show_part, watch_errors
from tests.live import free_port, start_service, stop_service
from tests.support.robots import NAMES, example, noted, serving, simulated, toward_middle, until

pytestmark = pytest.mark.e2e
WAIT_MS = 60_000
LONG_MS = 400_000  # both looks take half a minute of an idle machine
SLOW = "0.01"  # [m/s]: a push takes seconds, in which it is to be stopped


@pytest.fixture(scope="module")
def robot(library, tmp_path_factory):
    """Address and table of a robot, what it was asked, and a photo of how the table should look."""
    told, photo = [], tmp_path_factory.mktemp("goal") / "wanted.jpg"
    with contextlib.closing(simulated(library, 256)) as table, serving(noted(example().robot(table), told)) as url:
        start = table.truth()
        table.load(replace(toward_middle(start), pusher=np.array([-0.35, -0.35, start.pusher[2]])))
        urllib.request.urlretrieve(f"{url}/images/0", photo)
        table.restore(start)
        yield url, table, told, photo


@pytest.fixture(scope="module")
def service(library, robot, tmp_path_factory):
    data_dir, port = tmp_path_factory.mktemp("data"), free_port()
    shutil.copytree(library.root, data_dir / "objects")
    process = start_service(data_dir, port, more=("--robot", robot[0], "--top-speed", SLOW))
    yield f"http://127.0.0.1:{port}"
    stop_service(process)


@pytest.fixture
def page(browser, service):
    page = browser.new_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    page.goto(service)
    page.click("#tab-lab")
    page.click("#tab-robot", timeout=WAIT_MS)  # comes once the robot has been asked for
    page.wait_for_selector("#panel-robot:not([hidden])", timeout=WAIT_MS)
    yield page
    assert page.problems == []
    page.close()


def moving(page, robot):
    """An episode that was allowed on the page, at its first push."""
    page.wait_for_selector('#robot-names input[value="009_gelatin_box"]', state="attached", timeout=WAIT_MS)
    for name in NAMES:
        page.check(f'#robot-names input[value="{name}"]')
    page.set_input_files("#robot-file", robot[3])
    page.click("#robot-start:not([disabled])", timeout=WAIT_MS)
    page.wait_for_selector("#robot-dialog[open]", timeout=LONG_MS)
    assert "/start" not in robot[2]
    assert "no faster than 0.01 m/s" in page.inner_text("#robot-limits")
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / "robot-asks.png")
    before = robot[1].truth().pusher
    page.click("#robot-allow")
    until(lambda: np.any(robot[1].truth().pusher != before), 60)
    page.wait_for_selector('#world[data-state="danger"]', timeout=WAIT_MS)
    assert page.inner_text("#world") == f"Robot at {robot[0].removeprefix('http://')}: moving"
    until(lambda: "its own looks" in page.inner_text("#robot-cameras-note"), 10)
    assert len(addresses(page)) == 4
    page.screenshot(path=ARTIFACTS / "robot-moves.png")
    robot[2].clear()


def addresses(page):
    """Of the pictures of the robot's cameras that have been loaded."""
    images = page.locator("#robot-cameras img")
    return images.evaluate_all("all => all.filter((one) => one.naturalWidth === 256).map((one) => one.src)")


def test_it_shows_what_the_cameras_of_the_robot_see_and_how_old_that_is(page, robot):
    until(lambda: len(addresses(page)) == 4, 60)
    before = addresses(page)
    until(lambda: not set(before) & set(addresses(page)), 60)
    captions = page.locator("#robot-cameras span").all_inner_texts()
    assert [caption.partition(", ")[0] for caption in captions] == ["0", "1", "2", "3"]
    assert all(re.fullmatch(r"\d, (now|\d+ s ago)", caption) for caption in captions)
    assert "under Robot" in page.inner_text("#robot-elsewhere")
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / "robot-cameras.png")
    robot[2].clear()
    show_part(page, "scenes")
    page.wait_for_timeout(1000)  # for what was asked before
    robot[2].clear()
    page.wait_for_timeout(3000)
    assert not [path for path in robot[2] if path.startswith("/images")]


@pytest.mark.parametrize("how", ["button", "Escape", "closed"])
def test_it_asks_and_stops(page, robot, how):
    moving(page, robot)
    if how == "button":
        page.click("#robot-stop")
    elif how == "Escape":
        page.keyboard.press("Escape")
    else:
        page.goto("about:blank")
    until(lambda: "/stop" in robot[2], 20)
    stood = robot[1].truth().pusher
    if how != "closed":
        page.wait_for_selector("#robot-bar", state="hidden", timeout=WAIT_MS)
        assert page.inner_text("#robot-state") == "stopped"
        assert "somebody pressed Stop" in page.inner_text("#robot-note")
        page.screenshot(path=ARTIFACTS / "robot-stopped.png")
    np.testing.assert_allclose(robot[1].truth().pusher, stood, atol=1e-3)
    robot[2].clear()
