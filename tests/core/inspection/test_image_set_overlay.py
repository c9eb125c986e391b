import numpy as np

from osfcore.fields.visual_hull import carve
from osfcore.inspection.overlays import overlay_sheet
from osfcore.io.image_set import read_image_set
from tests.core.fields.sets import turn_cameras

MAGENTA, YELLOW = (255, 0, 255), (0, 255, 255)


def sheet_of(image_set, box=None):
    sets = (read_image_set(image_set, "train"), read_image_set(image_set, "test"))
    return overlay_sheet(sets, carve(*sets).box if box is None else box)


def count(sheet, colour):
    return np.all(sheet == colour, axis=-1).sum()


def test_box_axes_and_light_are_drawn_around_the_object(image_set):
    sheet = sheet_of(image_set)
    assert sheet.shape == (512, 1024, 3)
    for colour in (MAGENTA, YELLOW, (0, 0, 255), (0, 255, 0), (255, 0, 0)):
        assert count(sheet, colour) > 100
    for row in range(2):
        for column in range(4):
            tile = sheet[256 * row : 256 * (row + 1), 256 * column : 256 * (column + 1)].astype(int)
            is_object = (tile[..., 2] > 1.3 * tile[..., 0]) & (tile[..., 2] > tile[..., 1]) & (tile[..., 1] > 10)
            ys, xs = np.nonzero(is_object)
            box_ys, box_xs = np.nonzero((tile[..., 1] < 60) & (tile[..., 0] > 150) & (tile[..., 2] > 150))
            assert np.percentile(xs, 2) >= box_xs.min()
            assert np.percentile(xs, 98) <= box_xs.max()
            assert np.percentile(ys, 2) >= box_ys.min()
            assert np.percentile(ys, 98) <= box_ys.max()


def test_a_wrong_convention_is_seen(image_set):
    turn_cameras(image_set, lambda RT: np.diag([1, -1, -1]) @ RT)
    sheet = sheet_of(image_set, np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]]))
    assert count(sheet, MAGENTA) == 0
    assert count(sheet, (0, 0, 255)) > 100  # the words


def test_lines_that_pass_the_camera_are_cut(image_set):
    around_cameras = np.array([[-0.1, -9, -9], [0.1, 9, 9]])  # all edges from +y to -y pass the cameras
    sheet = sheet_of(image_set, around_cameras).astype(int)
    is_magenta = (sheet[..., 0] > 200) & (sheet[..., 2] > 200) & (sheet[..., 1] < 100)
    assert is_magenta.sum() > 500


def test_fewer_images_than_tiles_and_no_box_are_fine(image_set):
    images = read_image_set(image_set, "test")
    few = type(images)(images.cameras[:2], images.light_directions[:2], images.rgba[:2])
    sheet = overlay_sheet((few,), None)
    assert sheet.shape == (256, 1024, 3)
    assert not sheet[:, 512:].any()
    assert count(sheet, MAGENTA) == 0
