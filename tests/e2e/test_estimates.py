"""Estimating as a person does it: a real browser, the real service, one object in small images."""

import io
import json
import re
import shutil
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from app.cli.collect import CollectObservationCommand
from osfcore.io.observation_file import read_observation, write_observation
from tests.app.services.test_image_sets import zipped
from tests.e2e.conftest import show_part, watch_errors
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service

pytestmark = pytest.mark.e2e
MUSTARD = "006_mustard_bottle"
ESTIMATE_S = 300  # some seconds of work, beside a browser that draws without a GPU


@pytest.fixture(scope="module")
def data_dir(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    return data_dir


@pytest.fixture(scope="module")
def url(data_dir):
    with live_service(data_dir) as url:
        wait_until(lambda: call(url, "GET", "scenes")["current"])
        call(url, "POST", "scenes", {"seed": 2, "objects": [MUSTARD], "image_size": 64})
        yield url


@pytest.fixture(scope="module")
def folder(data_dir, tmp_path_factory):
    place = tmp_path_factory.mktemp("elsewhere") / "seen"
    CollectObservationCommand(place, (MUSTARD,), seed=4, size=64, data_dir=data_dir, json=True).run()
    return place


@pytest.fixture
def page(browser, url):
    page = browser.new_page(viewport={"width": 1366, "height": 1000}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    # viser takes a picture's address back even while the browser still loads the picture, where a newer one has come.
    own = lambda m: m.type == "error" and not m.location["url"].startswith("blob:")  # noqa: E731
    page.on("console", lambda m: page.problems.append(m.text) if own(m) else None)
    page.goto(url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    show_part(page, "estimate")
    yield page
    page.close()


def call(url, method, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{url}/api/{path}", data, {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.load(answer)


def state_of(page):
    return page.get_attribute("#estimating", "data-state")


def latest(url):
    return call(url, "GET", f"estimates/{call(url, 'GET', 'estimates')['estimates'][0]['id']}")


def table_view(page) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.locator("#viewer").screenshot())).convert("RGB"), int)


def has_picture(page) -> bool:
    script = "(() => { const i = document.getElementById('estimate-image'); return i.complete && i.naturalWidth })()"
    return page.evaluate(script) == 3 * 64


def test_from_the_button_to_poses_light_and_how_sure_they_are(page, url):
    frame = page.frame_locator("#viewer")
    frame.locator("canvas").first.wait_for(timeout=WAIT_MS)
    wait_until(lambda: table_view(page).std() > 20)  # the table is there
    before = table_view(page)
    page.click("#new-estimate [type=submit]")
    wait_until(lambda: state_of(page) == "running", ESTIMATE_S)
    wait_until(lambda: page.locator("#loss-curves path").count() > 0, ESTIMATE_S)
    wait_until(lambda: has_picture(page), ESTIMATE_S)
    assert "Mustard" in page.inner_text("#loss-key")
    wait_until(lambda: state_of(page) == "done", ESTIMATE_S)
    page.wait_for_selector("#estimate-result", timeout=WAIT_MS)
    found = latest(url)
    told = page.inner_text(f'#estimate-rows [data-object="{MUSTARD}"]')
    assert "Mustard bottle" in told
    assert ", ".join(f"{100 * x:.1f}" for x in found["estimate"]["objects"][0]["position"]) in told
    off = re.search(r"([\d.]+) mm\s+([\d.]+)°", told)
    assert float(off[1]) == pytest.approx(found["simulation"]["objects"][0]["position_mm"], rel=0.06)
    assert float(off[2]) == pytest.approx(found["simulation"]["objects"][0]["rotation_deg"], rel=0.06)
    assert "° up" in page.inner_text('#estimate-rows [data-object="light"]')
    assert page.inner_text("#estimate-trust") == ("Trusted" if found["estimate"]["trusted"] else "Not trusted")
    assert page.is_visible("#simulation-note")
    with page.expect_download() as download:
        page.click("#download-state")
    with open(download.value.path()) as file:
        assert json.load(file) == found["estimate"]
    # Wires, a ball, a sector and words are in the 3D view now.
    wait_until(lambda: (np.abs(table_view(page) - before).max(axis=-1) > 40).sum() > 300, 60)
    assert page.problems == []


def test_an_estimate_is_cancelled_from_its_card(page, url):
    page.click("#new-estimate [type=submit]")
    wait_until(lambda: state_of(page) == "running", ESTIMATE_S)
    page.click("#cancel-estimate")
    wait_until(lambda: state_of(page) == "cancelled", 10)
    assert latest(url)["status"] == "cancelled"
    assert not page.is_visible("#cancel-estimate")
    assert page.problems == []


def test_an_uploaded_folder_shows_doubts_and_no_truth(page, folder, tmp_path):
    observation = read_observation(folder)
    masks = np.zeros_like(observation.masks)
    masks[:, :, 4:20, 4:20] = True  # a corner of the table
    write_observation(tmp_path / "mistaken", replace(observation, masks=masks))
    page.set_input_files("#observation-folder", tmp_path / "mistaken")
    page.wait_for_selector("#estimating-title:has-text('mistaken')", timeout=WAIT_MS)
    wait_until(lambda: state_of(page) == "done", ESTIMATE_S)
    page.wait_for_selector("#estimate-rows tr.doubtful .missing:has-text('doubtful: ')", timeout=WAIT_MS)
    assert page.inner_text("#estimate-trust") == "Not trusted"
    assert not page.is_visible("#simulation-note")
    assert page.problems == []


def test_mistakes_are_told_in_words(page, folder, tmp_path):
    write_observation(tmp_path / "bare", replace(read_observation(folder), masks=None))
    (tmp_path / "bare.zip").write_bytes(zipped(tmp_path / "bare"))
    page.set_input_files("#observation-file", tmp_path / "bare.zip")
    page.wait_for_selector(".beside-cause:has-text('masks of the first frame is missing')", timeout=WAIT_MS)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "photo.png").write_bytes(b"x")
    page.set_input_files("#observation-folder", tmp_path / "empty")
    page.wait_for_selector(".beside-cause:has-text('holds no observation.json')", timeout=WAIT_MS)
    page.select_option('#new-estimate select[name="mode"]', "goal")
    page.set_input_files("#observation-file", tmp_path / "bare.zip")
    page.wait_for_selector(".beside-cause:has-text('number of views of a goal is 4')", timeout=WAIT_MS)


def test_every_control_has_a_name(page):
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll("#panel-estimate button, #panel-estimate input, #panel-estimate select, "
          + "#panel-estimate progress, #panel-estimate img, #panel-estimate svg")]
          .filter((node) => !(node.ariaLabel || node.alt || node.innerText?.trim() || node.labels?.length
            || node.getAttribute("aria-label")))
          .map((node) => node.id)"""
    )
    assert unnamed == []
