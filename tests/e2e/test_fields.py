"""Training a field as a person does it: a real browser, the real service, the real training, some seconds of it."""

import json
import shutil
import urllib.request

import pytest

from tests.app.services.test_image_sets import zipped
from tests.e2e.conftest import leave_out_view, watch_errors
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service
from tests.support.ellipsoid_sets import write_set

pytestmark = pytest.mark.e2e
GELATIN = "009_gelatin_box"
TRAIN_S = 400  # 12 s of descent, and the looks at images, on a busy machine


@pytest.fixture(scope="module")
def url(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    with live_service(data_dir) as url:
        yield url


@pytest.fixture
def page(browser, url):
    page = browser.new_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    leave_out_view(page)
    page.on("console", lambda m: page.problems.append(m.text) if m.type == "error" else None)
    page.goto(url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    page.click("#tab-objects")
    yield page
    page.close()


def get(url: str, path: str):
    with urllib.request.urlopen(f"{url}/api/{path}", timeout=20) as answer:
        return json.load(answer)


def has_preview(page) -> bool:
    """Whether the picture is there, and shows something: truth and field are not black."""
    return page.evaluate(
        """() => {
          const image = document.getElementById("training-image");
          if (!image.complete || image.naturalWidth < 48) return false;
          const canvas = document.createElement("canvas");
          [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
          const context = canvas.getContext("2d");
          context.drawImage(image, 0, 0);
          const third = image.naturalWidth / 3;
          const most = (x) => Math.max(...context.getImageData(x, 0, third, third).data.filter((_, i) => i % 4 < 3));
          return most(0) > 60 && most(third) > 60;
        }"""
    )


def test_from_a_mesh_to_a_field_with_preview_and_psnr(page, url):
    assert page.is_visible("#from-mesh")
    page.select_option('#new-field select[name="mesh"]', GELATIN)
    page.fill('#new-field input[name="images"]', "60")
    page.fill('#new-field input[name="minutes"]', "0.2")
    page.click("#new-field [type=submit]")
    wait_until(lambda: "left" in page.inner_text("#training-state"), 90)
    wait_until(lambda: "dB in the mask" in page.inner_text("#training-psnr"), TRAIN_S)
    assert get(url, "jobs")["jobs"][0]["state"] == "running"  # all of this is seen while it trains
    wait_until(lambda: has_preview(page), 10)
    wait_until(lambda: page.get_attribute("#training", "data-state") == "done", TRAIN_S)
    assert has_preview(page)
    told = page.inner_text("#comparison-text")
    assert "That is better, so it stays in use." in told  # some seconds against the shipped field's hour
    assert get(url, f"fields/{GELATIN}")["source"] == "shipped"
    wait_until(lambda: page.evaluate("document.getElementById('comparison-image').naturalWidth") >= 384)
    page.click("#use-new-field")
    page.wait_for_selector("#comparison-choice", state="hidden", timeout=WAIT_MS)
    field = get(url, f"fields/{GELATIN}")
    assert field["source"] == "trained"
    assert f"{get(url, 'jobs')['jobs'][0]['result']['before_mask']:.1f} dB in the mask" in told
    entry = page.locator(f'#field-list [data-field="{GELATIN}"]')
    wait_until(lambda: f"{field['metrics']['psnr_mask']:.1f} dB in the mask" in entry.text_content())
    assert "trained here" in entry.text_content()
    assert "needs a mesh" not in entry.inner_text()
    assert page.problems == []


def test_an_uploaded_set_is_shown_trained_and_says_that_it_needs_a_mesh(page, url, tmp_path):
    page.check('#new-field input[value="set"]')
    (tmp_path / "My Egg.zip").write_bytes(zipped(write_set(tmp_path / "egg", train=24, size=48)))
    page.set_input_files("#set-file", tmp_path / "My Egg.zip")
    page.wait_for_selector("#set-overlay", timeout=WAIT_MS)
    wait_until(lambda: "24 train and 4 test images" in page.inner_text("#set-facts"))
    wait_until(lambda: page.evaluate("document.getElementById('set-overlay').naturalWidth") >= 48)
    assert page.input_value('#new-field input[name="name"]') == "my_egg"
    page.fill('#new-field input[name="minutes"]', "0.1")
    page.click("#new-field [type=submit]")
    wait_until(lambda: page.inner_text("#training-title") == "my_egg")  # not the training before
    wait_until(lambda: page.get_attribute("#training", "data-state") in ("done", "failed"), TRAIN_S)
    entry = page.locator('#field-list [data-field="my_egg"]')
    entry.wait_for(timeout=WAIT_MS)
    assert "needs a mesh for scenes" in entry.inner_text()
    entry.get_by_text("Delete").click()
    assert entry.count() == 1  # it asks once more
    entry.get_by_text("Really delete").click()
    wait_until(lambda: entry.count() == 0)
    assert page.problems == []


def test_mistakes_are_told_in_words(page, tmp_path):
    page.check('#new-field input[value="set"]')
    (tmp_path / "notes.zip").write_bytes(b"these are my notes")
    page.set_input_files("#set-file", tmp_path / "notes.zip")
    page.wait_for_selector("text=The uploaded file cannot be used: it is no zip archive", timeout=WAIT_MS)
    folder = write_set(tmp_path / "egg")
    (folder / "train" / "r_3.png").unlink()
    (tmp_path / "egg.zip").write_bytes(zipped(folder))
    page.set_input_files("#set-file", tmp_path / "egg.zip")
    page.wait_for_selector(".beside-cause:has-text('r_3.png')", timeout=WAIT_MS)
    (tmp_path / "good.zip").write_bytes(zipped(write_set(tmp_path / "good")))
    page.set_input_files("#set-file", tmp_path / "good.zip")
    page.wait_for_selector("#set-overlay", timeout=WAIT_MS)
    assert page.locator(".beside-cause").count() == 0  # what was wrong is settled
    page.fill('#new-field input[name="name"]', "../My Egg")
    page.click("#new-field [type=submit]")
    page.wait_for_selector(".beside-cause:has-text('lower-case letters')", timeout=WAIT_MS)


def test_a_training_can_be_cancelled_from_its_card(page):
    page.select_option('#new-field select[name="mesh"]', GELATIN)
    page.fill('#new-field input[name="images"]', "5000")
    page.click("#new-field [type=submit]")
    wait_until(lambda: "Image" in page.inner_text("#training-state"), 60)
    page.locator("#training-actions").get_by_text("Cancel").click()
    wait_until(lambda: page.get_attribute("#training", "data-state") == "cancelled", 5)
    assert not page.is_visible("#training-preview")
