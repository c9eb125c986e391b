"""Predicting a push as a person does it: a real browser, the real service, real objects and the network that ships."""

import io
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.e2e.conftest import ARTIFACTS, show_part, watch_errors
from tests.e2e.test_neural import call
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service

pytestmark = pytest.mark.e2e
MUSTARD, GELATIN = "006_mustard_bottle", "009_gelatin_box"
LOAD_S = 90  # the network, the first time on a busy machine
STEPS, SPEED = 10, 0.25


@pytest.fixture(scope="module")
def url(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    with live_service(data_dir) as url:
        poses = [
            {"name": MUSTARD, "position": [0.06, 0.05, 0.0957], "quaternion": [0.924, 0, 0, 0.383]},
            {"name": GELATIN, "position": [-0.12, 0.15, 0.016], "quaternion": [1, 0, 0, 0]},
        ]
        call(url, "scenes", {"poses": poses, "light": {"position": [0.2, -0.3, 1]}})
        yield url


@pytest.fixture
def page(browser, url):
    page = browser.new_page(viewport={"width": 1366, "height": 1000}, color_scheme="light")
    page.set_default_timeout(1000 * LOAD_S)
    page.problems = []
    watch_errors(page)
    page.on("console", lambda m: page.problems.append(m.text) if m.type == "error" else None)
    page.goto(url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    yield page
    page.close()


def scene_of(url):
    listed = call(url, "scenes")
    return next(scene for scene in listed["scenes"] if scene["id"] == listed["current"])


def purple(page) -> int:
    """Pixels of the colour of predictions: little green beside red and blue."""
    shot = page.locator("#viewer").screenshot()
    red, green, blue = np.moveaxis(np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), int), -1, 0)[:, 60:, :600]
    return int(((red - green > 25) & (blue - green > 25)).sum())


def press(frame, name):
    frame.get_by_role("button", name=name, exact=True).click()


def unfold(frame, folder, words):
    """Open a folder; a click that comes while the panel still unfolds itself is lost."""

    def is_open():
        if not frame.get_by_text(words).is_visible():
            frame.get_by_text(folder).click()
            frame.owner.page.wait_for_timeout(1000)
        return frame.get_by_text(words).is_visible()

    wait_until(is_open)


def test_a_push_is_chosen_predicted_executed_and_compared(page, url):
    frame = page.frame_locator("#viewer")
    frame.locator("canvas").first.wait_for(timeout=WAIT_MS)
    frame.get_by_text("Scene", exact=True).first.click()
    unfold(frame, "What will a push do?", "true poses")
    before, plain = scene_of(url), purple(page)
    press(frame, "↙")
    number = frame.get_by_text("Steps", exact=True).locator("xpath=following::input[not(@type='hidden')][1]")
    number.fill(str(STEPS))
    number.press("Enter")
    wait_until(lambda: purple(page) > plain + 100)  # the way of the pusher on the table
    press(frame, "Predict")
    row = frame.locator(f'.push-report [data-object="{MUSTARD}"]')
    row.wait_for()
    assert "will move" in frame.locator(".push-status").inner_text()
    wait_until(lambda: purple(page) > plain + 2000)  # ghosts
    assert scene_of(url)["revision"] == before["revision"]  # nothing has moved yet
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / "push_predicted.png")

    press(frame, "Execute")
    frame.locator(".push-report th:has-text('Off by')").wait_for()
    after = scene_of(url)
    assert after["time_s"] == pytest.approx(before["time_s"] + 0.2 * STEPS)
    velocity = [-SPEED / np.sqrt(2), -SPEED / np.sqrt(2), 0]
    rollouts = call(url, "predictions", {"state": before, "actions": [[velocity] * STEPS]})
    place = rollouts["names"].index(MUSTARD)
    predicted, true = np.array(rollouts["positions"][0][-1][place]), np.array(after["objects"][place]["position"])
    start = np.array(before["objects"][place]["position"])
    told = [float(mm) for mm in re.findall(r"([\d.]+) mm", row.inner_text())]
    expected = [predicted - start, true - start, predicted - true]
    np.testing.assert_allclose(told, 1000 * np.linalg.norm(expected, axis=1), atol=0.6)
    assert len(re.findall(r"[\d.]+°", row.inner_text())) == 3
    kept = purple(page)
    assert kept > plain + 300  # the ghosts stay, with the objects in them
    frame.get_by_role("button", name="Play").click()
    frame.get_by_role("button", name="Pause").wait_for()
    frame.get_by_role("button", name="Play").wait_for()
    page.screenshot(path=ARTIFACTS / "push_executed.png")

    show_part(page, "drive")
    page.click("#reset")  # the table has changed by other hands
    frame.locator(".push-status:has-text('has changed')").wait_for()
    wait_until(lambda: purple(page) < kept)  # only the way of the pusher is left
    assert page.problems == []
