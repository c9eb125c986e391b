"""Photos of tables as a program uses them: sent, marked, looked at, made a goal and a table."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from app.storage.paths import static_folder
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import goal_camera
from tests.app.api.test_problems import is_problem
from tests.app.conftest import until

BOX, MUSTARD = "003_cracker_box", "006_mustard_bottle"
SIDE = 512
FOCAL = goal_camera(SIDE).intrinsics[0, 0]
WAIT_S = 300.0
ANY = {"Content-Type": "application/octet-stream"}


@pytest.fixture(autouse=True)
def tidy(service):
    yield
    for photo in service.get("/api/photos").json()["photos"]:
        service.delete(f"/api/photos/{photo['id']}")


def jpeg_of(linear):
    """A picture [0, 1] as a camera that people carry writes it: encoded as sRGB."""
    data = io.BytesIO()
    Image.fromarray(np.round(255 * srgb_of_linear(linear)).astype(np.uint8)).save(data, "JPEG", quality=95)
    return data.getvalue()


def box_around(mask, margin=5):
    """Left, top, right, bottom."""
    ys, xs = np.nonzero(mask)
    return [float(v) for v in (xs.min() - margin, ys.min() - margin, xs.max() + margin, ys.max() + margin)]


def picture(service, scene):
    """What the scene's goal camera sees."""
    query = {"size": SIDE, "pusher": False}
    png = service.get(f"/api/scenes/{scene['id']}/images/goal.png", params=query).content
    return jpeg_of(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255)


def carefully(service, scene, name):
    """A box, a click on the object, and some beside it, where a shadow may look like a part of it."""
    path = f"/api/scenes/{scene['id']}/masks/goal/{name}.png"
    mask = np.asarray(Image.open(io.BytesIO(service.get(path, params={"size": SIDE}).content))) > 127
    (around,), _ = cv2.findContours(cv2.dilate(mask.astype(np.uint8), np.ones((13, 13))), 0, cv2.CHAIN_APPROX_NONE)
    box = box_around(mask)
    beside = around[:: len(around) // 30, 0].astype(float).tolist()
    return {"box": box, "on": [[(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]], "off": beside}


def send(service, data, **params):
    answer = service.post("/api/photos", content=data, headers=ANY, params=params)
    assert answer.status_code == 201, answer.text
    return answer.json()


def mark(service, photo, name, marks):
    """Point at an object by a box alone, or by all that a mark may hold."""
    body = marks if isinstance(marks, dict) else {"box": marks}
    return service.put(f"/api/photos/{photo['id']}/objects/{name}", json=body)


def refuses(answer, status, words):
    """Whether a sentence with these words refuses what was asked for."""
    assert words in is_problem(answer, status)["detail"]


def gray(width=64, height=48):
    data = io.BytesIO()
    Image.new("RGB", (width, height), (120, 120, 120)).save(data, "PNG")
    return data.getvalue()


@pytest.mark.slow
def test_a_photo_is_kept_with_what_its_file_tells(service):
    photo = send(service, gray(), name="My table", focal_px=80)
    assert (photo["name"], photo["width"], photo["height"], photo["focal_px"]) == ("My table", 64, 48, 80)
    assert (photo["focal_source"], photo["on_board"], photo["objects"], photo["job"]) == ("given", False, [], None)
    assert service.get(f"/api/photos/{photo['id']}").json() == photo
    assert [entry["id"] for entry in service.get("/api/photos").json()["photos"]] == [photo["id"]]
    shown = Image.open(io.BytesIO(service.get(f"/api/photos/{photo['id']}/photo.jpg").content))
    assert shown.size == (64, 48)
    changed = service.patch(f"/api/photos/{photo['id']}", json={"focal_px": 100}).json()
    assert changed["focal_px"] == 100
    mine = "5x7,0.04,0.03,DICT_5X5_100,legacy"
    assert service.patch(f"/api/photos/{photo['id']}", json={"focal_px": 100, "board": mine}).json()["board"] == mine
    assert service.patch(f"/api/photos/{photo['id']}", json={"focal_px": 90}).json()["board"] == mine
    assert service.patch(f"/api/photos/{photo['id']}", json={"focal_px": 90, "board": ""}).json()["board"] == ""
    assert service.delete(f"/api/photos/{photo['id']}").status_code == 204
    refuses(service.get(f"/api/photos/{photo['id']}"), 404, "no such photo")


def test_a_damaged_photo_is_listed_as_such_until_it_is_deleted(service, services):
    folder = services.settings.data_dir / "photos" / "broken"
    folder.mkdir(parents=True)
    (folder / "photo.json").write_text("{")
    listed = service.get("/api/photos").json()
    assert [each["id"] for each in listed["damaged"]] == ["broken"]
    assert "broken" not in [photo["id"] for photo in listed["photos"]]
    assert "delete it" in is_problem(service.get("/api/photos/broken"), 409)["detail"]
    assert service.delete("/api/photos/broken").status_code == 204
    assert service.get("/api/photos").json()["damaged"] == []
    is_problem(service.delete("/api/photos/broken"), 404)


@pytest.mark.slow
def test_a_picture_is_kept_as_the_goal_or_the_photograph_that_it_is(service):
    scene = service.post("/api/scenes", json={"seed": 3, "objects": [BOX, MUSTARD]}).json()
    query = {"size": SIDE, "pusher": False}
    png = service.get(f"/api/scenes/{scene['id']}/images/goal.png", params=query).content
    made = service.post("/api/pictures?name=Mine", content=png, headers=ANY).json()
    assert made["photo"] is None
    assert (made["goal"]["name"], made["goal"]["source"], made["goal"]["width"]) == ("Mine", "upload", SIDE)
    service.delete(f"/api/goals/{made['goal']['id']}")
    wooden = (static_folder() / "samples" / "table.jpg").read_bytes()  # of nearly the table's hue
    for photo in (picture(service, scene), wooden):
        made = service.post("/api/pictures", content=photo, headers=ANY).json()
        assert made["goal"] is None
        assert made["photo"] == service.get(f"/api/photos/{made['photo']['id']}").json()
    refuses(service.post("/api/pictures", content=b"a text", headers=ANY), 422, "no picture that can be read")
    refuses(service.post("/api/pictures", content=b"{}", headers={"Content-Type": "application/json"}), 415, "photo")


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("photos", "image/jpeg"), ("pictures", "image/jpeg"), ("calibration/photos", "image/jpeg"),
        ("goals", "image/jpeg"), ("estimates", "application/zip"), ("fields/sets", "application/zip"),
        ("objects?name=a", "model/gltf-binary"),
    ],
)  # fmt: skip
def test_a_file_in_a_form_is_refused_with_how_to_send_it(service, path, kind):
    as_form = {"files": {"file": ("a.jpg", gray(), "image/jpeg")}}
    as_curl_sends_it = {"content": gray(), "headers": {"Content-Type": "application/x-www-form-urlencoded"}}
    for sent in (as_form, as_curl_sends_it):
        refuses(service.post(f"/api/{path}", **sent), 415, f"Content-Type: {kind}")


def test_the_board_can_be_printed(service):
    answer = service.get("/api/photos/board.pdf")
    assert answer.headers["content-type"] == "application/pdf"
    assert answer.content.startswith(b"%PDF")


def test_what_makes_no_sense_is_told(service):
    refuses(service.post("/api/photos", content=b"a text", headers=ANY), 422, "no picture that can be read")
    refuses(service.post("/api/photos", content=b"{}", headers={"Content-Type": "application/json"}), 415, "photo")
    refuses(service.post("/api/photos?focal_px=2", content=gray(), headers=ANY), 422, "focal length")
    refuses(service.post("/api/photos?board=5x7", content=gray(), headers=ANY), 422, "COLUMNSxROWS")
    refuses(service.post("/api/calibration/photos?board=5x7", content=gray(), headers=ANY), 422, "COLUMNSxROWS")
    photo = send(service, gray())
    path = f"/api/photos/{photo['id']}"
    refuses(service.post(f"{path}/find", json={}), 409, "No object is marked")
    refuses(service.post(f"{path}/goal", json={}), 409, "have not been found yet")
    refuses(service.get(f"{path}/drawing.png"), 409, "have not been found yet")
    refuses(mark(service, photo, "teapot", [5.0, 5.0, 40.0, 40.0]), 404, "teapot")
    refuses(mark(service, photo, BOX, [100.0, 5.0, 140.0, 40.0]), 422, "64 x 48")
    refuses(service.delete(f"{path}/objects/{BOX}"), 404, BOX)
    refuses(service.post(f"{path}/objects/{BOX}/choice", json={"choice": 0}), 404, BOX)
    assert service.get(path).json()["objects"] == []


def gets_a_table_whose_objects_lie_elsewhere(service, path):
    """While the table holds other objects, a goal from a photo brings a table of its own."""
    service.post("/api/scenes", json={"seed": 1, "objects": ["005_tomato_soup_can"]})
    made = service.post(f"{path}/goal", json={"despite_doubts": True}).json()
    assert made["scene"]["is_current"]
    starts = {entry["name"]: np.array(entry["position"]) for entry in made["scene"]["objects"]}
    ends = {entry["name"]: np.array(entry["position"]) for entry in made["goal"]["objects"]}
    assert set(starts) == set(ends) == {BOX, MUSTARD}
    assert max(np.linalg.norm((starts[name] - ends[name])[:2]) for name in starts) > 0.05
    for name in starts:
        assert starts[name][2] == pytest.approx(ends[name][2], abs=0.01), "it lies on the same side"


@pytest.mark.slow
def test_a_photo_becomes_a_goal_and_a_table(service):
    made = {"seed": 5, "objects": [BOX, MUSTARD], "light": {"position": [0.1, -0.1, 1.0]}}
    scene = service.post("/api/scenes", json=made).json()
    photo = send(service, picture(service, scene), name="Arranged", focal_px=FOCAL)
    path = f"/api/photos/{photo['id']}"
    for name in (BOX, MUSTARD):
        assert mark(service, photo, name, carefully(service, scene, name)).status_code == 200
    assert all(entry["outline"] for entry in service.get(path).json()["objects"])
    assert service.post(f"{path}/find", json={}).status_code == 202
    found = until(
        lambda: (now := service.get(path).json())["job"]["state"] not in ("queued", "running") and now, WAIT_S
    )
    assert found["job"]["state"] == "done", found["job"]["error"]
    assert found["table"] == "objects"
    for entry in found["objects"]:
        assert entry["found"]["poses"][0]["iou"] > 0.85  # below that an outline is doubted
        sheet = service.get(entry["found"]["poses"][0]["picture"])
        assert Image.open(io.BytesIO(sheet.content)).width > 100
    drawn = service.get(f"{path}/drawing.png")
    assert Image.open(io.BytesIO(drawn.content)).size == (SIDE, SIDE)
    goal = service.post(f"{path}/goal", json={"scene": scene["id"], "despite_doubts": True}).json()["goal"]
    assert (goal["source"], goal["scene"], goal["name"]) == ("photo", scene["id"], "Arranged")
    assert distance(goal["objects"]) == pytest.approx(distance(scene["objects"]), abs=0.03)
    table = service.post(f"{path}/table", json={"despite_doubts": True}).json()["scene"]
    assert distance(table["objects"]) == pytest.approx(distance(scene["objects"]), abs=0.03)
    gets_a_table_whose_objects_lie_elsewhere(service, path)
    choice = service.post(f"{path}/objects/{BOX}/choice", json={"choice": 0}).json()
    assert next(entry for entry in choice["objects"] if entry["name"] == BOX)["choice"] == 0
    refuses(service.post(f"{path}/objects/{BOX}/choice", json={"choice": 50}), 422, "number of the pose")
    marked = mark(service, photo, BOX, carefully(service, scene, BOX)).json()
    assert marked["job"] is None, "what was found of other marks no longer counts"
    assert all(entry["choice"] is None for entry in marked["objects"])


def distance(objects):
    first, second = (np.array(entry["position"]) for entry in objects)
    return float(np.linalg.norm((first - second)[:2]))
