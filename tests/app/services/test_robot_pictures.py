import threading

import numpy as np
import pytest

from app.services.robot import NoPicture, RobotPictures
from osfcore.errors import OsfError
from osfcore.geometry.cameras import default_cameras
from osfcore.io.image_file import encode_jpeg
from osfcore.photo.read_photograph import read_photograph

CAMERAS = default_cameras(64)
FILES = (encode_jpeg(np.full((64, 64, 3), 90, np.uint8)),) * len(CAMERAS)


def of(take, may_look=True):
    return RobotPictures(
        lambda: CAMERAS, take, lambda file: read_photograph(file).eight_bit, lambda: may_look, lambda: None, fresh_s=0.0
    )


def test_nobody_waits_for_a_robot_that_takes_its_time_who_can_be_shown_what_was_seen_before():
    begun, may_end = threading.Event(), threading.Event()
    may_end.set()

    def take():
        begun.set()
        assert may_end.wait(20)
        return FILES

    pictures = of(take)
    before = pictures.one("0")
    begun.clear()
    may_end.clear()
    slow = threading.Thread(target=pictures.all)
    slow.start()
    assert begun.wait(20)
    assert pictures.one("0") == before
    may_end.set()
    slow.join()
    assert pictures.one("0").at_s > before.at_s


def test_who_comes_during_the_first_look_is_shown_it():
    begun, may_end, seen = threading.Event(), threading.Event(), []

    def take():
        begun.set()
        assert may_end.wait(20)
        return FILES

    pictures = of(take)
    both = [threading.Thread(target=lambda: seen.append(pictures.one("1"))) for _ in range(2)]
    for one in both:
        one.start()
    assert begun.wait(20)
    may_end.set()
    for one in both:
        one.join()
    assert len(seen) == 2


def test_why_there_is_no_picture_is_said():
    def take():
        raise OsfError("The lens cap is on.")

    with pytest.raises(NoPicture):
        of(take).one("2")
    with pytest.raises(NoPicture):
        of(take, may_look=False).one("2")


def test_after_a_first_look_that_failed_nobody_waits_for_the_next_one():
    begun, may_end = threading.Event(), threading.Event()
    may_end.set()

    def take():
        begun.set()
        assert may_end.wait(20)
        raise OsfError("The lens cap is on.")

    pictures = of(take)
    with pytest.raises(NoPicture):
        pictures.one("0")
    begun.clear()
    may_end.clear()
    slow = threading.Thread(target=pictures.all)
    slow.start()
    assert begun.wait(20)
    assert {now.picture for now in pictures.all()} == {None}
    may_end.set()
    slow.join()


def test_large_pictures_are_reduced():
    large = encode_jpeg(np.zeros((1200, 1600, 3), np.uint8))
    jpeg = of(lambda: (large,) * len(CAMERAS)).one("0").jpeg
    assert read_photograph(jpeg).encoded.shape == (480, 640, 3)
