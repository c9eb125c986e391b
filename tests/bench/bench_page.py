"""How soon a visitor sees something and reaches what they came for, and what an open page costs. Run alone.

python -m tests.bench.bench_page [--data-dir DIR] [--visits 3]
"""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from app.storage.paths import default_data_dir
from tests.bench.machine import machine
from tests.e2e.conftest import CHROMIUM, FLAGS
from tests.live import live_service

STORY_S, RUN_S, SETTLE_S, REST_S, TURN_S = 12, 12, 25, 20, 8
PATIENCE_S = 300
# Notes when texts of the page change, by its own clock: asking from outside would take time from what is measured.
WATCH = """
window.marks = [];
document.addEventListener("DOMContentLoaded", () => {
  const everything = { attributes: true, childList: true, characterData: true, subtree: true };
  const watch = (id, tell) => {
    const node = document.getElementById(id);
    new MutationObserver(() => marks.push([tell(node), performance.now()])).observe(node, everything);
  };
  watch("story-foot", (node) => `story ${!node.hidden}`);
  watch("run-stage", (node) => node.textContent);
  watch("goal-check-text", (node) => `check ${node.textContent}`);
  document.getElementById("story-run").addEventListener("click", () => marks.push(["run", performance.now()]));
});
"""


# Counts the pictures of the 3D view: its client draws one for each call of the browser.
FRAMES = """
window.drawn = 0;
for (const kind of ["drawArrays", "drawElements"]) {
  const natively = WebGL2RenderingContext.prototype[kind];
  let last = 0;
  WebGL2RenderingContext.prototype[kind] = function draw(...args) {
    const now = document.timeline.currentTime;
    if (now !== last) drawn += kind === "drawElements";
    last = now;
    return natively.apply(this, args);
  };
}
"""


@dataclass(frozen=True)
class Arguments:
    """What to measure with."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are; nothing is written there."""
    visits: int = 3
    """First visits, each to a service of its own."""


def first(marks: list[tuple[str, float]], begins: str, after_ms: float = 0.0) -> float:
    """When a text that begins so came first [s], from `after_ms` on."""
    return next((at - after_ms) / 1000 for text, at in marks if text.startswith(begins) and at >= after_ms)


def marks_of(page: Page) -> list[tuple[str, float]]:
    """What was noted so far."""
    return [(text, at) for text, at in page.evaluate("marks")]


def visit(browser: Browser, url: str, folder: Path) -> tuple[float, float, float]:
    """Seconds until the story is on view, from "Run this live" to the first push, and until a photo is judged."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    page.add_init_script(WATCH)
    page.goto(url)
    page.wait_for_timeout(1000 * STORY_S)
    page.click("#story-run")
    page.wait_for_timeout(1000 * RUN_S)
    marks = marks_of(page)
    begun = next(at for text, at in marks if text == "run")
    story_s, push_s = first(marks, "story true"), first(marks, "Pushing", begun)
    page.click("#run-cancel")
    page.wait_for_selector("#run-idle:not([hidden])")
    Image.new("RGB", (3000, 2000), "white").save(folder / "blank.png")
    before = page.evaluate("performance.now()")
    page.set_input_files("#goal-file", folder / "blank.png")
    page.wait_for_timeout(5000)
    check_s = first(marks_of(page), "check Nothing can be seen", before)
    page.context.close()
    return story_s, push_s, check_s


class Hand:
    """Counts what a person does on a page of their own, and the seconds since they began.

    Args:
        browser: whose page it is.
        url: of the service.
    """

    def __init__(self, browser: Browser, url: str) -> None:
        self.page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
        self.page.add_init_script("sessionStorage.setItem('osf-story-seen', '1')")
        self.page.set_default_timeout(1000 * PATIENCE_S)
        self.page.goto(url)
        self.page.wait_for_selector("#poses tr", state="attached")
        self.clicks, self._began = 0, time.monotonic()

    def click(self, what: str) -> None:
        """Click something once it is there."""
        self.page.click(what)
        self.clicks += 1

    def reached(self, what: str) -> str:
        """Wait for something to show; returns clicks and seconds so far."""
        self.page.wait_for_selector(what)
        return f"{self.clicks} clicks, {time.monotonic() - self._began:.1f} s"


def ways(browser: Browser, url: str, folder: Path) -> Iterator[str]:
    """Clicks and seconds from an open page to what somebody came for."""
    hand = Hand(browser, url)
    with hand.page.expect_response(lambda answer: answer.request.method == "POST" and answer.url.endswith("/scenes")):
        hand.click("#another-table")
    hand.page.wait_for_timeout(1000)  # as long as a person takes to look
    hand.click("#random-goal")
    hand.click("#start-episode:not([disabled])")
    yield f"random table, first push: {hand.reached('#run-stage >> text=Pushing')}"
    yield f"random table, over: {hand.reached('#ending:not([hidden])')} ({hand.page.inner_text('#shown-outcome')})"
    hand.page.context.close()
    hand = Hand(browser, url)
    hand.click("#push-nearest")
    yield f"a push predicted: {hand.reached('#push-execute:not([hidden])')}"
    hand.page.context.close()
    hand = Hand(browser, url)
    hand.click("#tab-photo")
    hand.click("#sample-photo")
    yield f"sample photo, objects found: {hand.reached('#photo-result:not([hidden])')}"
    hand.page.context.close()
    trimesh.creation.box((0.05, 0.07, 0.12)).export(folder / "box.glb")
    hand = Hand(browser, url)
    hand.page.set_input_files("#own-object-file", folder / "box.glb")  # dropped anywhere
    hand.clicks += 1
    hand.click("#new-object [type=submit]")
    hand.click("button:has-text('Put it on the table')")
    hand.click("button:has-text('Push it')")
    with hand.page.expect_response(lambda answer: answer.url.endswith("/actions")):
        hand.page.keyboard.press("Enter")
    yield f"own mesh, first push by hand: {hand.reached('#pad')}"
    hand.page.context.close()


def frames(browser: Browser, url: str) -> float:
    """Pictures a second of the 3D view while somebody turns it."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.add_init_script(FRAMES)
    page.goto(url)
    page.click("#back-to-live", timeout=30_000)
    page.wait_for_timeout(1000 * SETTLE_S)
    view = next(frame for frame in page.frames if "/viewer/" in frame.url)
    box = page.locator("#viewer").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + 20
    page.mouse.move(x, y)
    page.mouse.down()
    before, began = view.evaluate("drawn"), time.monotonic()
    while time.monotonic() - began < TURN_S:
        passed = time.monotonic() - began
        page.mouse.move(x + 100 * np.sin(passed), y)
    rate = (view.evaluate("drawn") - before) / (time.monotonic() - began)
    page.mouse.up()
    page.close()
    return rate


def cpu_seconds(parent: int) -> Counter[str]:
    """Processor time of the browser, and of the service and its children [s]."""
    ticks: Counter[str] = Counter()
    for place in Path("/proc").glob("[0-9]*"):
        try:
            command = (place / "cmdline").read_text()
            numbers = (place / "stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        who = "browser" if "chromium" in command else "service" if parent in (int(place.name), int(numbers[1])) else ""
        ticks[who] += int(numbers[11]) + int(numbers[12])
    return Counter({who: count / os.sysconf("SC_CLK_TCK") for who, count in ticks.items() if who})


def rest(browser: Browser, url: str) -> dict[str, float]:
    """Cores that an open page takes while nothing moves."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(url)
    page.click("#back-to-live", timeout=30_000)
    page.wait_for_timeout(1000 * SETTLE_S)
    service = next(
        int(place.name)
        for place in Path("/proc").glob("[0-9]*")
        if f"--port\0{url.rsplit(':', 1)[1]}" in (place / "cmdline").read_text()
    )
    before = cpu_seconds(service)
    time.sleep(REST_S)
    after = cpu_seconds(service)
    page.close()
    return {who: (after[who] - before[who]) / REST_S for who in ("browser", "service")}


@contextmanager
def service(objects: Path) -> Iterator[tuple[str, Path]]:
    """A service that nobody has visited yet, and a folder."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder)
        (data_dir / "objects").symlink_to(objects.resolve())
        with live_service(data_dir) as url:
            time.sleep(8)  # what it prepares for its first visitor
            yield url, data_dir


def main() -> None:
    """Measure and print."""
    arguments = tyro.cli(Arguments)
    print(machine())
    times: list[tuple[float, float, float]] = []
    with sync_playwright() as playwright:
        browser: Any = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        for _ in range(arguments.visits):
            with service(arguments.data_dir / "objects") as (url, folder):
                times.append(visit(browser, url, folder))
        with service(arguments.data_dir / "objects") as (url, _):
            cores = rest(browser, url)
            rate = frames(browser, url)
        with service(arguments.data_dir / "objects") as (url, folder):
            for line in ways(browser, url, folder):
                print(line, flush=True)
        browser.close()
    for text, values in zip(
        ("story on view", "run to first push", "blank photo refused"), np.transpose(times), strict=True
    ):
        print(f"{text}: " + ", ".join(f"{value:.2f}" for value in values) + " s")
    print(f"3D view while it is turned: {rate:.1f} pictures a second")
    print("at rest: " + ", ".join(f"{who} {share:.3f} cores" for who, share in cores.items()))


if __name__ == "__main__":
    main()
