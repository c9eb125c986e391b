"""Neural pictures as a person sees them. The table's field is exact, and the cracker box counts as a matte box."""

import io
import json
import shutil
import urllib.request

import numpy as np
import pytest
from PIL import Image

from app.viewer.nodes.room import VIEW_FOV_RAD, framing
from app.viewer.nodes.scene_nodes import extent_m
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.processes.fields import write_box, write_exact_table
from tests.e2e.conftest import show_part, watch_errors
from tests.e2e.test_page import WAIT_MS, wait_until
from tests.live import live_service

pytestmark = pytest.mark.e2e
BOX = "003_cracker_box"
COMPILE_S = 180  # the first time on a machine
DRAW_S = 60  # 3D in software, on a busy machine
WINDOW_PX = 60
LATE_MS = 1000


@pytest.fixture(scope="module")
def url(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    write_exact_table(data_dir)
    write_box(data_dir, BOX, library.size_m(BOX), (0.4, 0.1, 0.08))
    with live_service(data_dir) as url:
        call(url, "scenes", {"seed": 1, "objects": [BOX], "light": {"position": [0.2, -0.3, 1]}})
        yield url


@pytest.fixture
def page(browser, url):
    page = browser.new_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.set_default_timeout(1000 * DRAW_S)
    page.problems = []
    watch_errors(page)
    page.on("console", lambda m: page.problems.append(m.text) if m.type == "error" else None)
    page.goto(url)
    page.wait_for_selector('#status[data-state="live"]', timeout=WAIT_MS)
    page.wait_for_selector("#poses tr", state="attached", timeout=WAIT_MS)
    yield page
    page.close()


def call(url, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{url}/api/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.load(answer)


def decibels(page):
    return [float(text.removesuffix("dB")) for text in page.locator("#camera-strip .psnr").all_inner_texts() if text]


def shot(page):
    """What the 3D view shows, 8-bit RGB."""
    return np.asarray(Image.open(io.BytesIO(page.locator("#viewer").screenshot())).convert("RGB")).astype(int)


def table_colour(page):
    """Of the table's front part, in the middle: the fields' pictures are linear, and darker than the meshes."""
    image = shot(page)
    height, width, _ = image.shape
    return np.median(image[int(0.78 * height) : int(0.82 * height), int(0.3 * width) : int(0.4 * width)], axis=(0, 1))


def seen_at(point_m, scene, library, width, height):
    """Where a point of the world is in the 3D view of a table that was framed [px]."""
    things = scene["objects"]
    poses = Pose(np.array([one["position"] for one in things]), np.array([one["quaternion"] for one in things]))
    light, pusher = Light(np.array(scene["light"]["position"])), np.array(scene["pusher"]["position"])
    seen = extent_m(SceneState(tuple(one["name"] for one in things), poses, light, pusher), library)
    position, look_at = framing(seen, VIEW_FOV_RAD, width / height)
    view = Camera.look_at("view", position, look_at, size=height, fov_y_deg=np.rad2deg(VIEW_FOV_RAD))
    return view.project(np.array(point_m)) + [(width - height) / 2, 0]


def pusher_centre(image, scene, library):
    """Where the pusher is in a picture of the 3D view, by its colour [px]."""
    height, width, _ = image.shape
    at = seen_at(scene["pusher"]["position"], scene, library, width, height)
    left, top = np.round(at).astype(int) - WINDOW_PX
    window = image[top : top + 2 * WINDOW_PX, left : left + 2 * WINDOW_PX]
    red, green, blue = np.moveaxis(window, -1, 0)
    rows, columns = np.nonzero((blue > 1.5 * red) & (blue > 1.05 * green) & (blue > 40))
    assert len(rows) > 100
    return np.array([columns.mean(), rows.mean()])


def test_camera_images_stand_beside_what_the_fields_render(page, url):
    page.check("#compare")
    wait_until(lambda: len(decibels(page)) == 5, COMPILE_S)
    assert min(decibels(page)) > 20
    assert page.is_visible(".part.rendered >> nth=0")
    assert not page.is_visible('img[data-camera="0"]')
    assert "difference" in page.inner_text("#cameras-hint")
    page.click("#camera-strip button >> nth=1")
    wait_until(lambda: page.evaluate("document.getElementById('compare-large').naturalWidth") == 3 * 384, DRAW_S)
    assert float(page.inner_text("#compare-dialog-title").split()[-2]) > 20
    page.keyboard.press("Escape")
    before = page.get_attribute(".part.rendered >> nth=0", "src")
    show_part(page, "drive")
    page.fill("#elevation", "20")
    wait_until(lambda: page.get_attribute(".part.rendered >> nth=0", "src") != before, DRAW_S)
    page.uncheck("#compare")
    assert page.is_visible('img[data-camera="0"]')
    assert decibels(page) == []
    assert page.problems == []


def test_a_comparison_that_arrives_after_it_was_switched_off_is_not_shown(page):
    page.evaluate(f"""() => {{
        const read = Response.prototype.blob;
        Response.prototype.blob = async function () {{
            window.arriving = true;
            await new Promise((done) => setTimeout(done, {LATE_MS}));
            return read.call(this);
        }};
    }}""")
    page.check("#compare")
    page.wait_for_function("() => window.arriving", timeout=1000 * COMPILE_S)
    page.uncheck("#compare")
    page.wait_for_timeout(2 * LATE_MS)
    assert decibels(page) == []
    assert page.problems == []


def test_the_neural_render_lies_where_the_meshes_were(page, url, library):
    view = page.frame_locator("#viewer")
    view.locator("canvas").first.wait_for()
    listed = call(url, "scenes")
    scene = next(scene for scene in listed["scenes"] if scene["id"] == listed["current"])
    page.click("#frame-view")
    wait_until(lambda: table_colour(page).min() > 60, DRAW_S)
    page.wait_for_timeout(1000)
    colour, meshes = table_colour(page), pusher_centre(shot(page), scene, library)
    page.click("text=Neural fields")
    wait_until(lambda: np.all(colour - table_colour(page) > 15), COMPILE_S)
    page.wait_for_timeout(2000)  # until it is sharp
    rendered = pusher_centre(shot(page), scene, library)
    assert np.abs(rendered - meshes).max() < 2
    page.click("text=Meshes")
    wait_until(lambda: np.all(np.abs(colour - table_colour(page)) < 3), DRAW_S)
    assert np.abs(pusher_centre(shot(page), scene, library) - meshes).max() < 0.5


def test_an_object_without_a_field_is_named_under_the_cameras(page, url):
    bare = "035_power_drill"
    if bare in [field["name"] for field in call(url, "fields")["fields"]]:
        pytest.skip("every object has a field")
    call(url, "scenes", {"seed": 1, "objects": [BOX, bare]})
    wait_until(lambda: page.locator("#poses tr").count() == 2)
    page.check("#compare")
    wait_until(lambda: bare in page.inner_text("#cameras-hint"), COMPILE_S)
    page.uncheck("#compare")
    page.problems.clear()  # the browser notes the refusals
