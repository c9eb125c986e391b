import os
import re
import shutil
from functools import partial
from pathlib import Path

import pytest

ARTIFACTS = Path(__file__).parents[2] / "test-artifacts"
CHROMIUM = os.environ.get("OSF_CHROMIUM") or shutil.which("chromium") or "/usr/bin/chromium"
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)


def watch_errors(page):
    """Add the page's script errors to `page.problems`."""
    page.on("pageerror", lambda error: page.problems.append(str(error)))


def page_of_someone_who_knows(new_page, **options):
    """A page on which the story is not played, as on any but the first visit."""
    page = new_page(**options)
    page.add_init_script("try { sessionStorage.setItem('osf-story-seen', '1') } catch {}")
    return page


def show_part(page, name: str):
    """Choose a part of the panel as a person does: by its tab, and by the one within that."""
    panel = page.locator(f'.panel > [role="tabpanel"]:has(#panel-{name}), .panel > #panel-{name}')
    tab = panel.get_attribute("aria-labelledby")
    page.click(f"#{tab}")
    if page.locator(f"#tab-{name}").count():
        page.click(f"#tab-{name}")


def leave_out_view(page):
    """Let an empty frame stand for the 3D view: drawn without a GPU it takes time that other parts of the page need."""
    page.route(re.compile(r"/viewer/[^/]+/\?"), lambda route: route.fulfill(content_type="text/html", body=""))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Keep a picture of the page where a test fails."""
    report = (yield).get_result()
    page = getattr(item, "funcargs", {}).get("page")
    if report.when == "call" and report.failed and page is not None:
        ARTIFACTS.mkdir(exist_ok=True)
        page.screenshot(path=ARTIFACTS / f"{item.name}.png")


@pytest.fixture(scope="session")
def browser():
    if not Path(CHROMIUM).exists():
        pytest.skip(f"Chromium is not at {CHROMIUM}; install it or set OSF_CHROMIUM")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        browser.new_page = partial(page_of_someone_who_knows, browser.new_page)
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def no_page_stays(browser):
    """Close what a test leaves open, also one that fails: while that page drives, all others only watch."""
    before = [page for context in browser.contexts for page in context.pages]
    yield
    for page in (page for context in browser.contexts for page in context.pages if page not in before):
        page.close()
