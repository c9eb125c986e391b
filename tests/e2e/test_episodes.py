"""From the first visit to a table that looks like the photo: a real browser, the real service, real episodes."""

import json
import shutil
import time
import urllib.request

import pytest

from tests.e2e.conftest import show_part, watch_errors
from tests.live import free_port, start_service, stop_service

pytestmark = pytest.mark.e2e
WAIT_MS = 20_000
LOOKING = {"copy-scene", "estimate-camera", "more-jobs"}  # controls that change nothing
LONG_MS = 300_000  # both looks take half a minute of an idle machine
NAMES = ["005_tomato_soup_can", "006_mustard_bottle"]
# Notes each change of the first picture, with the episode that is on view then.
NOTE_PICTURES = """() => {
  window.pictures = [];
  const [image, shown] = ["#tiles img", "#shown"].map((selector) => document.querySelector(selector));
  const note = () => window.pictures.push([shown.dataset.episode, image.getAttribute("src")]);
  new MutationObserver(note).observe(image, { attributeFilter: ["src"] });
}"""
SHORT = {"steps": 3, "samples": 16, "horizon": 6}


class Service:
    """A service that tests may kill and start again."""

    def __init__(self, data_dir):
        self.port, self.data_dir = free_port(), data_dir
        self.start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}"

    def start(self):
        self.process = start_service(self.data_dir, self.port)

    def call(self, method, path, body=None, kind="application/json"):
        data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}/api/{path}", data, {"Content-Type": kind}, method=method)
        with urllib.request.urlopen(request, timeout=60) as answer:
            content = answer.read()
        return json.loads(content) if content and answer.headers["Content-Type"] == "application/json" else content

    def episode(self):
        return self.call("GET", "episodes")["episodes"][0]


@pytest.fixture(scope="module")
def service(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    service = Service(data_dir)
    service.call("POST", "scenes", {"objects": NAMES, "seed": 3, "light": {"position": [0.6, -0.5, 0.5]}})
    yield service
    stop_service(service.process)


@pytest.fixture
def page(browser, service):
    page = browser.new_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.problems = []
    watch_errors(page)
    page.goto(service.url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    yield page
    assert page.problems == []
    page.close()


def choose(page, settings):
    """Settings, as typed into the form."""
    page.evaluate("document.getElementById('settings-card').open = true")
    for name, value in settings.items():
        page.fill(f"#setting-{name}", str(value))
        page.press(f"#setting-{name}", "Tab")


def begin(page, settings):
    choose(page, settings)
    page.click("#start-episode:not([disabled])", timeout=WAIT_MS)
    page.wait_for_selector("#run-live:not([hidden])", timeout=WAIT_MS)


def until(condition, timeout_s=120.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.1)
    raise AssertionError("it did not happen in time")


def test_a_first_visit_ends_with_a_finished_episode_from_an_uploaded_image(page, service, tmp_path):
    drawn = service.call("POST", "goals", {"random": {"seed": 5, "moved": 1}})
    photo = tmp_path / "how it should look.png"
    photo.write_bytes(service.call("GET", f"goals/{drawn['id']}/image.png"))
    service.call("DELETE", f"goals/{drawn['id']}")
    page.wait_for_selector("#start-episode[disabled]")
    page.set_input_files("#goal-file", photo)
    page.wait_for_selector('#goal-image[alt^="Goal: how it should look"]', timeout=LONG_MS)
    begin(page, SHORT)
    page.wait_for_selector("#run-idle:not([hidden])", timeout=LONG_MS)
    episode = service.episode()
    assert (episode["status"], episode["done"]) == ("done", 3), episode["error"]
    page.wait_for_selector("#downloads a", timeout=WAIT_MS)
    assert page.eval_on_selector_all("#downloads a", "links => links.length") == len(episode["files"]) == 6
    assert page.inner_text("#timeline-step") == "3 / 3"
    whole = "img => img.complete && img.naturalWidth === 768"
    until(lambda: page.eval_on_selector("#tiles img", whole))
    for chart in ("distance", "cost", "time"):
        assert page.locator(f"#chart-{chart} canvas").count() == 1
        assert page.get_attribute(f"#chart-{chart}", "aria-label") != "No steps yet"
    assert page.locator("#offset-rows tr").count() == len(NAMES)
    page.click("#shown-details > summary")
    assert "SSIM 0." in page.inner_text("#shown-likeness")
    assert "× real time" in page.inner_text("#first-seconds")
    page.select_option("#timeline-speed", "4")
    page.click("#timeline-play")
    until(lambda: page.get_attribute("#timeline-play", "aria-label") == "Play the recording")
    assert page.inner_text("#timeline-step") == "3 / 3"
    page.click("#make-clip")
    page.wait_for_selector("#clip-state:not(:empty)", timeout=WAIT_MS)
    page.wait_for_selector("#clip:not([hidden])", timeout=LONG_MS)
    until(lambda: page.eval_on_selector("#clip", "video => video.readyState >= 1 && video.videoWidth === 1920"))
    assert page.get_attribute("#save-clip", "href").endswith("clip.mp4")
    assert "clip.mp4" in service.episode()["files"]
    page.goto(f"{service.url}/?episode={episode['id']}&step=1")
    page.wait_for_selector("#clip:not([hidden])", timeout=WAIT_MS)
    page.wait_for_selector("#shown:not([hidden])", timeout=WAIT_MS)
    until(lambda: page.inner_text("#timeline-step") == "1 / 3")
    show_part(page, "drive")
    assert "tab=drive" in page.url
    page.go_back()
    until(lambda: page.get_attribute("#tab-try", "aria-selected") == "true")
    page.press("#timeline", "ArrowRight")
    until(lambda: "step=2" in page.evaluate("location.search"))
    page.reload()
    until(lambda: page.inner_text("#timeline-step") == "2 / 3")
    page.wait_for_selector('#goal-image[alt^="Goal: how it should look"]', state="attached", timeout=WAIT_MS)
    page.click("#close-shown")
    assert "episode=" not in page.url
    page.go_back()
    until(lambda: page.is_visible("#shown"))


def test_a_goal_is_composed_on_the_map_and_kept(page, service):
    page.click("#compose")
    page.wait_for_selector("#composing:not([hidden])", timeout=WAIT_MS)
    until(lambda: page.eval_on_selector("#draft-image", "img => img.complete && img.naturalWidth > 1"))
    scene = service.call("GET", "scenes")
    now = next(s for s in scene["scenes"] if s["id"] == scene["current"])["objects"][0]
    disc = f'#goal-map [data-object="{now["name"]}"]'
    toward = "ArrowLeft" if now["position"][0] > 0 else "ArrowRight"
    before = page.get_attribute("#draft-image", "src")
    for _ in range(3):
        page.press(disc, toward)
    until(lambda: page.get_attribute("#draft-image", "src") != before)
    shifted = now["position"][0] + (-0.03 if now["position"][0] > 0 else 0.03)
    drafted = until(lambda: _near(service.call("GET", "goals/draft")["objects"][0], shifted))
    assert drafted["name"] == now["name"]
    page.fill("#draft-name", "three centimetres")
    page.click("#save-draft:not([disabled])")
    page.wait_for_selector("#composing", state="hidden", timeout=WAIT_MS)
    assert page.inner_text("#goal-name") == "three centimetres"
    kept = service.call("GET", "goals")["goals"][0]
    assert (kept["name"], kept["source"]) == ("three centimetres", "composed")
    still = next(s for s in service.call("GET", "scenes")["scenes"] if s["id"] == scene["current"])["objects"][0]
    assert still["position"] == now["position"]


def _near(entry, x):
    return entry if abs(entry["position"][0] - x) < 0.004 else None


def test_an_episode_is_cancelled_and_the_table_put_back(page, service):
    ensure_goal(service)
    page.reload()
    begin(page, {"steps": 30, "samples": 16, "horizon": 6})
    until(lambda: service.episode()["status"] == "running")
    page.click("#run-cancel")
    page.wait_for_selector("#run-idle:not([hidden])", timeout=WAIT_MS)
    assert service.episode()["status"] == "cancelled"


def ensure_goal(service):
    if not service.call("GET", "goals")["goals"]:
        service.call("POST", "goals", {"random": {"seed": 5, "moved": 1}})


def test_a_reload_a_pause_and_a_killed_service_lose_nothing(page, service):
    ensure_goal(service)
    page.reload()
    begin(page, {"steps": 30, "samples": 8, "horizon": 4})
    until(lambda: len(service.call("GET", f"episodes/{service.episode()['id']}")["steps"]) >= 2, 300)
    page.reload()
    page.wait_for_selector("#run-live:not([hidden])", timeout=WAIT_MS)
    until(lambda: page.eval_on_selector("#tiles img", "img => img.complete && img.naturalWidth === 768"))
    page.click("#run-pause")
    until(lambda: page.inner_text("#run-pause") == "Resume")
    until(lambda: service.episode()["status"] == "paused")
    path = f"episodes/{service.episode()['id']}"
    rounds = len(service.call("GET", path)["steps"])
    page.click("#run-step:not([disabled])")
    # What was under way when it was paused may have ended a round of its own before the single one.
    until(lambda: len(service.call("GET", path)["steps"]) > rounds and service.episode()["status"] == "paused")
    episode = service.call("GET", path)
    service.process.kill()
    service.process.wait()
    page.wait_for_selector('#status[data-state="lost"]', timeout=WAIT_MS)
    service.start()
    page.wait_for_selector('#status[data-state="live"]', timeout=LONG_MS)
    page.wait_for_selector("#run-idle:not([hidden])", timeout=WAIT_MS)
    after = service.call("GET", f"episodes/{episode['id']}")
    assert after["status"] == "interrupted"
    assert after["steps"][: len(episode["steps"])] == episode["steps"]
    shown = f'#episode-list li[data-episode="{episode["id"]}"]'
    until(lambda: "Interrupted" in page.inner_text(shown))


def test_one_of_two_visitors_drives(page, browser, service):
    other = browser.new_page()
    other.goto(service.url)
    other.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    take = other.get_by_role("button", name="Take over")
    take.wait_for(timeout=WAIT_MS)
    for tab in ("drive", "scenes", "estimate", "objects", "fields", "jobs"):
        controls = other.locator(f"#panel-{tab}").locator("button, input, select")
        assert controls.count() > 0
        assert set(controls.and_(other.locator(":enabled")).evaluate_all("found => found.map(e => e.id)")) <= LOOKING
    for button in ("story-run", "welcome-button", "more-pushes", "make-clip"):
        assert other.eval_on_selector(f"#{button}", "button => button.matches(':disabled')")
    assert service.call("GET", "driver")["visitors"] == 2
    take.click()
    page.get_by_role("button", name="Take over").wait_for(timeout=WAIT_MS)
    other.close()
    page.get_by_role("button", name="Take over").wait_for(state="hidden", timeout=WAIT_MS)


def test_two_runs_are_compared_side_by_side_and_one_is_run_again(page, service):
    scene = service.call("GET", "scenes")["current"]
    ran = []
    for samples in (8, 16):
        objects = service.call("POST", f"scenes/{scene}/reset")["objects"]
        poses = [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in objects]
        poses[0]["position"][0] += 0.08 if poses[0]["position"][0] < 0 else -0.08
        order = {"scene": scene, "poses": poses, "settings": {**SHORT, "steps": 1, "samples": samples}}
        ran.append(service.call("POST", "episodes", order)["id"])
        until(lambda: service.episode()["status"] == "done", LONG_MS / 1000)
    page.goto(f"{service.url}/?episode={ran[0]}")
    page.wait_for_selector("#beside-card:not([hidden])", timeout=WAIT_MS)
    page.click("#beside-card summary")
    page.wait_for_selector(f'#beside-select option[value="{ran[1]}"]', state="attached", timeout=WAIT_MS)
    page.select_option("#beside-select", ran[1])
    page.wait_for_selector("#beside:not([hidden])", timeout=WAIT_MS)
    rows = page.eval_on_selector_all(
        "#beside-rows tr", "rows => rows.map((row) => [...row.children].map((c) => c.textContent))"
    )
    assert ["Samples", "8", "16"] in rows
    assert [row[0] for row in rows] == ["Distance", "Pushes", "Time", "Ended", "Samples"]
    assert page.locator("#beside-chart canvas").count() == 1
    until(lambda: page.eval_on_selector("#beside-other", "image => image.complete && image.naturalWidth > 1"))
    fits = "card => [...card.querySelectorAll('*')].every((part) => part.getBoundingClientRect().right <= innerWidth)"
    assert page.eval_on_selector("#beside-card", fits)
    assert f"beside={ran[1]}" in page.url
    page.reload()
    page.wait_for_selector("#beside:not([hidden])", timeout=WAIT_MS)
    page.click("#run-again")
    until(lambda: page.input_value("#setting-samples") == "8")
    assert page.is_visible("#episode-settings")
    page.click("#close-shown")
    until(lambda: "beside=" not in page.url)


def test_each_round_of_several_actions_has_its_own_picture(page, service):
    scene = service.call("GET", "scenes")["current"]
    objects = service.call("POST", f"scenes/{scene}/reset")["objects"]
    poses = [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in objects]
    poses[0]["position"][0] += 0.2 if poses[0]["position"][0] < 0 else -0.2
    order = {"scene": scene, "poses": poses, "settings": {**SHORT, "steps": 8, "replan_every": 4}}
    episode = service.call("POST", "episodes", order)["id"]
    until(lambda: service.episode()["status"] == "done", LONG_MS / 1000)
    assert [step["step"] for step in service.call("GET", f"episodes/{episode}")["steps"]] == [0, 4, 8]
    page.goto(f"{service.url}/?episode={episode}&step=4")
    loaded = "img => img.complete && img.naturalWidth > 0 && new URL(img.src).pathname"
    frames = f"/api/episodes/{episode}/frames"
    until(lambda: page.eval_on_selector("#tiles img", loaded) == f"{frames}/1.png")
    assert page.inner_text("#timeline-step") == "4 / 8"
    page.press("#timeline", "ArrowRight")
    until(lambda: page.eval_on_selector("#tiles img", loaded) == f"{frames}/2.png")
    assert page.inner_text("#timeline-step") == "8 / 8"
    for part, round_ in {"goal": 2, "before": 0, "after": 2}.items():
        until(lambda: page.eval_on_selector(f"#ending-{part}", loaded) == f"{frames}/{round_}.png")  # noqa: B023


def show(page, episode):
    page.click(f"#episode-list li[data-episode='{episode}'] button:text-is('Show')", timeout=WAIT_MS)
    page.wait_for_selector(f"#shown[data-episode='{episode}']", timeout=WAIT_MS)


def finished_episode(service):
    """One that has pushed, the one that is there or a new one."""
    episodes = service.call("GET", "episodes")["episodes"]
    for episode in episodes:
        if episode["status"] == "done":
            return episode["id"]
    ensure_goal(service)
    goal = service.call("GET", "goals")["goals"][0]["id"]
    episode = service.call("POST", "episodes", {"goal": goal, "settings": {**SHORT, "despite_doubts": True}})["id"]
    until(lambda: service.episode()["status"] == "done", LONG_MS / 1000)
    return episode


def test_a_picture_that_comes_late_is_not_shown_with_another_episode(page, service):
    earlier = finished_episode(service)
    ensure_goal(service)
    goal = service.call("GET", "goals")["goals"][0]["id"]
    later = service.call("POST", "episodes", {"goal": goal, "settings": SHORT})["id"]
    service.call("DELETE", f"episodes/{later}")
    page.goto(f"{service.url}/?episode={later}")
    page.evaluate(NOTE_PICTURES)
    frames, held = f"**/episodes/{earlier}/frames/*.png?part=all", []
    page.route(frames, lambda route: held.append(route))  # Playwright takes no built-in function
    show(page, earlier)
    until(lambda: page.wait_for_timeout(50) or held)
    show(page, later)
    with page.expect_request_finished(lambda request: f"{earlier}/frames" in request.url):
        held.pop().continue_()
    page.unroute(frames)
    show(page, earlier)  # whose picture is loaded after the one that was late
    until(lambda: page.eval_on_selector("#tiles img", "image => image.complete && image.naturalWidth > 0"))
    pictures = page.evaluate("window.pictures")
    assert [earlier, True] in [[at, bool(url)] for at, url in pictures]
    assert [later, True] not in [[at, bool(url)] for at, url in pictures]


def test_whoever_chooses_another_table_sees_it_in_place_of_a_recorded_episode(page, service):
    before = service.call("GET", "scenes")["current"]
    page.goto(f"{service.url}/?episode={finished_episode(service)}")
    page.wait_for_selector("#replaying:not([hidden])", timeout=WAIT_MS)
    page.evaluate("document.getElementById('table-card').open = true")
    page.click("#another-table", timeout=WAIT_MS)
    page.wait_for_selector("#replaying", state="hidden", timeout=WAIT_MS)
    service.call("POST", f"scenes/{before}/activate")  # the goals of other tests are of that table


def test_the_method_as_published_is_chosen_in_the_settings(page, service):
    ensure_goal(service)
    page.evaluate("document.getElementById('settings-card').open = true")
    page.wait_for_selector("#episode-settings select[name=cost]", state="visible")
    page.select_option("#episode-settings select[name=method]", "paper")
    page.wait_for_selector("#episode-settings select[name=cost]", state="hidden")
    assert page.input_value("#setting-samples") == "200"
    assert page.inner_text("#settings-facts") == "as published, 200 samples, 30 pushes"
    begin(page, {"steps": 2, "samples": 8})
    settings = service.episode()["settings"]
    assert (settings["method"], settings["cost"], settings["samples"]) == ("paper", "image", 8)
    page.wait_for_selector("#settings-facts:text-is('as published, 8 samples, 2 pushes')", timeout=WAIT_MS)
    assert page.is_disabled("#episode-settings select[name=method]")
    assert page.is_disabled("#setting-samples")
    page.wait_for_selector("#shown-text:has-text('the method as published')", timeout=WAIT_MS)
    page.click("#run-cancel")
    page.wait_for_selector("#run-idle:not([hidden])", timeout=WAIT_MS)
    assert service.episode()["status"] == "cancelled"
    assert page.is_enabled("#episode-settings select[name=method]")
    page.click("#settings-defaults")
    assert page.input_value("#episode-settings select[name=method]") == "ours"


def test_distances_that_nobody_knows_are_told_so(page, service):
    ensure_goal(service)
    goal = service.call("GET", "goals")["goals"][0]["id"]
    asked = {"goal": goal, "settings": {"method": "paper", "despite_doubts": True}}
    episode = service.call("POST", "episodes", asked)
    service.call("DELETE", f"episodes/{episode['id']}")
    unknown = dict.fromkeys(("to_goal_mm", "to_goal_deg"))
    steps = [
        {"step": n, "seconds": {"plan": 2.0}, "image_cost": 0.02 - 0.01 * n, "estimate_off_mm": {}, **unknown}
        for n in range(2)
    ]
    report = service.data_dir / "collections" / episode["id"] / "report.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps({"steps": steps}))
    page.goto(f"{service.url}/?episode={episode['id']}")
    page.wait_for_selector("#chart-distance:has-text('not known: this method looks at images alone')", timeout=WAIT_MS)
    assert page.locator("#chart-cost canvas").count() == 1
    assert page.inner_text("#ending-sum").startswith("image cost 20 to 10 · 10⁻³")
    assert "not known" in page.inner_text("#ending-why")
    assert page.is_hidden("#make-clip")


def test_what_is_missing_is_told_by_the_rule_that_an_episode_goes_by(page, service):
    ensure_goal(service)
    goal = service.call("GET", "goals")["goals"][0]["id"]
    episode = service.call("POST", "episodes", {"goal": goal, "settings": SHORT})
    service.call("DELETE", f"episodes/{episode['id']}")
    one, *others = episode["objects"]
    steps = [
        {
            "step": n, "seconds": {"plan": 2.0}, "image_cost": 0.01, "estimate_off_mm": {},
            "to_goal_mm": {one: 60.0 - 51 * n, **dict.fromkeys(others, 1.0)},
            "to_goal_deg": {one: 3.488, **dict.fromkeys(others, 0.5)},
        }
        for n in range(2)
    ]  # fmt: skip
    report = service.data_dir / "collections" / episode["id"] / "report.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps({"steps": steps, "seconds": 31.4, "outcome": "out of steps", "text": "No."}))
    page.goto(f"{service.url}/?episode={episode['id']}")
    page.wait_for_selector("#ending-rule:has-text('within 8 mm and 3.4°')", timeout=WAIT_MS)
    assert page.inner_text("#ending-sum").startswith("6.0 cm to 9.0 mm, 0 pushes, 31 s")
    label = next(o["label"] for o in service.call("GET", "objects")["objects"] if o["name"] == one)
    missing = f"{label} is still 9.0 mm away and turned by 3.5°."
    page.wait_for_selector(f"#ending-why:text-is('{missing}')", timeout=WAIT_MS)
