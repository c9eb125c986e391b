from dataclasses import replace

import numpy as np

from osfcore.fields.visual_hull import carve
from osfcore.geometry.cameras import Camera, default_cameras
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.inspection.overlays import object_colour, observation_sheet, overlay_sheet
from osfcore.io.image_set import read_image_set

MAGENTA, YELLOW, WHITE = (255, 0, 255), (0, 255, 255), (255, 255, 255)
AXES = ((0, 0, 255), (0, 255, 0), (255, 0, 0))
TILE = 384


def sets_of(image_set):
    return read_image_set(image_set, "train"), read_image_set(image_set, "test")


def count(image, colour) -> int:
    """Pixels of about a colour: lines are anti-aliased."""
    return int((np.abs(image.astype(int) - colour).max(axis=-1) < 60).sum())


def test_box_axes_and_light_are_drawn_around_the_object(image_set):
    sets = sets_of(image_set)
    sheet = overlay_sheet(sets, carve(*sets).box)
    assert sheet.shape == (512, 1024, 3)
    assert all(count(sheet, colour) > 100 for colour in (MAGENTA, YELLOW, *AXES))
    for drawn in sheet.reshape(2, 256, 4, 256, 3).swapaxes(1, 2).reshape(8, 256, 256, 3):
        blue, green, red = np.moveaxis(drawn.astype(int), -1, 0)
        box = np.argwhere((green < 60) & (blue > 150) & (red > 150))
        is_object = (red > 1.3 * blue) & (red > green) & (green > 10)
        low, high = np.percentile(np.argwhere(is_object), (2, 98), axis=0)
        assert np.all((low >= box.min(axis=0)) & (high <= box.max(axis=0)))


def test_lines_that_pass_the_camera_are_cut_and_fewer_images_than_tiles_and_no_box_are_fine(image_set):
    around_cameras = np.array([[-0.1, -9, -9], [0.1, 9, 9]])  # all edges from +y to -y pass the cameras
    assert count(overlay_sheet(sets_of(image_set), around_cameras), MAGENTA) > 500
    images = sets_of(image_set)[1]
    few = replace(images, **{name: getattr(images, name)[:2] for name in ("cameras", "light_directions", "rgba")})
    sheet = overlay_sheet((few,), None)
    assert sheet.shape == (256, 1024, 3)
    assert not sheet[:, 512:].any()
    assert count(sheet, MAGENTA) == 0


def observation(cameras=None, names=("a", "b")) -> Observation:
    cameras = default_cameras(64) if cameras is None else cameras
    shape = (len(cameras), cameras[0].height, cameras[0].width)
    masks = np.zeros((shape[0], len(names), *shape[1:]), bool)
    masks[0, 0, 30:50, 10:20] = True
    return Observation(cameras, np.full((*shape, 3), 0.3, np.float32), names, masks, np.array([0.1, 0, 0.062]), 0.0)


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
    bare = observation_sheet(replace(made, masks=None, pusher=None))
    assert count(bare, object_colour(0)) == count(bare, YELLOW) == 0


def test_strange_views_are_drawn_too():
    away = Camera.look_at("\u00e9" * 100, (0.6, 0, 0.5), (2, 0, 0.5), size=16)
    sheet = observation_sheet(observation((away,), ("\u4e2d" * 50,)))
    assert sheet.shape == (TILE, TILE, 3)
    assert count(sheet, (0, 0, 255)) > 20  # says that the table is behind the camera
    flat = replace(default_cameras(64)[0], width=1024, height=16)
    assert observation_sheet(observation((flat,))).shape == (16, TILE, 3)
    cameras = tuple(replace(default_cameras(64)[0], name=str(i)) for i in range(6))
    assert observation_sheet(observation(cameras)).shape == (2 * TILE, 4 * TILE, 3)
