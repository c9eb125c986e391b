"""Take the pictures of the page that stand in README and docs: `python docs/pictures.py http://127.0.0.1:8000`.

It wants a service that runs (`make demo`), Chromium, and the packages of `make dev`.
"""

import io
import os
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

DOCS = Path(__file__).parent
CHROMIUM = os.environ.get("OSF_CHROMIUM") or shutil.which("chromium") or "/usr/bin/chromium"
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
WIDE = {"width": 1440, "height": 900}
DRAWN_MS = 700  # in which the 3D view follows the timeline, without a GPU
FRAMES_A_STEP = 2
FRAME_MS, LAST_MS = 90, 2000
SHOWN_WIDTH = 760


def shot(page: Page, selector: str | None = None) -> Image.Image:
    """What the page shows now, or a part of it."""
    png = page.locator(selector).screenshot() if selector else page.screenshot()
    return Image.open(io.BytesIO(png)).convert("RGB")


def go_to(page: Page, at_s: float) -> None:
    """Put the recording to a moment."""
    page.eval_on_selector("#timeline", "(e, at) => { e.value = at; e.dispatchEvent(new Event('input')); }", at_s)
    page.wait_for_timeout(DRAWN_MS)


def record(page: Page) -> None:
    """The recorded episode with which the page opens, as a moving picture, and the page in the middle of it."""
    end = float(page.get_attribute("#timeline", "max") or 0)
    steps = int(page.inner_text("#timeline-step").split("/")[1])
    count = FRAMES_A_STEP * steps
    frames = []
    for number in range(count + 1):
        go_to(page, end * number / count)
        if number == round(0.4 * count):
            shot(page).save(DOCS / "dashboard.webp", quality=86, method=6)
        frame = shot(page, ".viewer")
        frames.append(
            frame.resize((SHOWN_WIDTH, round(SHOWN_WIDTH * frame.height / frame.width)), Image.Resampling.LANCZOS)
        )
    durations = [FRAME_MS] * count + [LAST_MS]
    frames[0].save(
        DOCS / "episode.webp", save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=80, method=6
    )


def find_in_photo(page: Page) -> None:
    """The sample photo; on the left what was found in it, drawn."""
    page.click("#tab-photo")
    page.click("#sample-photo")  # marked already, so the search begins at once
    page.wait_for_selector("#photo-result", timeout=600_000)
    page.eval_on_selector("#photo-wipe-at", "e => { e.value = 55; e.dispatchEvent(new Event('input')); }")
    page.wait_for_timeout(DRAWN_MS)
    shot(page).crop((0, 50, 1440, 606)).save(DOCS / "tutorials" / "photo.webp", quality=80, method=6)


def main(url: str) -> None:
    """Write them."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = browser.new_page(viewport=WIDE, color_scheme="light", reduced_motion="reduce")
        page.goto(url)
        page.wait_for_selector("#viewer:visible")
        page.wait_for_timeout(15_000)
        if not page.is_visible("#story-run"):
            sys.exit("The page shows an episode that runs; take the pictures when it has ended.")
        record(page)
        find_in_photo(page)
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1])
