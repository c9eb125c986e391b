"""The page as a person uses it: a real browser against the real service."""

import io
import json
import shutil
import time
import urllib.request
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from tests.e2e.conftest import leave_out_view, show_part, watch_errors
from tests.live import free_port, live_service, start_service, stop_service

pytestmark = pytest.mark.e2e
WAIT_MS = 20_000
PARTS = ("episode", "photo", "objects", "fields", "drive", "scenes", "estimate", "calibration", "jobs")
WCAG = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]


@pytest.fixture(scope="module")
def service(library, tmp_path_factory):
    """A running service that tests may restart: a mutable holder of port, data directory and process."""

    class Service:
        port = free_port()
        data_dir = tmp_path_factory.mktemp("data")

        @property
        def url(self) -> str:
            return f"http://127.0.0.1:{self.port}"

        def start(self) -> None:
            self.process = start_service(self.data_dir, self.port)

        def get(self, path: str):
            with urllib.request.urlopen(f"{self.url}/api/{path}", timeout=20) as answer:
                return json.load(answer)

        def scene(self) -> dict:
            listed = self.get("scenes")
            return next(scene for scene in listed["scenes"] if scene["id"] == listed["current"])

    running = Service()
    shutil.copytree(library.root, running.data_dir / "objects")
    running.start()
    yield running
    stop_service(running.process)


@pytest.fixture(scope="module")
def tab(browser, service):
    """One page for the module; it notes errors and every request."""
    page = browser.new_page(viewport={"width": 1366, "height": 768}, color_scheme="light")
    page.problems, page.hosts = [], set()
    watch_errors(page)
    page.on("console", lambda m: page.problems.append(m.text) if m.type == "error" else None)
    page.on("request", lambda r: page.hosts.add(urlsplit(r.url).netloc) if r.url.startswith(("http", "ws")) else None)
    page.goto(service.url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    page.wait_for_selector("#poses tr", state="attached", timeout=WAIT_MS)
    yield page
    page.close()


@pytest.fixture
def page(tab):
    show_part(tab, "drive")
    return tab


def pixels(page, selector: str) -> np.ndarray:
    shot = page.locator(selector).screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), float)


def wait_until(condition, timeout_s: float = 60.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it did not happen in time")


def camera_source(page, camera: str) -> str:
    return page.get_attribute(f'img[data-camera="{camera}"]', "src") or ""


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_page_stands_still_while_it_loads(browser, service, size):
    """Comes first: who else is on the page is told above the panel."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.add_init_script(
        """sessionStorage.removeItem("osf-story-seen"); // with the story
        window.shift = 0;
        new PerformanceObserver((list) => {
          for (const entry of list.getEntries()) if (!entry.hadRecentInput) window.shift += entry.value;
        }).observe({ type: "layout-shift", buffered: true });"""
    )
    page.goto(service.url)
    for awaited in ("#story-foot:not([hidden])", '#status[data-state="live"]', "#preset-list li", "#story-key li"):
        page.wait_for_selector(awaited, timeout=WAIT_MS)
    page.wait_for_selector("#tab-try", timeout=WAIT_MS)
    assert page.evaluate("shift") < 0.05


def test_page_loads_without_errors_or_foreign_requests(page, service):
    assert page.title() == "OSF manipulation"
    wait_until(lambda: all(camera_source(page, camera) for camera in ("0", "1", "2", "3", "goal")))
    sides = page.eval_on_selector_all(
        "#camera-strip img[data-camera]", "all => all.map((i) => [i.clientWidth, i.clientHeight])"
    )
    assert all(width == height > 100 for width, height in sides)
    assert page.problems == []
    assert page.hosts == {f"127.0.0.1:{service.port}"}


def test_viewer_shows_the_scene(page):
    frame = page.frame_locator("#viewer")
    frame.locator("canvas").first.wait_for(timeout=WAIT_MS)
    wait_until(lambda: pixels(page, "#viewer")[150:].std() > 20, 30)  # a table with objects, not one colour


@pytest.mark.parametrize("number", ["", "0", "99", "1.5"])
def test_a_number_that_cannot_be_is_told_where_it_stands_and_not_sent(page, service, number):
    show_part(page, "episode")
    page.evaluate("document.getElementById('table-card').open = true")
    posted = []
    note = lambda request: posted.append(request.url) if request.method == "POST" else None  # noqa: E731
    page.on("request", note)
    page.fill("#table-count", number)
    page.click("#another-table")
    assert page.eval_on_selector("#table-count", "input => input.validationMessage")
    page.fill("#table-count", "2")
    before = service.scene()["id"]
    page.click("#another-table")
    wait_until(lambda: service.scene()["id"] != before)
    page.remove_listener("request", note)
    assert [url for url in posted if url.endswith("/scenes")] == [f"{service.url}/api/scenes"]


def test_chosen_objects_make_the_scene(page, service):
    show_part(page, "scenes")
    page.check('input[name="which"][value="chosen"]')
    page.check('#chips input[value="006_mustard_bottle"]')
    page.check('#chips input[value="003_cracker_box"]')
    page.fill('input[name="seed"]', "5")
    page.click("#new-scene [type=submit]")
    wait_until(lambda: service.scene()["seed"] == 5)
    show_part(page, "drive")
    wait_until(lambda: page.locator("#poses tr").count() == 2)
    rows = page.locator("#poses tr").all_inner_texts()
    assert any("Mustard" in row for row in rows)
    assert any("Cracker" in row for row in rows)
    first = service.scene()["objects"][0]
    shown = [float(text) for text in page.locator("#poses tr").first.locator("td").all_inner_texts()[1:]]
    np.testing.assert_allclose(shown, 100 * np.array(first["position"]), atol=0.051)


@pytest.mark.parametrize(
    ("key", "way"), [("ArrowRight", (1, 0)), ("ArrowUp", (0, 1)), ("ArrowLeft", (-1, 0)), ("ArrowDown", (0, -1))]
)
def test_an_arrow_key_pushes_six_centimetres_that_way(page, service, key, way):
    page.locator("h1").click()  # keys belong to the page, not to a field
    before = np.array(service.scene()["pusher"]["position"])
    page.keyboard.press(key)
    wait_until(lambda: service.scene()["time_s"] > 0 and not np.allclose(service.scene()["pusher"]["position"], before))
    time.sleep(0.5)  # a tap is one action; a second one would show by now
    moved = np.array(service.scene()["pusher"]["position"]) - before
    np.testing.assert_allclose(moved, [0.06 * way[0], 0.06 * way[1], 0], atol=1e-6)


def test_a_held_button_keeps_pushing_and_reset_puts_everything_back(page, service):
    before = service.scene()
    button = page.get_by_label("Push away and right")
    box = button.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    wait_until(lambda: service.scene()["time_s"] >= before["time_s"] + 0.6 - 1e-6)
    page.mouse.up()
    page.click("#reset")
    wait_until(lambda: service.scene()["time_s"] == 0)
    wait_until(lambda: "0.0 s" in page.inner_text("#scene-facts"))


def test_keys_do_not_push_while_typing(page, service):
    show_part(page, "scenes")
    before = service.scene()["time_s"]
    page.focus('input[name="seed"]')
    page.keyboard.press("ArrowUp")
    page.focus('input[name="which"][value="chosen"]')
    page.keyboard.press("ArrowLeft")
    assert page.is_checked('input[name="which"][value="random"]')
    time.sleep(0.5)
    assert service.scene()["time_s"] == before


def test_quick_taps_each_count(page, service):
    page.locator("h1").click()
    before = service.scene()
    page.keyboard.press("ArrowDown")
    time.sleep(0.05)  # the first action takes 0.2 s
    page.keyboard.press("ArrowDown")
    wait_until(lambda: service.scene()["time_s"] >= before["time_s"] + 0.4 - 1e-6)
    time.sleep(0.5)
    moved = np.array(service.scene()["pusher"]["position"]) - before["pusher"]["position"]
    np.testing.assert_allclose(moved, [0, -0.12, 0], atol=1e-6)


def test_masks_change_the_images_and_go_away_again(page):
    wait_until(lambda: camera_source(page, "1") != "")
    plain = pixels(page, 'img[data-camera="1"]')
    page.check("#masks")
    wait_until(lambda: "masks=true" in camera_source(page, "1"))
    assert np.abs(pixels(page, 'img[data-camera="1"]') - plain).max() > 40
    page.uncheck("#masks")
    wait_until(lambda: np.abs(pixels(page, 'img[data-camera="1"]') - plain).mean() < 3)


def test_light_follows_slider_and_dial(page, service):
    page.fill("#elevation", "15")
    wait_until(lambda: abs(service.scene()["light"]["position"][2] - np.sin(np.deg2rad(15))) < 0.01)
    low = None

    def has_image() -> bool:
        nonlocal low
        low = pixels(page, 'img[data-camera="1"]')
        return low.mean() < 110

    wait_until(has_image)
    box = page.locator("#dial").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2 + 2, box["y"] + box["height"] / 2)
    wait_until(lambda: service.scene()["light"]["position"][2] > 0.99)
    wait_until(lambda: pixels(page, 'img[data-camera="1"]').mean() > low.mean() + 15)
    assert "elevation 8" in page.inner_text("#light-angles")


def test_an_image_opens_large(page):
    page.click('img[data-camera="goal"]')
    wait_until(lambda: page.evaluate("document.getElementById('camera-large').naturalWidth") == 512)
    page.keyboard.press("Escape")
    wait_until(lambda: page.locator("#camera-dialog[open]").count() == 0)


def test_collection_shows_progress_and_is_cancelled(page):
    show_part(page, "jobs")
    page.fill('#job-fields input[name="episodes"]', "500")
    page.click("#new-job [type=submit]")
    job = page.locator("#job-list li").first
    wait_until(lambda: "of 500" in job.inner_text(), 40)
    assert page.inner_text("#jobs-count") == "1"
    job.get_by_text("Cancel").click()
    wait_until(lambda: job.get_attribute("data-state") == "cancelled")
    assert not page.is_visible("#jobs-count")


def test_a_finished_job_is_deleted_on_all_pages_after_asking_twice(page, service, browser):
    show_part(page, "jobs")
    page.fill('#job-fields input[name="episodes"]', "400")
    page.click("#new-job [type=submit]")
    wait_until(lambda: "of 400" in page.locator("#job-list li").first.inner_text(), 40)
    name = page.locator("#job-list li").first.get_attribute("data-job")
    job = page.locator(f'#job-list li[data-job="{name}"]')
    assert job.get_by_text("Delete").count() == 0
    job.get_by_text("Cancel").click()
    other = browser.new_page()
    other.goto(service.url)
    other.wait_for_selector(f'#job-list li[data-job="{name}"]', state="attached", timeout=WAIT_MS)
    job.get_by_text("Delete", exact=True).click()
    assert name in [one["id"] for one in service.get("jobs")["jobs"]]
    job.get_by_text("Really delete").click()
    wait_until(lambda: job.count() == 0, 5)
    wait_until(lambda: other.locator(f'#job-list li[data-job="{name}"]').count() == 0, 5)
    assert name not in [one["id"] for one in service.get("jobs")["jobs"]]
    other.close()


def test_more_jobs_than_fit_a_page_are_shown_on_demand(page, service, browser):
    for _ in range(2):
        body = json.dumps({"kind": "collect_pushes", "params": {"episodes": 100, "objects": 1}}).encode()
        asked = urllib.request.Request(f"{service.url}/api/jobs", body, {"Content-Type": "application/json"})
        with urllib.request.urlopen(asked, timeout=20) as answer:
            name = json.load(answer)["id"]
        urllib.request.urlopen(urllib.request.Request(f"{service.url}/api/jobs/{name}", method="DELETE"), timeout=20)
    names = [job["id"] for job in service.get("jobs")["jobs"]]
    small = browser.new_page()
    small.route("**/api/jobs", lambda route: route.continue_(url=f"{service.url}/api/jobs?limit=1"))
    small.goto(service.url)
    show_part(small, "jobs")
    wait_until(lambda: small.locator("#job-list li").count() == 1)
    small.click("#more-jobs")
    wait_until(lambda: small.locator("#job-list li").count() == len(names))
    shown = small.locator("#job-list li").evaluate_all("all => all.map((item) => item.dataset.job)")
    assert shown == names
    assert not small.is_visible("#more-jobs")
    small.close()


def test_a_mistake_is_told_in_words(page, service):
    show_part(page, "scenes")
    page.check('input[name="which"][value="chosen"]')
    while page.locator("#chips input:checked").count():
        page.locator("#chips input:checked").first.uncheck()
    page.click("#new-scene [type=submit]")
    assert "at least one object" in page.inner_text("#toasts")
    page.check('input[name="which"][value="random"]')
    page.fill('input[name="count"]', "5")
    page.evaluate("document.querySelector('input[name=count]').max = 8")
    page.fill('input[name="count"]', "8")  # five objects were fetched
    page.click("#new-scene [type=submit]")
    page.wait_for_selector("text=must be at most 5")
    page.fill('input[name="count"]', "3")
    page.problems.clear()  # the browser notes the refusal that was provoked


def test_page_finds_the_service_again_after_a_restart(page, service):
    page.locator("h1").click()
    start_s = service.scene()["time_s"]
    page.keyboard.press("ArrowRight")
    wait_until(lambda: service.scene()["time_s"] > start_s + 0.2 - 1e-6)
    before = service.scene()
    stop_service(service.process)
    wait_until(lambda: page.get_attribute("#status", "data-state") == "lost")
    service.start()
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    after = service.scene()
    assert after["id"] == before["id"]
    np.testing.assert_allclose(after["pusher"]["position"], before["pusher"]["position"], atol=1e-6)
    wait_until(lambda: page.locator("#poses tr").count() == len(after["objects"]))
    page.frame_locator("#viewer").locator("canvas").first.wait_for(timeout=WAIT_MS)
    page.keyboard.press("ArrowLeft")
    wait_until(lambda: service.scene()["revision"] != after["revision"])
    page.problems.clear()  # the browser notes refused connections


def test_page_without_objects_says_what_to_do(browser, tmp_path):
    with live_service(tmp_path) as url:
        page = browser.new_page()
        page.goto(url)
        page.wait_for_selector("#welcome", timeout=WAIT_MS)
        assert page.inner_text("#welcome-button") == "Fetch objects"
        show_part(page, "scenes")
        assert page.is_visible("#no-objects")
        page.click("#new-scene [type=submit]")
        page.wait_for_selector(".beside-cause", timeout=WAIT_MS)  # the service says why not
        page.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_phone_has_no_sideways_scroll_in_either_theme(browser, service, scheme):
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme=scheme)
    phone = context.new_page()
    phone.goto(service.url)
    phone.wait_for_selector("#poses tr", state="attached", timeout=WAIT_MS)
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    ground = phone.evaluate("getComputedStyle(document.body).backgroundColor")
    brightness = np.mean([int(part) for part in ground.removeprefix("rgb(").removesuffix(")").split(",")])
    assert (brightness < 60) == (scheme == "dark")
    for part in PARTS:
        show_part(phone, part)
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    phone.evaluate("scrollTo(0, 300)")
    box = phone.locator(".viewer").bounding_box()
    assert box["y"] == 0  # it stays in sight
    assert box["height"] < 400  # and leaves room for the rest
    context.close()


def findings(page) -> list[str]:
    """What axe-core finds on a page that has it: rules and where they are broken."""
    found = page.evaluate("rules => axe.run(document, { runOnly: rules, resultTypes: ['violations'] })", WCAG)
    return [f"{rule['id']}: {[node['target'] for node in rule['nodes']]}" for rule in found["violations"]]


def test_axe_finds_nothing_in_any_part_theme_and_size(browser, service):
    axe = pytest.importorskip("axe_playwright_python.base")
    page = browser.new_page(color_scheme="light")
    leave_out_view(page)
    page.goto(service.url)
    page.wait_for_selector("#poses tr", state="attached", timeout=WAIT_MS)
    page.evaluate(axe.AXE_SCRIPT)
    for theme in ("light", "dark"):
        for width, height in ((1440, 900), (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            for part in PARTS:
                show_part(page, part)
                assert findings(page) == [], f"{part}, {theme}, {width} wide"
        page.click("#story-button")
        page.wait_for_selector("#story-foot:not([hidden])", timeout=WAIT_MS)
        assert findings(page) == [], f"story, {theme}"
        page.click("#back-to-live")
        page.click("#theme-button")
    page.close()


def test_theme_is_remembered(page):
    page.click("#theme-button")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.reload()
    page.wait_for_selector("#poses tr", state="attached", timeout=WAIT_MS)
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.click("#theme-button")


def test_documentation_works_without_the_internet(browser, service):
    docs = browser.new_page()
    hosts = set()
    docs.on("request", lambda r: hosts.add(urlsplit(r.url).netloc))
    docs.goto(f"{service.url}/docs")
    docs.locator(".opblock").first.wait_for(timeout=WAIT_MS)
    assert hosts - {""} == {f"127.0.0.1:{service.port}"}
    docs.close()
