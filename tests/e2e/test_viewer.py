"""Each picture that the 3D view draws, as it changes from one table to another, and what hands drag in it."""

import io
import json
import shutil
import urllib.request

import numpy as np
import pytest
from PIL import Image

from app.episodes.trajectory import read_trajectory
from app.services.examples import Stories
from app.viewer.nodes.room import AT
from tests.e2e.conftest import watch_errors
from tests.e2e.test_episodes import until
from tests.e2e.test_neural import seen_at
from tests.live import live_service

pytestmark = pytest.mark.e2e
WAIT_MS = 20_000
DRAW_S = 60.0  # in software, on a busy machine
FLAT = [1.0, 0.0, 0.0, 0.0]
BARE = 1 * 48 + 4  # a spot in the near left corner of the view, on which nothing lies
# Keeps a grid of colours of every picture, read in the same breath in which it was drawn.
WATCH = """() => {
  if (!location.pathname.startsWith("/viewer/")) return;
  const natively = window.requestAnimationFrame.bind(window);
  window.drawn = [];
  const read = () => {
    const gl = [...document.querySelectorAll("canvas")].find((canvas) => canvas.height > 99)?.getContext("webgl2");
    if (!gl) return;
    const [w, h, n] = [gl.drawingBufferWidth, gl.drawingBufferHeight, 48];
    const all = new Uint8Array(4 * w * h);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, all);
    const at = (i, j) => 4 * (Math.floor((j + 0.5) * h / n) * w + Math.floor((i + 0.5) * w / n));
    const grid = [];
    for (let j = 0; j < n; j += 1) for (let i = 0; i < n; i += 1) grid.push([...all.slice(at(i, j), at(i, j) + 3)]);
    if (grid.some((colour) => Math.max(...colour))) window.drawn.push(grid);
  };
  window.requestAnimationFrame = (callback) => natively((now) => { callback(now); read(); });
}"""


@pytest.fixture(scope="module")
def service(library, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("data")
    shutil.copytree(library.root, data_dir / "objects")
    with live_service(data_dir) as url:
        yield url


def call(service, method, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{service}/api/{path}", data, {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def table(service, name, x, light):
    pose = {"name": name, "position": [x, 0.0, 0.12], "quaternion": FLAT}
    return call(service, "POST", "scenes", {"poses": [pose], "light": {"position": light}})


@pytest.fixture
def view(browser, service):
    """The 3D view of a page, on its own."""
    page = browser.new_page(viewport={"width": 800, "height": 600})
    page.problems = []
    watch_errors(page)
    page.add_init_script(f"({WATCH})()")
    page.goto(f"{service}/viewer/watched/?hideViserLogo")
    yield page
    page.close()
    assert page.problems == []


FEW = 16  # spots


def drawn(view):
    """Colours (P, G, 3) of the pictures since this was asked for last."""
    return np.array(view.evaluate("window.drawn.splice(0)"), int).reshape(-1, 48 * 48, 3)


def settled(view, is_there):
    """The pictures (P, G, 3) until there is one as it shall be."""
    pictures = []
    until(lambda: pictures.extend(drawn(view)) or (pictures and is_there(pictures[-1][None])[0]), DRAW_S)
    return np.array(pictures)


def has_bottle(pictures):
    """Whether much is yellow; a little of the box is."""
    red, green, blue = np.moveaxis(pictures, -1, 0)
    return ((green > 0.85 * red) & (red > 90) & (blue < 0.5 * red)).sum(1) > FEW


def has_box(pictures):
    """Whether much is red; handles are pink, and a little of the bottle is brown."""
    red, green, blue = np.moveaxis(pictures, -1, 0)
    return ((green < 0.4 * red) & (red > 70) & (blue < 0.4 * red)).sum(1) > FEW


def has_bottle_alone(pictures):
    return has_bottle(pictures) & ~has_box(pictures)


def has_box_alone(pictures):
    return has_box(pictures) & ~has_bottle(pictures)


def test_a_new_table_is_drawn_without_what_was_on_the_one_before(service, view):
    table(service, "006_mustard_bottle", -0.15, [0.0, -0.3, 0.95])
    before = settled(view, has_bottle_alone)[-1]
    table(service, "003_cracker_box", 0.2, [0.5, 0.0, 0.3])
    pictures = settled(view, has_box_alone)
    is_lit_anew = np.abs(pictures[:, BARE] - before[BARE]).max(axis=-1) > 15
    assert is_lit_anew[-1]
    assert not has_bottle(pictures[is_lit_anew]).any()


def test_the_table_stays_lit_between_a_recording_and_the_live_table(service, view):
    light = read_trajectory(Stories().trajectory("first")).states[0].light
    table(service, "003_cracker_box", 0.2, light.position.tolist())
    lit = settled(view, has_box_alone)[-1][BARE]
    call(service, "PUT", "views/watched", {"replay": {"story": "first", "at_s": 0.0}})
    pictures = [*settled(view, has_bottle_alone)]
    call(service, "PUT", "views/watched", {"replay": None})
    pictures += [*settled(view, has_box_alone)]
    assert np.abs(np.array(pictures)[:, BARE] - lit).max() <= 5


def drag(view, *spots):
    """Take hold of something at the first spot, once it can be taken there, and let it go at the last."""

    def is_over_it():
        view.mouse.move(*spots[0] + [1, 1])
        view.mouse.move(*spots[0])
        return view.evaluate("[...document.querySelectorAll('canvas')].some((c) => c.style.cursor === 'pointer')")

    until(is_over_it, DRAW_S)
    view.mouse.down()
    for spot in spots[1:]:
        view.mouse.move(*spot, steps=4)
    view.mouse.up()


def is_yellow(view, spot):
    column, row = np.round(spot).astype(int)
    red, green, blue = np.asarray(Image.open(io.BytesIO(view.screenshot())).convert("RGB"), int)[row, column]
    return min(red, green) > 1.5 * blue


def test_the_lamp_and_the_copies_of_a_goal_are_dragged(service, view, library):
    name, near_px = "009_gelatin_box", 6
    scene = table(service, name, -0.1, [-0.3, -0.2, 0.9])

    def seen(point):
        return seen_at([point], scene, library, 800, 600)[0]

    def lamp():
        return AT * np.array(call(service, "GET", f"scenes/{scene['id']}")["light"]["position"])

    def copy():
        return np.array(call(service, "GET", "goals/draft")["objects"][0]["position"])

    until(lambda: is_yellow(view, seen(lamp())), DRAW_S)  # the camera stands where this table fills the view
    spot = np.array([300.0, 150.0])
    drag(view, seen(lamp()), spot)
    until(lambda: np.linalg.norm(seen(lamp()) - spot) < near_px)

    call(service, "POST", "goals/draft", {"scene": None})
    aside = {"name": name, "position": [-0.05, 0.1, 0.016], "quaternion": FLAT}
    call(service, "PATCH", "goals/draft", {"objects": [aside]})
    at, spot = seen(aside["position"]), np.array([500.0, 400.0])
    drag(view, at, spot)
    until(lambda: np.linalg.norm(seen(copy()) - spot) < near_px)
