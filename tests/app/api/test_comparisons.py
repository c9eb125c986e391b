import io

import numpy as np
import pytest
from PIL import Image

from tests.app.conftest import running
from tests.app.processes.fields import write_box, write_exact_table

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"


@pytest.fixture(scope="module")
def neural(library, tmp_path_factory):
    """A service that takes the cracker box for a matte box."""
    folder = tmp_path_factory.mktemp("neural")
    write_exact_table(folder)
    write_box(folder, BOX, library.size_m(BOX), (0.4, 0.1, 0.08))
    with running(library, folder) as client:
        yield client


@pytest.fixture(scope="module")
def scene(neural):
    return neural.post("/api/scenes", json={"seed": 1, "objects": [BOX], "image_size": 96}).json()["id"]


def pixels(answer):
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), float)


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["0", "1", "2", "3", "goal"])
def test_what_is_rendered_is_what_the_camera_sees(neural, scene, camera):
    answer = neural.get(f"/api/scenes/{scene}/neural/{camera}.png")
    rendered, seen = pixels(answer), pixels(neural.get(f"/api/scenes/{scene}/images/{camera}.png"))
    assert rendered.shape == (96, 96, 3)
    psnr = -10 * np.log10(np.mean((rendered - seen) ** 2) / 255**2)
    assert psnr > 21  # one colour for a printed box
    assert float(answer.headers["X-PSNR-dB"]) == pytest.approx(psnr, abs=0.1)
    assert answer.headers["cache-control"] == "no-cache"


def test_kinds_fit_together(neural, scene):
    three = pixels(neural.get(f"/api/scenes/{scene}/neural/1.png", params={"kind": "comparison", "size": 64}))
    assert three.shape == (64, 192, 3)
    seen = pixels(neural.get(f"/api/scenes/{scene}/images/1.png", params={"size": 64}))
    np.testing.assert_array_equal(three[:, :64], seen)
    for kind, columns in (("rendered", slice(64, 128)), ("difference", slice(128, 192))):
        one = pixels(neural.get(f"/api/scenes/{scene}/neural/1.png", params={"kind": kind, "size": 64}))
        np.testing.assert_array_equal(one, three[:, columns])


def test_changes_are_followed_and_the_pusher_can_be_left_out(neural, scene):
    url = f"/api/scenes/{scene}/neural/goal.png"
    before = pixels(neural.get(url))
    bare = neural.get(url, params={"pusher": False})
    assert np.abs(pixels(bare) - before).max() > 40
    assert float(bare.headers["X-PSNR-dB"]) > 24
    neural.patch(f"/api/scenes/{scene}", json={"light": {"position": [1, 0, 0.2]}})
    after = neural.get(url)
    assert pixels(after).mean() < before.mean() - 10
    assert float(after.headers["X-PSNR-dB"]) > 24


def test_an_object_without_a_field_is_named(neural, tmp_path, monkeypatch):
    scene = neural.post("/api/scenes", json={"seed": 1, "objects": [BOX, BOTTLE]}).json()["id"]
    monkeypatch.setattr(neural.app.state.services.fields, "names", lambda: (BOX,))  # not even those that are shipped
    refused = neural.get(f"/api/scenes/{scene}/neural/0.png")
    assert refused.status_code == 409
    assert refused.headers["content-type"] == "application/problem+json"
    assert BOTTLE in refused.json()["detail"]
    assert BOX not in refused.json()["detail"]
    neural.delete(f"/api/scenes/{scene}")


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("nowhere/neural/0.png", 404),
        ("{scene}/neural/9.png", 404),
        ("{scene}/neural/0.png?size=4096", 422),
        ("{scene}/neural/0.png?kind=sketch", 422),
    ],
)
def test_nonsense_is_refused(neural, scene, path, status):
    refused = neural.get(f"/api/scenes/{path.format(scene=scene)}")
    assert refused.status_code == status
    assert refused.headers["content-type"] == "application/problem+json"
