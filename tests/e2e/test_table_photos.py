"""A photo of a table on the page: marked with the pointer, looked at, made the goal; the episode can begin."""

import io
import shutil

import numpy as np
import pytest
from PIL import Image

from osfcore.geometry.cameras import goal_camera
from tests.app.api.test_photos import box_around, jpeg_of
from tests.app.conftest import until
from tests.e2e.conftest import leave_out_view, watch_errors
from tests.live import call, free_port, start_service, stop_service

pytestmark = pytest.mark.e2e
WAIT_MS = 120_000
TABLE = ["003_cracker_box", "006_mustard_bottle"]
SIDE = 512


@pytest.fixture(scope="module")
def port(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    port = free_port()
    process = start_service(data_dir, port)
    yield port
    stop_service(process)


@pytest.fixture(scope="module")
def scene(port):
    return call(port, "POST", "scenes", {"objects": TABLE, "seed": 5, "light": {"position": [0.1, -0.1, 1.0]}})


@pytest.fixture(scope="module")
def photo(port, scene):
    """JPEG of the table, encoded as cameras do."""
    png = call(port, "GET", f"scenes/{scene['id']}/images/goal.png?size={SIDE}&pusher=false")
    return jpeg_of(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255)


@pytest.fixture(scope="module")
def boxes(port, scene):
    """Around each object in the photo."""

    def around(name):
        png = call(port, "GET", f"scenes/{scene['id']}/masks/goal/{name}.png?size={SIDE}")
        return box_around(np.asarray(Image.open(io.BytesIO(png))) > 127)

    return {name: around(name) for name in TABLE}


@pytest.fixture
def page(browser, port, scene):
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.problems = []
    watch_errors(page)
    leave_out_view(page)
    page.goto(f"http://127.0.0.1:{port}/?tab=photo")
    yield page
    page.close()
    until(lambda: call(port, "GET", "driver")["visitors"] == 0)  # while it is there, the next page only watches
    assert page.problems == []


def send(page, photo, name="table.jpg"):
    page.set_input_files("#table-photo-file", {"name": name, "mimeType": "image/jpeg", "buffer": photo})
    page.wait_for_function("name => document.getElementById('photo-name').textContent === name", arg=name)
    focal = round(float(goal_camera(SIDE).intrinsics[0, 0]))
    page.fill("#photo-camera input", str(focal))
    with page.expect_response(lambda answer: answer.request.method == "PATCH"):
        page.click("#photo-camera button")


def on_page(page, *point):
    """Where a point of the photo is on the page."""
    script = """([x, y]) => {
      const place = new DOMPoint(x, y).matrixTransform(document.getElementById("photo-svg").getScreenCTM());
      return [place.x, place.y];
    }"""
    return page.evaluate(script, [float(value) for value in point])


def drag(page, *points):
    page.mouse.move(*on_page(page, *points[0]))
    page.mouse.down()
    for point in points[1:]:
        page.mouse.move(*on_page(page, *point), steps=4)
    page.mouse.up()


def mark(page, name, box):
    page.select_option("#photo-object", name)
    with page.expect_response(lambda answer: answer.request.method == "PUT"):
        drag(page, box[:2], ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), box[2:])
    page.wait_for_selector(f'#photo-objects [data-object="{name}"]')


def latest(port):
    return call(port, "GET", f"photos/{call(port, 'GET', 'photos')['photos'][0]['id']}")


def test_a_photo_becomes_the_goal(page, port, scene, photo, boxes):
    send(page, photo)
    assert page.is_disabled("#find-objects")
    for name in TABLE:
        mark(page, name, boxes[name])
    assert page.locator("#photo-outlines path").count() == len(TABLE)
    names, size = page.locator("#photo-outlines .photo-name"), page.viewport_size
    before = names.first.bounding_box()["height"]
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_timeout(300)
    assert names.first.bounding_box()["height"] == pytest.approx(before, abs=2)  # as large, though the photo is smaller
    page.set_viewport_size(size)
    page.click("#find-objects")
    page.wait_for_selector("#photo-result:not([hidden])", timeout=3 * WAIT_MS)
    assert page.locator(".photo-poses img").count() >= len(TABLE)
    page.wait_for_function("() => document.getElementById('photo-drawing').href.baseVal.includes('drawing.png')")
    if page.is_visible("#photo-doubts"):
        page.check("#photo-despite")
    page.click("#photo-goal")
    page.wait_for_selector("#panel-episode:not([hidden])", timeout=WAIT_MS)
    assert page.inner_text("#goal-name") == "table.jpg"
    assert "Your photo" in page.inner_text("#goal-origin")
    assert page.is_hidden("#photo-stage")
    page.wait_for_selector("#start-episode:not([disabled])", timeout=WAIT_MS)
    assert call(port, "GET", "goals")["goals"][0]["scene"] == scene["id"], "the table on view holds these objects"


def test_a_sample_photo_is_sent_marked_and_looked_at_with_one_click(page, port):
    page.click("#sample-photo")
    page.wait_for_selector("#photo-finding:not([hidden])", timeout=WAIT_MS)
    photo = latest(port)
    assert len(photo["objects"]) == page.locator("#photo-objects li").count() >= 2
    assert photo["focal_source"] == "file"
    assert photo["job"]["kind"] == "photo"
    page.click("#cancel-finding")
    page.wait_for_selector("#photo-finding", state="hidden", timeout=WAIT_MS)


def test_clicks_and_strokes_mend_an_outline_and_it_can_be_taken_back(page, port, photo, boxes):
    send(page, photo, "mend.jpg")
    name = TABLE[0]
    mark(page, name, boxes[name])
    before = latest(port)["objects"][0]
    assert (before["strokes"], before["off"]) == ([], [])
    left, top, right, bottom = boxes[name]
    page.check('input[name="photo-tool"][value="remove"]', force=True)
    with page.expect_response(lambda answer: answer.request.method == "PUT"):
        drag(page, (left + 10, top + 10), (right - 10, top + 10))
    with page.expect_response(lambda answer: answer.request.method == "PUT"):
        page.mouse.click(*on_page(page, left + 2, bottom - 2))
    after = latest(port)["objects"][0]
    assert [stroke["adds"] for stroke in after["strokes"]] == [False]
    assert len(after["off"]) == 1
    assert after["outline"] != before["outline"]
    page.click(f'[aria-label="Remove: {after["label"]}"]')
    page.wait_for_selector(f'#photo-objects [data-object="{name}"]', state="detached")
    assert latest(port)["objects"] == []


def test_what_is_no_photo_is_told_beside_the_button_and_a_photo_can_be_deleted(page, port, photo):
    page.set_input_files("#table-photo-file", {"name": "notes.txt", "mimeType": "", "buffer": b"a text"})
    page.wait_for_selector(".beside-cause")
    assert "no picture that can be read" in page.inner_text(".beside-cause")
    send(page, photo, "gone.jpg")
    before = len(call(port, "GET", "photos")["photos"])
    page.click("#delete-photo")
    page.click("#delete-photo")
    page.wait_for_function("() => document.getElementById('photo-name').textContent !== 'gone.jpg'")
    assert len(call(port, "GET", "photos")["photos"]) == before - 1
