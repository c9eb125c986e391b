"""A picture of any format and shape goes the way of what it is: a goal, or a photograph, which can still be cropped."""

import io
import shutil

import numpy as np
import pytest
from PIL import Image
from pillow_heif import register_heif_opener

from tests.e2e.conftest import leave_out_view, watch_errors
from tests.live import call, free_port, start_service, stop_service

pytestmark = pytest.mark.e2e
WAIT_MS = 180_000  # the first time on a machine the renderer is compiled
TABLE, OTHER = ["003_cracker_box", "006_mustard_bottle"], ["005_tomato_soup_can"]
BORDER = 300  # of what lies around the table in a photo [px]


@pytest.fixture(scope="module")
def port(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    port = free_port()
    process = start_service(data_dir, port)
    call(port, "POST", "scenes", {"objects": TABLE, "seed": 4})
    yield port
    stop_service(process)


@pytest.fixture(scope="module")
def goals(port):
    """Pictures of goals: one of the table that is shown, one of other objects; and that of another table, kept."""
    pictures = {}
    for name, objects in (("other", OTHER), ("table", TABLE)):
        scene = call(port, "POST", "scenes", {"objects": objects, "seed": 4})["id"]
        goal = call(port, "POST", "goals", {"scene": scene, "random": {"seed": 1}, "name": f"Goal of the {name}"})
        pictures[name] = Image.open(io.BytesIO(call(port, "GET", f"goals/{goal['id']}/image.png"))).convert("RGB")
    return pictures


@pytest.fixture
def page(browser, port, goals):
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.problems = []
    watch_errors(page)
    leave_out_view(page)
    page.goto(f"http://127.0.0.1:{port}/")
    page.wait_for_selector("#start-episode:not([disabled])", timeout=WAIT_MS)
    yield page
    assert page.problems == []
    page.close()


def send(page, image, name, kind, shown_in="goal-name"):
    data = io.BytesIO()
    image.save(data, kind, quality=95)
    page.set_input_files("#goal-file", {"name": name, "mimeType": "", "buffer": data.getvalue()})
    shown = "([id, name]) => document.getElementById(id).textContent === name"
    page.wait_for_function(shown, arg=[shown_in, name], timeout=WAIT_MS)


def told(page):
    """What is said of the goal, once it has been looked at."""
    page.wait_for_selector('#goal-check[data-level="warning"], #goal-check[data-level="error"]', timeout=WAIT_MS)
    return page.inner_text("#goal-check-text")


def test_a_wide_photo_of_an_iphone_is_a_photograph_and_is_cropped_to_the_table_on_request(page, port, goals):
    register_heif_opener()
    side = 800
    photo = Image.new("RGB", (side + 4 * BORDER, side + BORDER), (200, 190, 180))
    photo.paste(goals["table"].resize((side, side), Image.Resampling.BICUBIC), (3 * BORDER, BORDER))
    send(page, photo, "IMG_0001.HEIC", "HEIF", "photo-name")
    assert page.is_visible("#photo-stage")
    page.click("#photo-crop")
    page.wait_for_selector("#cropping:not([hidden])", timeout=WAIT_MS)
    assert f"of the photo's {photo.width} × {photo.height} px" in page.inner_text("#crop-told")
    page.eval_on_selector("#crop-zoom", "range => { range.value = 30; range.dispatchEvent(new Event('input')); }")
    zoomed = page.inner_text("#crop-told")
    frame = page.locator("#crop-frame").bounding_box()
    page.mouse.move(frame["x"] + 200, frame["y"] + 200)
    page.mouse.down()
    page.mouse.move(frame["x"] + 150, frame["y"] + 120, steps=4)
    page.mouse.up()
    page.focus("#crop-frame")
    page.keyboard.press("ArrowLeft")
    assert page.inner_text("#crop-told") != zoomed
    page.click("#crop-use")
    page.wait_for_selector("#goal-choice:not([hidden])")
    goal = call(port, "GET", "goals")["goals"][0]
    crop = {"left": 3 * BORDER, "top": BORDER, "width": side}
    call(port, "PATCH", f"goals/{goal['id']}", {"crop": crop})
    seen = Image.open(io.BytesIO(call(port, "GET", f"goals/{goal['id']}/image.png")))
    wanted = goals["table"].resize(seen.size, Image.Resampling.BICUBIC)
    assert np.abs(np.asarray(seen, int) - np.asarray(wanted, int)).mean() < 4
    page.wait_for_selector("#start-episode:not([disabled])", timeout=WAIT_MS)


def test_a_blank_square_is_refused_before_start(page):
    send(page, Image.new("RGB", (800, 800), "white"), "blank.png", "PNG")
    assert "Nothing can be seen on the table" in told(page)
    assert page.is_disabled("#start-episode")
    assert page.inner_text("#start-reason") == page.inner_text("#goal-check-text")
    page.check("#despite-doubts")
    assert page.is_enabled("#start-episode")


def test_other_objects_are_refused_or_doubted_beside_the_photo(page, goals):
    send(page, goals["other"], "soup.webp", "WEBP")
    assert "the cracker box and the mustard bottle" in told(page)
    assert page.is_visible("#check-photo")
    assert page.is_visible("#despite-doubts")


def test_what_is_wrong_with_a_picture_is_told_in_view_beside_what_was_pressed(page):
    page.set_input_files("#goal-file", {"name": "notes.txt", "mimeType": "", "buffer": b"a text"})
    told = page.locator("#goal-card .beside-cause")
    told.wait_for(timeout=WAIT_MS)
    assert "no picture that can be read" in told.inner_text()
    bounds = told.bounding_box()
    assert bounds["y"] >= 0
    assert bounds["y"] + bounds["height"] <= 900


def test_objects_are_marked_in_a_goal_that_does_not_suit_the_table(page, goals):
    send(page, goals["other"], "soup.png", "PNG")
    told(page)
    page.click("#check-mark")
    page.wait_for_selector("#photo-card:not([hidden])", timeout=WAIT_MS)
    assert page.inner_text("#photo-name") == "soup.png"
    assert page.is_visible("#photo-stage")


def test_the_goal_of_another_table_offers_that_table(page, port):
    goal = next(goal for goal in call(port, "GET", "goals")["goals"] if goal["name"] == "Goal of the other")
    page.select_option("#goal-select", goal["id"])
    assert "another table, with the tomato soup can" in told(page)
    assert page.is_disabled("#start-episode")
    page.click("#check-table")
    page.wait_for_selector("#goal-check", state="hidden", timeout=WAIT_MS)
    assert page.inner_text("#goal-name") == "Goal of the other"
    page.wait_for_selector("#start-episode:not([disabled])", timeout=WAIT_MS)
    scenes = call(port, "GET", "scenes")["scenes"]
    assert next(scene for scene in scenes if scene["is_current"])["id"] == goal["scene"]
