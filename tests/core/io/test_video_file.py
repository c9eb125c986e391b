"""MP4 files as others read them: where their index is, which colours they say they have, and which they show."""

import importlib.util
import resource

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from osfcore.errors import CannotWrite, InvalidInput
from osfcore.extras import MissingExtra
from osfcore.io.video_file import mp4_at_once
from tests.support.errors import about

COLOURS = np.array([[220, 30, 30], [30, 200, 40], [30, 40, 220], [230, 220, 40], [220, 40, 210], [250, 250, 250]])


def stripes(width, height):
    return np.ascontiguousarray(np.broadcast_to(COLOURS.repeat(width // 6, axis=0), (height, width, 3)), np.uint8)


def write(path, images, *options):
    height, width = images[0].shape[:2]
    with mp4_at_once(path, width, height, 5, "-crf", "12", *options) as put:
        for image in images:
            put(image)


def atoms(content):
    """Names of the outermost parts of an MP4, in their order."""
    at, names = 0, []
    while at < len(content):
        names.append(content[at + 4 : at + 8].decode())
        at += int.from_bytes(content[at : at + 4], "big")
    return names


@pytest.mark.parametrize(("width", "height"), [(96, 64), (768, 416), (1920, 1080)])
def test_the_index_comes_first_and_colours_are_named_and_kept(tmp_path, width, height):
    path, image = tmp_path / "video.mp4", stripes(width, height)
    write(path, [image] * 3)
    content = path.read_bytes()
    assert [name for name in atoms(content) if name in ("moov", "mdat")] == ["moov", "mdat"]
    # ISO/IEC 14496-12: primaries, transfer and matrix are 1, BT.709; values from 16 on, not the full range.
    assert b"colrnclx" + bytes([0, 1, 0, 1, 0, 1, 0]) in content
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == 5
    shown = video.read()[1][height // 2, width // 12 :: width // 6, ::-1]
    video.release()
    assert np.abs(shown.astype(int) - COLOURS).max() <= 4  # with the matrix of BT.601 up to 27


@pytest.fixture
def no_ffmpeg(monkeypatch, tmp_path):
    """Neither the extra video nor an ffmpeg on the path; a folder that is on the path."""
    found = importlib.util.find_spec
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name == "imageio_ffmpeg" else found(name))
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


def test_what_is_missing_is_told(no_ffmpeg):
    with pytest.raises(MissingExtra, match=r"osf-manipulation\[video\]"):
        write(no_ffmpeg / "video.mp4", [stripes(96, 64)])
    assert list(no_ffmpeg.iterdir()) == []


def test_an_ffmpeg_on_the_path_serves_as_well(no_ffmpeg):
    (no_ffmpeg / "ffmpeg").symlink_to(imageio_ffmpeg.get_ffmpeg_exe())
    write(no_ffmpeg / "video.mp4", [stripes(96, 64)])
    assert "moov" in atoms((no_ffmpeg / "video.mp4").read_bytes())


def test_an_image_of_another_size_or_kind_makes_no_video(tmp_path):
    for wrong in (stripes(96, 32), stripes(96, 64).astype(np.float32)):
        with pytest.raises(InvalidInput, check=about("image of a video")):
            write(tmp_path / "video.mp4", [stripes(96, 64), wrong])
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_at_the_end_is_told_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "video.mp4"
    path.write_text("old")
    noise = np.random.default_rng(0).integers(0, 256, (3, 64, 96, 3), dtype=np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(CannotWrite, check=about("video.mp4")):
            write(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]
