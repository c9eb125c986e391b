"""What a first visitor sees without a click, and the first clicks from there."""

import os
import shutil
from pathlib import Path

import pytest

from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.fetch import FolderSource, WheelSource, fetch
from tests.conftest import CACHE
from tests.e2e.conftest import watch_errors
from tests.e2e.test_episodes import LONG_MS, WAIT_MS, Service, until
from tests.live import stop_service

pytestmark = pytest.mark.e2e
STORY, OBJECTS = "first", ("006_mustard_bottle", "007_tuna_fish_can")


@pytest.fixture(scope="module")
def service(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    folder = os.environ.get("OSF_TEST_YCB")
    source = FolderSource(Path(folder)) if folder else WheelSource(CACHE / "downloads")
    for _ in fetch(OBJECTS, source, AssetLibrary(data_dir / "objects")):
        pass
    service = Service(data_dir)
    yield service
    stop_service(service.process)


@pytest.fixture
def page(browser, service):
    """A page of a browser that was never here before."""
    context = browser.new_context(viewport={"width": 1440, "height": 900}, color_scheme="light")
    page = context.new_page()
    page.problems = []
    watch_errors(page)
    page.on("console", lambda m: page.problems.append((m.text, m.location)) if m.type == "error" else None)
    page.goto(service.url)
    yield page
    assert page.problems == []
    context.close()


def picture(page):
    """Which of the table's pictures is shown: how far their grid has been moved."""
    return page.evaluate("getComputedStyle(document.getElementById('story-now')).transform")


def test_a_story_plays_without_a_click_with_its_picture_and_curve(page):
    page.wait_for_selector("#story-foot:not([hidden])", timeout=WAIT_MS)
    assert "how a tabletop should look" in page.inner_text(".story-what")
    assert page.locator(".story-buttons button:visible").count() >= 3
    assert not page.is_visible("#cameras")
    until(lambda: page.eval_on_selector("#story-goal", "image => image.complete && image.naturalWidth > 1"))
    until(lambda: "Push" in page.inner_text("#story-stage"))
    before = picture(page)
    until(lambda: picture(page) != before)
    until(lambda: "pushes; it took" in page.inner_text("#story-stage"))
    heights = [
        point.split(",")[1] for point in page.get_attribute("#story-curve path:nth-child(2)", "d").split("L")[1:]
    ]
    assert float(heights[-1]) > float(heights[0])  # it falls


def test_it_is_paused_and_scrubbed_on_the_timeline(page):
    until(lambda: "Push" in page.inner_text("#story-stage"))
    page.click("#timeline-play")
    at, shown = page.input_value("#timeline"), picture(page)
    page.wait_for_timeout(500)
    assert (page.input_value("#timeline"), picture(page)) == (at, shown)
    page.press("#timeline", "Home")
    until(lambda: "Four cameras look" in page.inner_text("#story-stage"))
    page.press("#timeline", "End")
    until(lambda: "pushes; it took" in page.inner_text("#story-stage"))
    step = page.inner_text("#timeline-step")
    page.press("#timeline", "ArrowLeft")
    until(lambda: page.inner_text("#timeline-step") != step)
    assert picture(page) != shown


def test_where_less_motion_is_wanted_it_stands_still_until_it_is_played(browser, service):
    page = browser.new_context(reduced_motion="reduce").new_page()
    page.goto(service.url)
    page.wait_for_selector("#viewer:not([hidden])", timeout=WAIT_MS)
    page.wait_for_timeout(3000)
    assert page.input_value("#timeline") == "0"
    page.click("#timeline-play")
    until(lambda: float(page.input_value("#timeline")) > 1)
    page.context.close()


def test_closed_it_stays_away_and_comes_back_on_demand(page):
    page.click("#back-to-live", timeout=WAIT_MS)
    assert not page.is_visible("#story-foot")
    assert page.is_visible("#cameras")
    page.reload()
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    page.wait_for_timeout(1000)
    assert not page.is_visible("#story-foot")
    page.click("#story-button")
    assert page.is_visible("#story-foot")


def test_a_photo_or_the_lamp_are_one_click_away(page):
    with page.expect_file_chooser(timeout=WAIT_MS):
        page.click("#story-photo", timeout=WAIT_MS)
    assert page.is_visible("#panel-photo")
    page.click("#story-button")
    page.click("#story-lamp")
    assert page.is_visible("#azimuth")


def test_it_runs_live_with_what_was_prepared_and_notices_a_turned_lamp(page, service):
    page.click("#story-run", timeout=WAIT_MS)
    episode = until(lambda: service.call("GET", "episodes")["episodes"])[0]
    until(lambda: service.call("GET", f"episodes/{episode['id']}")["done"] >= 1, LONG_MS / 1000)
    until(lambda: "prepared with this example" in page.inner_text("#shown-text"))
    assert page.is_visible("#pinned-goal")
    assert page.is_visible("#pinned-now")
    page.press("#timeline", "Home")
    page.wait_for_selector("#replaying:not([hidden])", timeout=WAIT_MS)
    seen = "#camera-strip .part-of-frame"
    until(lambda: page.eval_on_selector(seen, "image => image.complete && image.naturalWidth > 1"))
    assert page.is_visible(seen)
    page.click("#camera-strip button >> nth=1")
    assert page.locator("#camera-dialog .part-of-frame:visible").count() == 1
    assert not page.is_visible("#camera-large")  # what the camera sees now
    page.keyboard.press("Escape")
    page.click("#back-to-live")
    assert not page.is_visible("#replaying")
    assert not page.is_visible(seen)
    page.click("#story-button")
    assert page.is_visible("#story-foot")
    assert not page.is_visible("#story-run")  # one runs already
    page.click("#back-to-live")
    page.wait_for_selector("#shown:not([hidden])", timeout=WAIT_MS)
    assert not page.is_visible("#story-foot")
    page.click("#fool-turn", timeout=WAIT_MS)
    until(lambda: "You: The lamp was moved" in page.inner_text("#noticed-large"))
    until(lambda: "found again" in page.inner_text("#noticed-large"))
    page.click("#run-cancel")
    page.wait_for_selector("#ending:not([hidden])", timeout=WAIT_MS)
    assert "push" in page.inner_text("#ending-sum")
    page.click("#timeline-play")
    page.wait_for_selector("#replaying:not([hidden])", timeout=WAIT_MS)
    page.click("#back-to-live")
    assert not page.is_visible("#replaying")


def test_without_its_objects_a_story_says_what_is_missing(browser, service, tmp_path):
    bare = Service(tmp_path)
    try:
        page = browser.new_context().new_page()
        page.goto(bare.url)
        page.click("#story-run", timeout=WAIT_MS)
        until(lambda: "must be fetched first" in page.inner_text(".toasts"))
        page.context.close()
    finally:
        stop_service(bare.process)
