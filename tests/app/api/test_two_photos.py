"""Two photos of one table: how it is and how it should be, with the printed board; and from two sides, without one."""

import cv2
import numpy as np
import pytest

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.photo.board import Board
from osfcore.world.imaging import TableSurface
from osfcore.world.physics import lowest_point
from osfcore.world.scenes import Conditions
from osfcore.world.tabletop import Tabletop
from tests.app.api.test_photos import ANY, WAIT_S, box_around, jpeg_of, mark
from tests.app.conftest import until

BOX, CAN = NAMES = ("003_cracker_box", "005_tomato_soup_can")
SIDE, TEXELS = 1024, 4096
MOVED_M = np.array([0.06, -0.05])
pytestmark = pytest.mark.slow


def table_with_board():
    """A table of one colour with the board printed on its middle."""
    texture = np.full((TEXELS, TEXELS, 3), 0.35, np.float32)
    per_m = TEXELS / TABLE_SIDE_M
    columns, rows = (round(side * per_m) for side in Board().size_m)
    ink = cv2.resize(Board().image().astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    top, left = (TEXELS - rows) // 2, (TEXELS - columns) // 2
    texture[top : top + rows, left : left + columns] = (0.03 + 0.8 * ink)[..., None]
    return Conditions(table=TableSurface(texture=texture))


def standing(library, name, x, y):
    upright = np.array([1.0, 0, 0, 0])
    return Pose(np.array([x, y, -lowest_point(library.load(name), upright)]), upright)


def photograph(world, library, places, camera):
    """JPEG of a layout, and boxes around its objects."""
    poses = [standing(library, name, *places[name]) for name in NAMES]
    stacked = Pose(np.array([p.position for p in poses]), np.array([p.quaternion for p in poses]))
    world.load(SceneState(NAMES, stacked, Light(np.array([0.2, -0.3, 1.0])), None))
    seen = world.render((camera,), masks=True, with_pusher=False)
    boxes = {name: box_around(mask) for name, mask in zip(NAMES, seen.masks[0], strict=True)}
    return jpeg_of(np.clip(seen.images[0], 0, 1)), boxes


def sent(service, jpeg, boxes, name, focal_px=None):
    """The path of a photo that was sent and marked."""
    params = {"name": name} if focal_px is None else {"name": name, "focal_px": focal_px}
    photo = service.post("/api/photos", content=jpeg, headers=ANY, params=params).json()
    for each, box in boxes.items():
        assert mark(service, photo, each, box).status_code == 200
    return f"/api/photos/{photo['id']}"


def found(service, path, together=()):
    """What is found in a photo, and in others of the same table."""
    answer = service.post(f"{path}/find", json={"together": [other.rpartition("/")[2] for other in together]})
    assert answer.status_code == 202, answer.text
    photo = until(
        lambda: (now := service.get(path).json())["job"]["state"] not in ("queued", "running") and now, WAIT_S
    )
    assert photo["job"]["state"] == "done", photo["job"]["error"]
    return photo


def place(objects, name):
    return np.array(next(entry["position"] for entry in objects if entry["name"] == name))


def test_what_moved_between_two_photos_is_what_has_to_move(service, library):
    camera = Camera.look_at("phone", np.array([0.1, -0.62, 0.6]), np.array([0.0, 0.03, 0.03]), size=SIDE)
    now = {BOX: (-0.14, 0.2), CAN: (0.17, 0.17)}
    then = {**now, CAN: tuple(np.array(now[CAN]) + MOVED_M)}
    world = Tabletop(library, conditions=table_with_board())
    try:
        photos = [photograph(world, library, places, camera) for places in (now, then)]
    finally:
        world.close()
    before, after = (sent(service, *photo, name) for photo, name in zip(photos, ("now", "then"), strict=True))
    for path in (before, after):
        assert service.get(path).json()["on_board"]
        assert found(service, path)["table"] == "board"
    table = service.post(f"{before}/table", json={"despite_doubts": True}).json()["scene"]
    made = service.post(f"{after}/goal", json={"despite_doubts": True}).json()
    assert made["scene"]["id"] == table["id"]
    start, goal = table["objects"], made["goal"]["objects"]
    moves = {name: np.linalg.norm((place(goal, name) - place(start, name))[:2]) for name in NAMES}
    assert moves[BOX] < 0.012
    assert moves[CAN] == pytest.approx(np.linalg.norm(MOVED_M), abs=0.015)
    for path in (before, after):
        service.delete(path)


def test_two_photos_without_a_board_are_looked_at_together(service, library):
    eyes = (np.array([0.1, -0.62, 0.5]), np.array([0.5, -0.3, 0.45]))
    cameras = [Camera.look_at("phone", eye, np.array([0.0, 0.0, 0.04]), size=640) for eye in eyes]
    places = {BOX: (-0.07, 0.03), CAN: (0.09, -0.05)}
    world = Tabletop(library, conditions=Conditions())
    try:
        photos = [photograph(world, library, places, camera) for camera in cameras]
    finally:
        world.close()
    focal = float(cameras[0].intrinsics[0, 0])
    paths = [sent(service, *photo, f"side {k}", focal) for k, photo in enumerate(photos)]
    assert service.get(paths[0]).json()["marked"] == list(NAMES)
    photo = found(service, paths[0], paths[1:])
    assert photo["table"] == "objects"
    poses = {each["name"]: each["found"]["poses"][0] for each in photo["objects"]}
    apart = np.linalg.norm(np.subtract(*(poses[name]["position"] for name in NAMES))[:2])
    assert apart == pytest.approx(np.linalg.norm(np.subtract(places[BOX], places[CAN])), abs=0.015)
    assert all(each["found"]["outline"] for each in photo["objects"])
    assert all(pose["probability"] > 0.8 for pose in poses.values())
    for path in paths:
        service.delete(path)
