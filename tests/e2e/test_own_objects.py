"""An object of one's own as a person adds it: a real browser, the real service, a mesh made here."""

import json
import shutil
import urllib.request

import pytest

from tests.app.api.test_objects import glb
from tests.e2e.conftest import leave_out_view, watch_errors
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service

pytestmark = pytest.mark.e2e
WORK_S = 90
IS_DRAWN = """name => {
  const image = document.querySelector(`[data-object="${name}"] img`);
  return Boolean(image?.complete && image.naturalWidth === 24 * image.naturalHeight && image.naturalHeight > 0);
}"""


@pytest.fixture(scope="module")
def url(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    (data_dir / "goals" / "half").mkdir(parents=True)
    (data_dir / "goals" / "half" / "goal.json").write_text('{"name": "Half of a')
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("https_proxy", "http://127.0.0.1:9")  # where nobody answers: it is without a network
        with live_service(data_dir) as url:
            yield url


@pytest.fixture
def page(browser, url):
    page = browser.new_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    leave_out_view(page)
    page.goto(url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    page.click("#tab-objects")
    yield page
    page.close()


def choose(page, sides, name="Tall box.glb"):
    page.set_input_files("#own-object-file", {"name": name, "mimeType": "model/gltf-binary", "buffer": glb(sides)})
    wait_until(lambda: page.inner_text("#own-object-state") != "", 10)


def test_a_mesh_in_millimetres_is_sized_weighed_added_put_on_the_table_pushed_and_led_on_to_training(page, url):
    choose(page, (100.0, 100.0, 100.0), "Cube.glb")
    choose(page, (60.0, 100.0, 80.0))
    assert page.input_value("#new-object [name=unit]") == "0.001"  # guessed: nothing here is 100 m long
    assert "6.0 × 8.0 × 10.0 cm" in page.inner_text("#own-object-state")
    assert page.input_value("#new-object [name=label]") == "Tall box"
    page.click("#new-object [type=submit]")
    ready = "Ready: 6.0 × 8.0 × 10.0 cm, 240 g, guessed"
    wait_until(lambda: page.inner_text("#object-work-state").startswith(ready), WORK_S)
    tile = page.locator('[data-object="tall_box"]')
    tile.wait_for(timeout=WAIT_MS)
    tile.scroll_into_view_if_needed()
    wait_until(lambda: page.evaluate(IS_DRAWN, "tall_box"), WORK_S)
    assert "240 g" in tile.inner_text()
    page.get_by_role("button", name="Put it on the table: Tall box").click()
    wait_until(lambda: "Tall box" in page.inner_text("#toasts"), WORK_S)
    with urllib.request.urlopen(f"{url}/api/scenes", timeout=20) as answer:
        listed = json.load(answer)
    shown = next(scene for scene in listed["scenes"] if scene["id"] == listed["current"])
    assert "tall_box" in [entry["name"] for entry in shown["objects"]]
    push = page.get_by_role("button", name="Push it: Tall box")
    push.wait_for(timeout=WAIT_MS)
    push.click()
    before = shown["time_s"]
    page.keyboard.press("Enter")  # the first button of the pad has the focus

    def scene():
        with urllib.request.urlopen(f"{url}/api/scenes/{shown['id']}", timeout=20) as answer:
            return json.load(answer)

    wait_until(lambda: scene()["time_s"] > before, WORK_S)
    page.click("#tab-objects")
    tile.get_by_text("Train its field").click()
    assert page.is_visible("#new-field")
    assert page.input_value("#new-field [name=mesh]") == "tall_box"
    assert "min" in page.inner_text("#training-time")
    assert page.problems == []


def test_what_is_wrong_with_a_mesh_is_told_in_the_tab_and_the_form_can_be_used_again(page):
    choose(page, (60.0, 100.0, 80.0), "Giant.glb")
    page.fill("#new-object [name=grams]", "150")
    page.select_option("#new-object [name=unit]", "1")
    assert "another unit" in page.inner_text("#own-object-state")
    page.click("#new-object [type=submit]")
    wait_until(lambda: "millimetres" in page.inner_text("#object-work-error"), WORK_S)
    page.select_option("#new-object [name=unit]", "0.001")
    page.click("#new-object [type=submit]")
    wait_until(lambda: page.inner_text("#object-work-state").startswith("Ready"), WORK_S)
    tile = page.locator('[data-object="giant"]')
    tile.get_by_text("Delete").click()
    tile.get_by_text("Really delete").click()
    tile.wait_for(state="detached", timeout=WAIT_MS)
    assert page.problems == []


def test_the_form_tells_of_the_latest_file(page):
    choose(page, (60.0, 100.0, 80.0), "Red_box.glb")
    choose(page, (60.0, 100.0, 80.0), "Blue_box.glb")
    wait_until(lambda: page.inner_text("#own-object-state").startswith("Blue_box.glb"), 10)
    assert page.inner_text("#own-object-file-name") == "Blue_box.glb"
    assert page.input_value("#new-object [name=label]") == "Blue box"


def test_whatever_is_missing_can_be_fetched_and_without_a_network_that_is_said(page):
    page.wait_for_selector('[data-object="011_banana"]', timeout=WAIT_MS)
    assert page.locator("#object-list li", has_text="not on this machine").count() > 10
    for tile in page.locator("#object-list li", has_text="not on this machine").all():
        assert tile.get_by_role("button", name="Fetch").count() == 1
    page.get_by_role("button", name="Fetch: Banana").click()
    wait_until(lambda: "network" in page.inner_text("#object-work-error"), WORK_S)


def test_a_thumbnail_turns_under_the_pointer_and_stands_still_where_motion_is_unwanted(browser, url):
    for motion, expected in (("no-preference", "turntable"), ("reduce", "none")):
        page = browser.new_page(reduced_motion=motion)
        page.goto(url)
        page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
        page.click("#tab-objects")
        tile = page.locator('[data-object="003_cracker_box"]')
        tile.wait_for(timeout=WAIT_MS)
        tile.hover()
        assert tile.locator("img").evaluate("image => getComputedStyle(image).animationName") == expected
        page.close()


def test_what_is_damaged_is_listed_with_a_reason_and_can_be_deleted(page, url):
    entry = page.locator("#damaged-list li")
    entry.wait_for(timeout=WAIT_MS)
    assert "Goal" in entry.inner_text()
    assert "JSON" in entry.inner_text()
    for _ in range(2):  # it asks twice
        entry.locator("button").click()
    page.wait_for_selector("#damaged", state="hidden", timeout=WAIT_MS)
    with urllib.request.urlopen(f"{url}/api/goals") as answer:
        assert json.load(answer)["damaged"] == []
