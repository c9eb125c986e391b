"""What the process that looks at photographs answers, called directly."""

import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from app.processes.messages.photo_messages import FindMask, Mark, ReadPhoto, Stroke
from app.processes.photo_process import PhotoRefused, carry_out
from osfcore.errors import InvalidInput
from tests.support.errors import about

BOX = (150, 100, 250, 180)  # of a red rectangle on gray
WIDTH, HEIGHT = 400, 300


def picture(kind="PNG", size=(WIDTH, HEIGHT)):
    rng = np.random.default_rng(0)
    pixels = np.full((HEIGHT, WIDTH, 3), 120, np.uint8) + rng.integers(0, 8, (HEIGHT, WIDTH, 3), np.uint8)
    left, top, right, bottom = BOX
    pixels[top:bottom, left:right] = (190, 30, 40)
    data = io.BytesIO()
    Image.fromarray(pixels).resize(size).save(data, kind, quality=95)
    return data.getvalue()


@pytest.mark.slow
def test_a_photo_without_a_board_tells_its_size_and_that_its_camera_is_assumed():
    read = carry_out(ReadPhoto(picture(size=(4000, 3000))))
    assert (read.width, read.height, read.sent_width) == (2048, 1536, 4000)
    assert (read.source, read.T_world_camera) == ("assumed", None)
    assert any("focal length" in note for note in read.notes)
    assert Image.open(io.BytesIO(read.jpeg)).size == (2048, 1536)


@pytest.mark.slow
def test_a_given_focal_length_is_in_pixels_of_the_photo_as_it_was_sent():
    read = carry_out(ReadPhoto(picture(size=(4000, 3000)), focal_px=3000.0))
    assert read.source == "given"
    assert read.K[0][0] == pytest.approx(3000 * 2048 / 4000)


def test_a_photo_of_the_board_tells_the_camera():
    from osfcore.photo.board import Board

    board = Image.fromarray(np.where(Board().image(), 255, 0).astype(np.uint8)).convert("RGB").resize((660, 440))
    paper = Image.new("RGB", (1000, 750), (160, 150, 140))
    paper.paste(board, (170, 155))
    data = io.BytesIO()
    paper.save(data, "PNG")
    read = carry_out(ReadPhoto(data.getvalue(), focal_px=1000.0))
    assert read.T_world_camera is not None
    height_m = 1000.0 * Board().size_m[0] / 660  # from straight above
    np.testing.assert_allclose(read.T_world_camera.position, [0, 0, height_m], atol=0.01)


def test_what_is_no_photo_is_refused_in_a_sentence():
    with pytest.raises(PhotoRefused):
        carry_out(ReadPhoto(b"To whom it may concern"))
    with pytest.raises(InvalidInput, check=about("focal length")):
        carry_out(ReadPhoto(picture(), focal_px=1.0))


def masked(mark):
    found = carry_out(FindMask(picture("JPEG"), mark))
    return cv2.imdecode(np.frombuffer(found.png, np.uint8), cv2.IMREAD_GRAYSCALE) > 127, found.outline


def test_a_box_and_a_click_find_the_object_and_its_outline():
    left, top, right, bottom = BOX
    mask, outline = masked(Mark((left - 8, top - 8, right + 8, bottom + 8), ((200.0, 140.0),)))
    truth = np.zeros_like(mask)
    truth[top:bottom, left:right] = True
    assert (mask & truth).sum() / (mask | truth).sum() > 0.95
    drawn = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(drawn, [np.round(np.array(line)).astype(np.int32) for line in outline], 1)
    assert (drawn.astype(bool) ^ mask).sum() < 0.03 * mask.sum()


def test_an_outline_that_misses_its_box_is_doubted_until_it_is_painted():
    left, top, right, bottom = BOX
    far = (left - 8.0, top - 8.0, right + 1.2 * (right - left), bottom + 8.0)
    wide = Mark(far, ((left + 20.0, 140.0),))
    assert "width" in carry_out(FindMask(picture("JPEG"), wide)).doubt
    painted = replace(wide, strokes=(Stroke(True, 3.0, ((left + 20.0, 140.0),)),))
    assert carry_out(FindMask(picture("JPEG"), painted)).doubt == ""
    close = Mark((left - 4.0, top - 4.0, right + 4.0, bottom + 4.0))
    assert carry_out(FindMask(picture("JPEG"), close)).doubt == ""


def test_the_last_stroke_of_the_brush_counts():
    left, top, right, bottom = BOX
    box = (left - 8.0, top - 8.0, right + 8.0, bottom + 8.0)
    line = ((left - 4.0, 140.0), (left - 4.0, 170.0))
    added, _ = masked(Mark(box, ((200.0, 140.0),), (), (Stroke(False, 3.0, line), Stroke(True, 3.0, line))))
    taken, _ = masked(Mark(box, ((200.0, 140.0),), (), (Stroke(True, 3.0, line), Stroke(False, 3.0, line))))
    assert added[155, left - 4]
    assert not taken[155, left - 4]
