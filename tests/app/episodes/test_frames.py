import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.episodes.frames import COLUMNS, HEIGHT, TILE_PX, WIDTH, frame, part_of, read_frame, read_frames, write_video
from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.geometry.workspace import STEP_S
from osfcore.io.image_file import to_uint8, write_png
from tests.support.errors import about

BAR_PX = HEIGHT // 2 - TILE_PX


def images(count, side=TILE_PX, seed=0):
    return np.random.default_rng(seed).random((count, side, side, 3))


def tile(picture, row, column):
    top = row * HEIGHT // 2 + BAR_PX
    return picture[top : top + TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]


def flat(value):
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


@given(side=st.integers(16, 400), wide=st.integers(16, 400), views=st.integers(0, 6))
def test_every_frame_has_the_size_that_the_video_has(side, wide, views):
    image = np.zeros((side, wide, 3))
    picture = frame(image, image, image, np.zeros((views, side, wide, 3)), "step 1 of 2")
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert HEIGHT % 16 == WIDTH % 16 == 0


def test_every_image_has_its_place():
    goal, now, rendered, *views = images(6)
    picture = frame(goal, now, rendered, np.array(views), "now")
    above = [goal, now, rendered, np.clip(3 * np.abs(rendered - goal), 0, 1)]
    for column, image in enumerate(above):
        np.testing.assert_array_equal(tile(picture, 0, column), to_uint8(image))
    for column, image in enumerate(views):
        np.testing.assert_array_equal(tile(picture, 1, column), to_uint8(image))
    assert len(np.unique(tile(picture, 1, COLUMNS - 1))) == 1  # no fourth camera


def test_what_looks_like_the_goal_differs_nowhere():
    goal, now = images(2, 64)
    assert not tile(frame(goal, now, goal, images(4, 64), ""), 0, 3).any()


def test_four_cameras_are_shown():
    goal, views = images(1)[0], images(6, seed=1)
    few, many = (frame(goal, goal, goal, views[:count], "") for count in (4, 6))
    np.testing.assert_array_equal(few, many)


def test_words_stand_above_the_tiles():
    plain, titled = (frame(*images(3, 64), images(4, 64), title) for title in ("", "step 7 of 30"))
    changed = np.argwhere((plain != titled).any(axis=2))
    assert len(changed)
    assert changed[:, 0].max() < BAR_PX
    assert (changed[:, 1] // TILE_PX == 1).all()


@pytest.mark.parametrize("count", [1, 6])
def test_a_video_holds_every_frame_in_order(tmp_path, count):
    path = tmp_path / "video.mp4"
    values = np.linspace(20, 230, count)
    write_video(path, (flat(value) for value in values))
    video = cv2.VideoCapture(str(path))
    seen = [picture for is_there, picture in iter(video.read, (False, None)) if is_there]
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(1 / STEP_S)
    video.release()
    assert [picture.shape for picture in seen] == [(HEIGHT, WIDTH, 3)] * count
    np.testing.assert_allclose([picture.mean() for picture in seen], values, atol=4)
    assert list(tmp_path.iterdir()) == [path]


def test_browsers_know_the_format(tmp_path):
    write_video(tmp_path / "video.mp4", [flat(90)] * 3)
    content = (tmp_path / "video.mp4").read_bytes()
    assert content[4:8] == b"ftyp"
    assert b"avc1" in content


def test_a_video_that_could_not_be_made_leaves_the_old_one(tmp_path):
    def frames():
        yield flat(0)
        raise KeyError("frame")

    (tmp_path / "video.mp4").write_text("old")
    with pytest.raises(KeyError):
        write_video(tmp_path / "video.mp4", frames())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("wrong", [flat(0)[:16], flat(0)[..., :2], flat(0).astype(np.float32)])
def test_a_frame_of_another_size_makes_no_video(tmp_path, wrong):
    with pytest.raises(OsfError):
        write_video(tmp_path / "video.mp4", [flat(0), wrong])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("count", [1, 30])
@pytest.mark.parametrize("folder", ["missing", "file"])
def test_a_place_that_takes_nothing_is_told_in_one_sentence(tmp_path, capfd, folder, count):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, check=about("video.mp4")):
        write_video(tmp_path / folder / "video.mp4", [flat(0)] * count)
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_parts_of_a_frame_are_its_pictures_without_captions():
    goal, now, rendered, *views = images(6)
    picture = frame(goal, now, rendered, np.array(views), "step 7 of 30")
    difference = np.clip(3 * np.abs(rendered - goal), 0, 1)
    for part, image in (("goal", goal), ("now", now), ("estimate", rendered), ("difference", difference)):
        np.testing.assert_array_equal(part_of(picture, part), to_uint8(image))
    np.testing.assert_array_equal(part_of(picture, "all"), picture)


def test_a_frame_comes_back_from_its_file(tmp_path):
    picture = frame(*images(3), images(4), "step 1 of 2")
    write_png(tmp_path / "000.png", picture)
    np.testing.assert_array_equal(read_frame(tmp_path / "000.png"), picture)


def test_frames_come_back_by_number_one_at_a_time(tmp_path):
    for number in (0, 2, 10, 999, 1000):
        write_png(tmp_path / f"{number:03d}.png", flat(number % 251))
    write_png(tmp_path / ".003.png", flat(3))
    (tmp_path / "notes.txt").write_text("x")
    frames = read_frames(tmp_path)
    assert next(frames).max() == 0
    (tmp_path / "002.png").unlink()  # the next one is read when it is asked for
    with pytest.raises(CorruptFile, check=about("002.png")):
        next(frames)
    assert [picture.max() for picture in read_frames(tmp_path)] == [0, 10, 999 % 251, 1000 % 251]
    assert list(read_frames(tmp_path / "none")) == []


@pytest.mark.parametrize("content", [b"", b"no image", "cut", "small", None])
def test_what_is_no_frame_is_told(tmp_path, content):
    path = tmp_path / "000.png"
    write_png(
        path, flat(0)[:16] if content == "small" else to_uint8(np.random.default_rng(0).random((HEIGHT, WIDTH, 3)))
    )
    if content == "cut":
        path.write_bytes(path.read_bytes()[:30])
    elif content is None:
        path.unlink()
    elif content != "small":
        path.write_bytes(content)
    with pytest.raises(CorruptFile, check=about("000.png")):
        read_frame(path)
