import cv2
import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.inspection.contact_sheet import Comparison, contact_sheet, image_grid
from osfcore.io.image_file import to_uint8, write_png
from osfcore.metrics.image_errors import dilated, psnr, ssim
from tests.support.errors import about


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return np.stack([0.5 + 0.5 * np.sin(u / 3 + v / 7), 0.5 + 0.4 * np.cos(u * v / 200), (u + v) / 112], axis=-1)


def test_psnr_is_minus_20_log10_of_an_even_difference_within_the_mask():
    truth = np.zeros((8, 8, 3))
    for difference in (0.5, 0.1, 1 / 255):
        assert psnr(truth, truth + difference) == pytest.approx(-20 * np.log10(difference), abs=1e-4)
    image, mask = truth.copy(), np.zeros((8, 8), bool)
    image[0, 0], mask[0, :4] = 0.1, True
    assert psnr(truth, image, mask) == pytest.approx(20 - 10 * np.log10(1 / 4))
    assert psnr(truth, image) == pytest.approx(20 - 10 * np.log10(1 / 64))
    assert psnr(truth, image, ~mask) == 100  # equal images, instead of infinity


@pytest.mark.wrong_arrays
def test_an_empty_mask_and_other_shapes_are_refused():
    for mask in (np.zeros((48, 64), bool), np.ones((64, 48), bool)):
        with pytest.raises(InvalidInput, check=about("mask")):
            psnr(smooth(), smooth(), mask)
    with pytest.raises(InvalidInput, check=about("shape")):
        psnr(smooth(), smooth()[1:])
    with pytest.raises(InvalidInput):
        ssim(smooth(10, 64), smooth(10, 64))


def test_ssim_is_that_of_wang_with_a_gaussian_window():
    worse = np.clip(0.5 * smooth()[::-1] + 0.25, 0, 1)
    assert ssim(smooth(), worse) == pytest.approx(0.2657732736, abs=1e-9)  # by scikit-image 0.26.0 with those settings
    a, b = np.full((16, 16, 3), 0.3), np.full((16, 16, 3), 0.6)  # flat: the luminance term alone
    assert ssim(a, b) == pytest.approx((2 * 0.3 * 0.6 + 1e-4) / (0.3**2 + 0.6**2 + 1e-4))
    assert ssim(smooth(), smooth()) == pytest.approx(1)


def test_a_mask_grows_by_two_pixels_in_every_direction():
    mask, expected = np.zeros((2, 11, 12), bool)
    mask[5, 6], expected[3:8, 4:9] = True, True
    np.testing.assert_array_equal(dilated(mask), expected)
    np.testing.assert_array_equal(dilated(mask, 0), mask)


def test_a_sheet_shows_truth_ours_and_the_difference_four_times(tmp_path):
    truth, ours = to_uint8(np.full((32, 40, 3), 0.5)), to_uint8(np.full((32, 40, 3), 0.6))
    truth[..., 0] += 1
    ours[..., 0] += 1  # colours are kept apart
    sheet = contact_sheet([Comparison("a name that is far too long", truth, ours)] * 3, per_row=2)
    top, left = sheet.shape[0] // 2 - 3 * 32, sheet.shape[1] - 2 * 40
    for row, value in enumerate((truth[0, 0], ours[0, 0], 4 * 25)):
        assert np.all(sheet[top + 32 * row :, left:][:32] == value)
    assert np.all(sheet[-32:, left + 40 :] == 255)  # three columns: the last block is half empty
    assert np.any(sheet[:top, left : left + 40] < 100)  # the label
    assert np.any(sheet[top : top + 32, :left] < 100)  # the row's name
    write_png(tmp_path / "new" / "sheet.png", sheet)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "sheet.png"))[..., ::-1], sheet)
    for columns in ([], [Comparison("", truth, ours), Comparison("", truth[:16], ours[:16])]):
        with pytest.raises(InvalidInput):
            contact_sheet(columns)


def test_a_grid_shows_each_image_in_its_place():
    rows = {f"row {n}": [np.full((20, 30, 3), 40 * n + 10 * m, np.uint8) for m in range(3)] for n in range(2)}
    grid = image_grid(rows, ["a", "b", "c"])
    top, left = grid.shape[0] - 2 * 20, grid.shape[1] - 3 * 30
    for n, images in enumerate(rows.values()):
        for m, image in enumerate(images):
            np.testing.assert_array_equal(grid[top + 20 * n :, left + 30 * m :][:20, :30], image)
    assert np.any(grid[:top] < 100)  # names of columns
    assert np.any(grid[top:, :left] < 100)  # and of rows
    black = np.zeros((20, 20, 3), np.uint8)
    for wrong in ({}, {"a": [black]}, {"a": [black, black], "b": [black]}, {"a": [black, black[1:]]}):
        with pytest.raises(InvalidInput):
            image_grid(wrong, ["x", "y"])
