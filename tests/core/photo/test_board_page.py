import re

import numpy as np
import pytest

from osfcore.photo.board import RULER_M, Board, board_pdf, page_image

DOT_M = 0.0254 / 600
BOARDS = [Board(), Board(7, 5, 0.036, 0.027, "DICT_5X5_50"), Board(8, 6, 0.0322, 0.0241)]


def edges(line):
    return np.flatnonzero(np.diff(line.astype(int))) + 1


def test_pdf_is_a_page_of_a4_in_landscape_and_small():
    pdf = board_pdf(Board())
    (box,) = re.findall(rb"/MediaBox \[ ?([\d. ]+)\]", pdf)
    millimetres = np.array(box.split(), float) / 72 * 25.4
    np.testing.assert_allclose(millimetres, (0, 0, 297, 210), atol=0.1)
    assert (b"/Width 7016" in pdf, b"/Height 4961" in pdf) == (True, True)
    assert len(pdf) < 300_000


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_board_has_its_exact_size_in_the_middle_of_the_page(board):
    page = page_image(board, 1 / DOT_M)
    np.testing.assert_allclose(np.array(page.shape[::-1]) * DOT_M, (0.297, 0.21), atol=5e-5)
    centre = np.array([0.297, 0.21]) / 2
    at = (centre + board.corners_m() * (1, -1)) / DOT_M
    inside = 0.04 * board.square_m / DOT_M
    for x, y in at[:: len(at) - 1]:  # the first and the last corner: colours change exactly there
        across = page[round(y - inside), round(x - inside) : round(x + inside)]
        down = page[round(y - inside) : round(y + inside), round(x - inside)]
        assert edges(across) + round(x - inside) == pytest.approx([x], abs=1)
        assert edges(down) + round(y - inside) == pytest.approx([y], abs=1)
    rows, columns = (np.flatnonzero(~page.all(axis=axis)) * DOT_M for axis in (1, 0))
    assert rows[0] > 0.008
    assert columns[0] > 0.008
    assert columns[-1] < 0.297 - 0.008


def test_ruler_is_100_mm_long_and_does_not_touch_the_board():
    page = page_image(Board(), 1 / DOT_M)
    below = page[round((0.105 + 0.088 + 0.001) / DOT_M) :]
    longest = max(np.diff(edges(row))[::2].max() for row in below if not row.all())  # runs of ink between two edges
    assert longest * DOT_M == pytest.approx(RULER_M, abs=4e-4)
