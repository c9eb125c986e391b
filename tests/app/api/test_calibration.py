"""Calibrating a camera over REST: photos of the board one by one, and what they tell each time."""

import io

import numpy as np
import pytest
from PIL import Image

from osfcore.experiments.board_views import board_photograph
from osfcore.geometry.cameras import Camera
from tests.app.api.test_photos import ANY, gray, refuses
from tests.support.boards import SIZE, K, tilted

TILTS = ((35, 0), (-35, 10), (0, 38), (5, -36))
ON_TABLE = Camera.look_at("photo", (0.3, -0.25, 0.35), (0.05, 0.0, 0.0)).T_world_camera


def png_of(T_world_camera, seed):
    view = board_photograph(np.random.default_rng(seed), SIZE, camera=(T_world_camera, K))
    data = io.BytesIO()
    Image.fromarray(view.image).save(data, "PNG")
    return data.getvalue()


@pytest.fixture(scope="module")
def pictures():
    """Of the tilted board, and of the board on the table."""
    return [png_of(tilted(tilt).inverse(), n) for n, tilt in enumerate(TILTS)], png_of(ON_TABLE, 9)


def send(service, data, name):
    answer = service.post("/api/calibration/photos", content=data, headers=ANY, params={"name": name})
    assert answer.status_code == 200, answer.text
    return answer.json()


def assess(service, **body):
    answer = service.post("/api/calibration", json=body)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_camera_is_calibrated_photo_by_photo_and_takes_a_photo_of_the_table(service, pictures):
    boards, table = pictures
    seen = [send(service, data, f"board{n}.png") for n, data in enumerate(boards)]
    assert (seen[0]["width"], seen[0]["height"], seen[0]["name"], len(seen[0]["corners"])) == (*SIZE, "board0.png", 15)
    told = [assess(service, photos=[each["id"] for each in seen[: n + 1]]) for n in range(len(seen))]
    assert "number of photos of the board is 1" in told[0]["missing"]
    assert told[-1]["missing"] == ""
    errors = [each["camera"]["expected_error_mm"]["mean"] for each in told]
    assert errors[-1] < errors[0]
    assert "30 to 45 degrees" in told[0]["next"]["words"]
    on_table = send(service, table, "table.png")
    done = assess(service, photos=[each["id"] for each in seen], table=on_table["id"], name="phone")
    camera = done["camera"]
    assert np.abs(np.array(camera["T_world_camera"]) - ON_TABLE.matrix()).max() < 2e-3
    assert np.abs(np.array(camera["K"]) - K).max() < 3
    moved = assess(service, photos=[each["id"] for each in seen], table=on_table["id"], place={"x_m": 0.1})
    assert moved["camera"]["T_world_camera"][0][3] == pytest.approx(camera["T_world_camera"][0][3] + 0.1)

    photo = service.post("/api/photos", content=table, headers=ANY).json()
    path = f"/api/photos/{photo['id']}"
    taken = service.patch(path, json={"focal_px": None, "camera": camera}).json()
    assert taken["focal_source"] == "given"
    assert taken["focal_px"] == pytest.approx(camera["K"][0][0], abs=0.01)
    assert any("the one that was calibrated" in note for note in taken["notes"])
    other = {**camera, "width": SIZE[1], "height": SIZE[0]}
    refuses(service.patch(path, json={"focal_px": None, "camera": other}), 422, "size of the photo")
    skewed = {**camera, "K": [[1, 2], [3]]}
    refuses(service.patch(path, json={"focal_px": None, "camera": skewed}), 422, "3 x 3 finite numbers")
    service.delete(path)


def test_what_shows_no_board_or_is_not_there_is_told(service, pictures):
    answer = service.post("/api/calibration/photos?name=wall.png", content=gray(640, 480), headers=ANY)
    refuses(answer, 422, "wall.png cannot be used: ")
    refuses(service.post("/api/calibration/photos", content=b"a text", headers=ANY), 422, "no picture")
    refuses(service.post("/api/calibration/photos", json={}), 415, "photo")
    refuses(service.post("/api/calibration", json={"photos": ["gone"]}), 422, "no such photo of the board")
    refuses(service.post("/api/calibration", json={"photos": []}), 422, "number of photos of the board is 0")
    same = send(service, pictures[0][0], "one.png")["id"]
    refuses(service.post("/api/calibration", json={"photos": [same, same]}), 422, "it shows the same as one.png")
