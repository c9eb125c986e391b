from dataclasses import replace

import numpy as np

from osfcore.geometry.cameras import Camera, default_cameras
from osfcore.geometry.states import MAX_OBJECTS, Observation
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.inspection.overlays import object_colour, observation_sheet

WHITE, YELLOW, AXES = (255, 255, 255), (0, 255, 255), ((0, 0, 255), (0, 255, 0), (255, 0, 0))
TILE = 384


def observation(cameras=None, names=("a", "b")) -> Observation:
    cameras = default_cameras(64) if cameras is None else cameras
    shape = (len(cameras), cameras[0].height, cameras[0].width)
    masks = np.zeros((shape[0], len(names), *shape[1:]), bool)
    masks[0, 0, 30:50, 10:20] = True
    return Observation(cameras, np.full((*shape, 3), 0.3, np.float32), names, masks, np.array([0.1, 0, 0.062]), 0.0)


def count(image, colour) -> int:
    """Pixels of about a colour: lines are anti-aliased."""
    return int((np.abs(image.astype(int) - colour).max(axis=-1) < 60).sum())


def tile(sheet, number):
    return sheet[:, TILE * number : TILE * (number + 1)]


def test_axes_workspace_pusher_and_masks_are_drawn_where_they_are():
    made = observation()
    sheet = observation_sheet(made)
    assert sheet.shape == (TILE, 4 * TILE, 3)
    for number in range(4):
        for colour in (*AXES, YELLOW, WHITE):
            assert count(tile(sheet, number), colour) > 20
        corner = made.cameras[number].resized(TILE, TILE).project(np.array([WORKSPACE_HALF_M, WORKSPACE_HALF_M, 0]))
        x, y = np.round(corner).astype(int)
        assert count(tile(sheet, number)[y - 3 : y + 4, x - 3 : x + 4], WHITE) > 0
    rows, columns = np.nonzero(np.all(tile(sheet, 0)[180:] == object_colour(0), axis=-1))
    assert (rows.min() + 180, columns.min(), columns.max()) == (180, 60, 119)  # six times as large as the mask
    assert rows.max() + 180 == 299
    assert count(sheet, object_colour(1)) == 0


def test_what_is_not_known_is_not_drawn():
    made = observation()
    bare = observation_sheet(replace(made, masks=None, pusher=None))
    assert count(bare, object_colour(0)) == count(bare, YELLOW) == 0
    assert count(bare, WHITE) > 0


def test_objects_have_colours_of_their_own():
    colours = [object_colour(number) for number in range(MAX_OBJECTS)]
    assert len({*colours, *AXES, WHITE, YELLOW}) == MAX_OBJECTS + 5


def test_strange_views_are_drawn_too():
    away = Camera.look_at("\u00e9" * 100, (0.6, 0, 0.5), (2, 0, 0.5), size=16)
    sheet = observation_sheet(observation((away,), ("\u4e2d" * 50,)))
    assert sheet.shape == (TILE, TILE, 3)
    assert count(sheet, (0, 0, 255)) > 20  # says that the table is behind the camera
    flat = replace(default_cameras(64)[0], width=1024, height=16)
    assert observation_sheet(observation((flat,))).shape == (16, TILE, 3)
    cameras = tuple(replace(default_cameras(64)[0], name=str(i)) for i in range(6))
    assert observation_sheet(observation(cameras)).shape == (2 * TILE, 4 * TILE, 3)
