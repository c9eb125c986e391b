"""Calibrating a camera on the page: photos of the board one by one, what is missing, the camera saved and used."""

import json

import numpy as np
import pytest

from osfcore.photo.calibration import board_place
from tests.app.api.test_calibration import ON_TABLE, TILTS, png_of
from tests.app.api.test_photos import gray
from tests.e2e.conftest import leave_out_view, show_part, watch_errors
from tests.live import call, free_port, start_service, stop_service
from tests.support.boards import K, tilted

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    port = free_port()
    process = start_service(tmp_path_factory.mktemp("data"), port)
    yield port
    stop_service(process)


@pytest.fixture
def page(browser, port):
    page = browser.new_page(viewport={"width": 1440, "height": 1000})
    page.problems = []
    watch_errors(page)
    leave_out_view(page)
    page.goto(f"http://127.0.0.1:{port}/?tab=calibration")
    yield page
    page.close()
    assert page.problems == []


def send(page, field, *photos):
    files = [{"name": name, "mimeType": "image/png", "buffer": data} for name, data in photos]
    with page.expect_response(lambda answer: answer.url.endswith("/api/calibration")):
        page.set_input_files(field, files)
    page.wait_for_selector("#calibration-result:not([hidden])")


def lain(page, field, value):
    """Say where the board lies on the table."""
    with page.expect_response(lambda answer: answer.url.endswith("/api/calibration")):
        page.fill(f'#board-place [name="{field}"]', str(value))
        page.press(f'#board-place [name="{field}"]', "Enter")
    page.wait_for_selector("#save-camera:not([disabled])")


def test_a_camera_is_calibrated_saved_and_used(page, port):
    boards = [(f"board{n}.png", png_of(tilted(tilt).inverse(), n)) for n, tilt in enumerate(TILTS)]
    send(page, "#board-photo-files", boards[0])
    assert "3 or more" in page.inner_text("#calibration-missing")
    assert page.is_disabled("#save-camera")
    page.set_input_files("#board-photo-files", {"name": "wall.png", "mimeType": "image/png", "buffer": gray(640, 480)})
    page.wait_for_selector("#board-photos .missing")
    assert "wall.png cannot be used" in page.inner_text("#board-photos .missing")
    page.click('[aria-label="Remove: wall.png"]')
    send(page, "#board-photo-files", *boards[1:])
    page.wait_for_selector("#save-camera:not([disabled])")
    assert page.is_hidden("#calibration-missing")
    assert page.inner_text("#calibration-error").startswith("0.")
    table = png_of(ON_TABLE, 9)
    assert page.is_hidden("#board-place")
    send(page, "#table-view-file", ("table.png", table))
    lain(page, "x_m", 0.1)
    lain(page, "turn_deg", 90)
    turned = board_place(0.1, 0.0, 90.0) @ ON_TABLE
    assert page.locator("#board-photos li").count() == len(boards) + 1
    with page.expect_download() as download:
        page.click("#save-camera")
    camera = json.loads(download.value.path().read_text())
    assert np.abs(np.array(camera["K"]) - K).max() < 3
    assert np.abs(np.array(camera["T_world_camera"]) - turned.matrix()).max() < 2e-3
    show_part(page, "photo")
    page.set_input_files("#table-photo-file", {"name": "t.png", "mimeType": "image/png", "buffer": table})
    page.wait_for_selector("#photo-calibrated:not([hidden])")
    with page.expect_response(lambda answer: answer.request.method == "PATCH"):
        page.click("#use-camera")
    (photo,) = call(port, "GET", "photos")["photos"]
    assert call(port, "GET", f"photos/{photo['id']}")["focal_px"] == pytest.approx(camera["K"][0][0], abs=0.01)


def test_a_photo_can_be_removed_again(page):
    boards = [(f"board{n}.png", png_of(tilted(tilt).inverse(), n)) for n, tilt in enumerate(TILTS[:2])]
    send(page, "#board-photo-files", *boards)
    page.click('[aria-label="Remove: board0.png"]')
    page.wait_for_function("() => document.getElementById('calibration-missing').textContent.includes('is 1, but')")
    assert page.locator("#board-photos li").count() == 1
