"""Predicting a push as a person does it: a real browser, the real service, real objects and the network that ships."""

import io
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from app.services.pushes import SPEED_M_S, beyond_nearest, toward
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.e2e.conftest import ARTIFACTS, show_part, watch_errors
from tests.e2e.test_neural import call, seen_at
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service

pytestmark = pytest.mark.e2e
MUSTARD, GELATIN = "006_mustard_bottle", "009_gelatin_box"
LOAD_S = 90  # the network, the first time on a busy machine


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
    def note_error(message):
        if message.type == "error" and "preventDefault" not in message.text:  # viser's client says that of each drag
            page.problems.append(message.text)

    page = browser.new_page(viewport={"width": 1366, "height": 1000}, color_scheme="light")
    page.set_default_timeout(1000 * LOAD_S)
    page.problems = []
    watch_errors(page)
    page.on("console", note_error)
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


def test_a_push_is_dragged_predicted_executed_and_compared(page, url, library):
    page.frame_locator("#viewer").locator("canvas").first.wait_for(timeout=WAIT_MS)
    page.click("#frame-view")
    before, plain = scene_of(url), purple(page)
    box = page.locator("#viewer").bounding_box()
    pusher = np.array(before["pusher"]["position"])
    aim = np.array(before["objects"][0]["position"])
    spots = [
        seen_at(point, before, library, round(box["width"]), round(box["height"])) + [box["x"], box["y"]]
        for point in (pusher, [*aim[:2], pusher[2]])
    ]
    page.mouse.move(*spots[0])
    page.wait_for_selector("#pointed:has-text('Pusher')")
    page.mouse.down()
    page.mouse.move(*(spots[0] + spots[1]) / 2, steps=5)
    page.mouse.move(*spots[1], steps=5)
    page.mouse.up()
    page.wait_for_selector("#push-told:has-text('will move')")
    wait_until(lambda: purple(page) > plain + 500)  # the arrow and the ghosts
    assert scene_of(url)["revision"] == before["revision"]  # nothing has moved yet
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / "push_predicted.png")

    page.click("#push-clear")
    wait_until(lambda: purple(page) < plain + 100)
    page.click("#push-nearest")
    row = page.locator(f'#push-rows [data-object="{MUSTARD}"]')
    row.wait_for()
    wait_until(lambda: purple(page) > plain + 500)

    page.click("#push-execute")
    page.wait_for_selector("#push-report.is-tried")
    after = scene_of(url)
    things = before["objects"]
    poses = Pose(np.array([one["position"] for one in things]), np.array([one["quaternion"] for one in things]))
    state = SceneState((MUSTARD, GELATIN), poses, Light(np.array(before["light"]["position"])), pusher)
    actions = toward(pusher[:2], beyond_nearest(state), SPEED_M_S)
    assert after["time_s"] == pytest.approx(before["time_s"] + 0.2 * len(actions))
    rollouts = call(url, "predictions", {"state": before, "actions": [actions.tolist()]})
    place = rollouts["names"].index(MUSTARD)
    predicted, true = np.array(rollouts["positions"][0][-1][place]), np.array(after["objects"][place]["position"])
    start = np.array(before["objects"][place]["position"])
    told = [float(mm) for mm in re.findall(r"([\d.]+) mm", row.inner_text())]
    expected = [predicted - start, true - start, predicted - true]
    np.testing.assert_allclose(told, 1000 * np.linalg.norm(expected, axis=1), atol=0.6)
    assert len(re.findall(r"[\d.]+°", row.inner_text())) == 3
    kept = purple(page)
    assert kept > plain + 300  # the ghosts stay, with the objects in them
    page.screenshot(path=ARTIFACTS / "push_executed.png")

    show_part(page, "drive")
    page.click("#reset")  # the table has changed by other hands
    page.wait_for_selector("#push-told:has-text('has changed')")
    wait_until(lambda: purple(page) < kept)
    assert page.problems == []
