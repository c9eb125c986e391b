"""A robot under ROS driven from the page, with boxes drawn in its pictures; rosbridge is a stand-in."""

import contextlib
import shutil
from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.io.image_file import encode_jpeg, to_uint8
from tests.e2e.conftest import ARTIFACTS, watch_errors
from tests.live import free_port, start_service, stop_service
from tests.support.robots import NAMES, simulated, toward_middle, until
from tests.support.ros_robots import QUERY, TableStandIn

pytestmark = pytest.mark.e2e
SIDE = 256
WAIT_MS = 60_000
LONG_MS = 400_000
AROUND_PX = 3


@pytest.fixture(scope="module")
def robot(library):
    """The stand-in, its address, boxes around the objects by camera, and a photo of how the table should look."""
    with contextlib.closing(simulated(library, SIDE)) as table:
        start = table.truth()
        masks = table.render(table.cameras, masks=True).masks
        boxes = [{name: around(mask) for name, mask in zip(table.names, its, strict=True)} for its in masks]
        table.load(replace(toward_middle(start), pusher=np.array([-0.35, -0.35, start.pusher[2]])))
        photo = encode_jpeg(to_uint8(srgb_of_linear(table.render(table.cameras[:1]).images[0])))
        table.restore(start)
        stand_in = TableStandIn(table)
        with stand_in.running() as url:
            yield stand_in, f"{url.partition('?')[0]}?{QUERY}", dict(zip(stand_in.cameras, boxes, strict=True)), photo


def around(mask):
    rows, columns = np.nonzero(mask)
    return (columns.min() - AROUND_PX, rows.min() - AROUND_PX, columns.max() + AROUND_PX, rows.max() + AROUND_PX)


@pytest.fixture
def page(browser, library, robot, tmp_path):
    port = free_port()
    shutil.copytree(library.root, tmp_path / "objects")
    process = start_service(tmp_path, port, more=("--robot", robot[1], "--top-speed", "0.01"))
    page = browser.new_page(viewport={"width": 1366, "height": 1400}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    page.goto(f"http://127.0.0.1:{port}/?tab=robot")
    yield page
    assert page.problems == []
    page.close()
    stop_service(process)


def draw(page, box):
    """Drag a box, given in pixels of the picture."""
    page.locator("#robot-boxes-svg").scroll_into_view_if_needed()
    place = page.locator("#robot-boxes-svg").bounding_box()
    scale = place["width"] / SIDE
    corners = [(place["x"] + scale * x, place["y"] + scale * y) for x, y in (box[:2], box[2:])]
    page.mouse.move(*corners[0])
    page.mouse.down()
    page.mouse.move(*corners[1], steps=3)
    page.mouse.up()


def test_it_is_driven_with_boxes_that_are_drawn_in_its_pictures(page, robot):
    stand_in, _, boxes, photo = robot
    for name in NAMES:
        page.check(f'#robot-names input[value="{name}"]', timeout=WAIT_MS)
    page.set_input_files("#robot-file", {"name": "wanted.jpg", "mimeType": "image/jpeg", "buffer": photo})
    page.wait_for_selector("#robot-goal option", state="attached", timeout=WAIT_MS)
    page.wait_for_selector("#robot-boxes-image[href]", timeout=WAIT_MS)
    assert page.is_disabled("#robot-start")
    assert "Draw a box around Tomato soup can, Gelatin box in" in page.inner_text("#robot-reason")
    for camera, around_objects in boxes.items():
        page.select_option("#robot-box-camera", camera)
        for name in NAMES:
            page.select_option("#robot-box-object", name)
            draw(page, around_objects[name])
    assert page.is_enabled("#robot-start")
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / "robot-boxes.png")
    page.click("#robot-start:not([disabled])", timeout=WAIT_MS)
    page.wait_for_selector("#robot-dialog[open]", timeout=LONG_MS)
    before = stand_in.pusher
    assert stand_in.twists == []
    page.click("#robot-allow")
    until(lambda: np.any(stand_in.pusher != before), 60)
    page.click("#robot-stop")
    until(lambda: not stand_in.velocity.any(), 20)
    page.wait_for_selector("#robot-bar", state="hidden", timeout=WAIT_MS)
    assert "somebody pressed Stop" in page.inner_text("#robot-note")
    count = len(stand_in.twists)
    page.wait_for_timeout(500)
    assert not np.any(stand_in.twists[count:])  # the job, when it ends, may say once more that it shall stand
