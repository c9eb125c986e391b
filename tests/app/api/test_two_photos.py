"""Two photos of one table with the printed board: how it is, and how it should be."""

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


def looked_at(service, jpeg, boxes, name):
    """The photo, sent, marked and looked at."""
    photo = service.post("/api/photos", content=jpeg, headers=ANY, params={"name": name}).json()
    assert photo["on_board"], photo["notes"]
    for each, box in boxes.items():
        assert mark(service, photo, each, box).status_code == 200
    path = f"/api/photos/{photo['id']}"
    service.post(f"{path}/find", json={})
    found = until(
        lambda: (now := service.get(path).json())["job"]["state"] not in ("queued", "running") and now, WAIT_S
    )
    assert found["job"]["state"] == "done", found["job"]["error"]
    assert found["table"] == "board"
    return path


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
    before, after = (looked_at(service, *photo, name) for photo, name in zip(photos, ("now", "then"), strict=True))
    table = service.post(f"{before}/table", json={"despite_doubts": True}).json()["scene"]
    made = service.post(f"{after}/goal", json={"despite_doubts": True}).json()
    assert made["scene"]["id"] == table["id"]
    start, goal = table["objects"], made["goal"]["objects"]
    moves = {name: np.linalg.norm((place(goal, name) - place(start, name))[:2]) for name in NAMES}
    assert moves[BOX] < 0.012
    assert moves[CAN] == pytest.approx(np.linalg.norm(MOVED_M), abs=0.015)
    for path in (before, after):
        service.delete(path)
