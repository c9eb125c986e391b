import importlib.util
import io
import struct
import sys
import threading
import warnings
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms
from pillow_heif import register_heif_opener

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.estimation.camera_response import linear_of_srgb
from osfcore.geometry.poses import Pose
from osfcore.photo.read_photograph import (
    KEPT_SIDE,
    MIN_SIDE,
    guessed_intrinsics,
    intrinsics_from_focal,
    read_photograph,
    to_photograph,
)
from tests.support.errors import about

register_heif_opener()
DIAGONAL_MM = 43.27  # of film, to which equivalent focal lengths refer


def blocks(width=96, height=64, dtype=np.uint8, seed=0):
    """Blocks of colours, so that JPEG keeps them."""
    most = np.iinfo(dtype).max
    small = np.random.default_rng(seed).integers(0, most, (-(-height // 16), -(-width // 16), 3), dtype, endpoint=True)
    return small.repeat(16, axis=0).repeat(16, axis=1)[:height, :width]


def encoded(image, kind="PNG", **options):
    data = io.BytesIO()
    image.save(data, kind, **options)
    return data.getvalue()


def png(values, kind="PNG", **options):
    """A picture of an array, in any format of Pillow's."""
    return encoded(Image.fromarray(np.ascontiguousarray(values)), kind, **options)


def exif(orientation=None, **camera):
    data = Image.Exif()
    if orientation:
        data[ExifTags.Base.Orientation] = orientation
    for name, value in camera.items():
        data.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name]] = value
    return data.tobytes()


def sixteen_bit_png(values):
    """OpenCV writes the sixteen bits that Pillow does not."""
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[values.shape[2]]
    return cv2.imencode(".png", values[..., order])[1].tobytes()


def png_head(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")


# Pixels


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "1"])
def test_every_kind_of_png_is_understood(mode):
    image = Image.fromarray(blocks()).convert(mode)
    seen = read_photograph(encoded(image))
    np.testing.assert_array_equal(seen.encoded, np.asarray(image.convert("RGB")))
    assert seen.notes == ()


@pytest.mark.parametrize("channels", [1, 3])
def test_sixteen_bits_keep_dark_tones_apart_that_eight_cannot(channels):
    values = np.full((64, 40, channels), 1000, np.uint16) + np.arange(64, dtype=np.uint16)[:, None, None]
    raw = read_photograph(sixteen_bit_png(values))
    np.testing.assert_array_equal(raw.encoded, np.broadcast_to(values, (64, 40, 3)))
    seen = to_photograph(raw, intrinsics_from_focal(40, 64, 64.0))
    np.testing.assert_allclose(seen.image, np.broadcast_to(linear_of_srgb(values / 65535), (64, 40, 3)), rtol=1e-6)
    assert len(np.unique(raw.eight_bit)) == 1


def test_transparent_parts_are_white_and_it_is_said():
    alpha = np.repeat(np.array([0, 128, 255], np.uint8), 32)[None, :, None].repeat(64, axis=0)
    seen = read_photograph(png(np.dstack([blocks(), alpha])))
    assert len(seen.notes) == 1
    share = alpha / 255
    np.testing.assert_allclose(seen.encoded, share * blocks() + 255 * (1 - share), atol=1)
    values = np.dstack([blocks(dtype=np.uint16), np.full((64, 96), 32768, np.uint16)])
    seen = read_photograph(sixteen_bit_png(values)).encoded
    np.testing.assert_allclose(seen, (values[..., :3].astype(float) + 65535) / 2, atol=2)


@pytest.mark.parametrize("kind", ["JPEG", "HEIF", "WEBP", "AVIF", "TIFF", "BMP", "GIF"])
def test_every_usual_format_is_understood(kind):
    seen = read_photograph(png(blocks(), kind, quality=95)).encoded
    assert seen.dtype == np.uint8
    assert np.abs(seen.astype(int) - blocks()).mean() < 8


def turned_by(orientation, picture):
    """A picture as its camera would store it, were it held as EXIF's orientation says (by EXIF's own definition)."""
    return {
        1: picture,
        2: picture[:, ::-1],
        3: picture[::-1, ::-1],
        4: picture[::-1],
        5: picture.swapaxes(0, 1),
        6: np.rot90(picture),
        7: picture[::-1, ::-1].swapaxes(0, 1),
        8: np.rot90(picture, -1),
    }[orientation]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_stand_upright(orientation):
    seen = read_photograph(png(turned_by(orientation, blocks()), exif=exif(orientation)))
    np.testing.assert_array_equal(seen.encoded, blocks())
    assert seen.sent_size == (96, 64)
    wide = blocks(dtype=np.uint16)[..., 0]
    seen = read_photograph(png(turned_by(orientation, wide), exif=exif(orientation)))
    np.testing.assert_array_equal(seen.encoded[..., 0], wide)


def test_heic_of_a_phone_stands_upright_and_has_its_focal_length():
    seen = read_photograph(png(turned_by(6, blocks()), "HEIF", quality=95, exif=exif(6, FocalLengthIn35mmFilm=26)))
    assert np.abs(seen.encoded.astype(int) - blocks()).mean() < 8
    assert seen.focal_px == pytest.approx(26 / DIAGONAL_MM * np.hypot(96, 64))


def test_heic_without_its_extra_is_told_how_to_get_it(monkeypatch):
    content, found = png(blocks(), "HEIF"), importlib.util.find_spec
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name == "pillow_heif" else found(name))
    monkeypatch.delitem(Image.OPEN, "HEIF")
    with pytest.raises(CorruptFile) as error:
        read_photograph(content)
    assert "pip install 'osf-manipulation[heic]'" in str(error.value)
    assert "JPEG" in str(error.value)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_large_photos_are_reduced_and_it_is_said(kind):
    image = np.full((400, 5000, 3), (200, 100, 50), np.uint8)
    seen = read_photograph(png(image, kind, exif=exif(FocalLengthIn35mmFilm=26)))
    assert seen.encoded.shape == (164, KEPT_SIDE, 3)
    assert "5000 x 400" in seen.notes[0]
    assert np.abs(seen.encoded.mean((0, 1)) - [200, 100, 50]).max() < 4
    assert seen.focal_px == pytest.approx(26 / DIAGONAL_MM * np.hypot(164, KEPT_SIDE))


def test_large_photos_of_sixteen_bits_are_averaged():
    values = np.random.default_rng(0).integers(0, 65536, (32, 2 * KEPT_SIDE, 3), np.uint16)
    seen = read_photograph(sixteen_bit_png(values)).encoded
    assert seen.shape == (16, KEPT_SIDE, 3)
    np.testing.assert_allclose(seen, values.reshape(16, 2, KEPT_SIDE, 2, 3).mean((1, 3)), atol=0.51)


# Colours


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def exchanged_profile():
    """Like sRGB, but with the primaries red and blue exchanged."""
    odd = SRGB.replace(b"rXYZ", b"????").replace(b"bXYZ", b"rXYZ").replace(b"????", b"bXYZ")
    return odd.replace("sRGB".encode("utf-16-be"), "xBGR".encode("utf-16-be"))


def test_colours_of_another_profile_are_converted():
    seen = read_photograph(png(blocks(), icc_profile=exchanged_profile()))
    np.testing.assert_allclose(seen.encoded, blocks()[..., ::-1].astype(int), atol=2)
    assert "xBGR" in seen.notes[0]


@pytest.mark.parametrize(
    ("profile", "encoding", "notes"),
    [(SRGB, "srgb", 0), (exchanged_profile(), "linear", 0), (b"profile" * 40, "srgb", 1), (b"\0", "srgb", 1)],
)
def test_colours_stay_if_the_profile_is_srgb_or_no_profile_or_the_file_is_linear(profile, encoding, notes):
    seen = read_photograph(png(blocks(), icc_profile=profile), encoding=encoding)
    np.testing.assert_array_equal(seen.encoded, blocks())
    assert len(seen.notes) == notes


# Focal length


@given(f35=st.integers(13, 300), width=st.integers(MIN_SIDE, 120), height=st.integers(MIN_SIDE, 120))
def test_the_equivalent_focal_length_refers_to_the_diagonal(f35, width, height):
    seen = read_photograph(encoded(Image.new("RGB", (width, height)), exif=exif(FocalLengthIn35mmFilm=f35)))
    diagonal_deg = 2 * np.rad2deg(np.arctan(DIAGONAL_MM / 2 / f35))
    assert 2 * np.rad2deg(np.arctan(np.hypot(width, height) / 2 / seen.focal_px)) == pytest.approx(diagonal_deg)
    K, _ = guessed_intrinsics(seen)
    np.testing.assert_allclose(K, intrinsics_from_focal(width, height, seen.focal_px), atol=1e-12)
    with pytest.raises(InvalidInput, check=about("focal length")):
        intrinsics_from_focal(width, height, np.nan)


@pytest.mark.parametrize(
    ("camera", "focal_px"),
    [
        ({"FocalLength": 4.5, "FocalPlaneXResolution": 25.4 * 20, "FocalPlaneResolutionUnit": 2}, 4.5 * 20),
        ({"FocalLength": 4.5, "FocalPlaneXResolution": 10.0 * 20, "FocalPlaneResolutionUnit": 3}, 4.5 * 20),
        ({"FocalLength": 4.5, "FocalPlaneXResolution": 25.4 * 20}, 4.5 * 20),
        ({}, None),
        ({"FocalLength": 4.5}, None),
        ({"FocalLengthIn35mmFilm": 60_000}, None),
        ({"FocalLength": 4.5, "FocalPlaneXResolution": 0.0}, None),
        ({"FocalLength": 4.5, "FocalPlaneXResolution": 100.0, "FocalPlaneResolutionUnit": 77}, None),
    ],
)
def test_a_sensor_of_known_resolution_gives_the_focal_length_which_is_assumed_otherwise(camera, focal_px):
    seen = read_photograph(png(blocks(), "JPEG", exif=exif(**camera)))
    assert seen.focal_px == (focal_px and pytest.approx(focal_px, rel=1e-4))
    K, _ = guessed_intrinsics(seen)
    assert K[0, 0] == pytest.approx(focal_px or np.hypot(96, 64) / 2 / np.tan(np.deg2rad(75) / 2), rel=1e-4)


# Refusals


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no picture"),
        (b"Dear reader, this is a letter.", "no picture"),
        (png_head(20_000, 12_000), "20000 x 12000"),
        (png_head(100_000, 100_000), "too many pixels"),
        (png_head(16, 400), "16 x 400"),
        (png_head(64, 64), "damaged"),
    ],
)
def test_what_is_no_photo_is_refused(data, why, tmp_path):
    with pytest.raises(CorruptFile, check=about(why)):
        read_photograph(data)
    path = tmp_path / "desk.png"
    for _ in range(2):  # a file that is missing, then one that is wrong
        with pytest.raises(CorruptFile, check=about("desk.png")):
            read_photograph(path)
        path.write_bytes(data)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "HEIF", "16 bit"])
def test_a_photo_that_was_cut_off_is_refused(kind):
    whole = sixteen_bit_png(blocks(dtype=np.uint16)) if kind == "16 bit" else png(blocks(), kind)
    for share in (0.1, 0.5, 0.9):
        with pytest.raises(CorruptFile):
            read_photograph(whole[: int(share * len(whole))])


def test_the_limit_of_other_code_on_pictures_is_neither_heeded_nor_touched(monkeypatch):
    """Pillow's own limit belongs to all threads: another one may read it at any moment."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    seen = set()
    photos = [png(blocks(), kind) for kind in ("PNG", "JPEG", "HEIF", "AVIF", "TIFF", "BMP", "GIF")]
    photos.append(png(blocks(), "TIFF", compression="tiff_deflate"))
    sys.setprofile(lambda *_: seen.add(Image.MAX_IMAGE_PIXELS))
    try:
        for photo in photos:
            read_photograph(photo)
    finally:
        sys.setprofile(None)
    assert seen == {1000}


def test_a_webp_beyond_the_limit_of_its_decoder_says_which_format_to_take():
    """Its decoder refuses 192 million pixels, which other formats may have."""
    canvas = bytes(4) + (13_899).to_bytes(3, "little") + (13_799).to_bytes(3, "little")  # sides less 1
    head = b"WEBPVP8X" + struct.pack("<I", len(canvas)) + canvas
    with pytest.raises(CorruptFile, check=about("JPEG")):
        read_photograph(b"RIFF" + struct.pack("<I", len(head)) + head)


def test_threads_that_read_at_once_ignore_odd_metadata_and_restore_the_filters_of_warnings():
    """The first is still decoding when the second begins, and ends before it."""
    odd = png(blocks(), "JPEG", exif=b"Exif\0\0II*\0\x08\0\0\0\x05\0cut")
    with pytest.warns(UserWarning, match="EXIF"), Image.open(io.BytesIO(odd)) as image:
        image.getexif().get(ExifTags.Base.Orientation)
    before, photos = (Image.MAX_IMAGE_PIXELS, list(warnings.filters)), []
    decoding, finish = [threading.Event(), threading.Event()], [threading.Event(), threading.Event()]

    def read(number):
        def pause(frame, event, _):
            if event == "call" and frame.f_code.co_name == "load":
                sys.setprofile(None)
                decoding[number].set()
                finish[number].wait(60)

        sys.setprofile(pause)
        photos.append(read_photograph(odd))

    threads = [threading.Thread(target=read, args=(number,)) for number in range(2)]
    for number, thread in enumerate(threads):
        thread.start()
        assert decoding[number].wait(60)
    for number, thread in enumerate(threads):
        finish[number].set()
        thread.join()
    assert len(photos) == 2
    assert (Image.MAX_IMAGE_PIXELS, warnings.filters) == before


# Radiance


def test_photographs_are_linear_and_know_where_they_are_exposed_well():
    values = np.full((64, 64, 3), 128, np.uint8)
    values[0, :4] = (250, 9, 9), (251, 9, 9), (1, 1, 1), (1, 2, 0)
    seen = to_photograph(read_photograph(png(values)), intrinsics_from_focal(64, 64, 70.0))
    np.testing.assert_allclose(seen.image, linear_of_srgb(values / 255), atol=1e-6)
    assert seen.well_exposed[0, :5].tolist() == [True, False, False, True, True]
    assert seen.well_exposed.sum() == 64 * 64 - 2
    assert not seen.on_table


def test_linear_files_stay_as_they_are():
    raw = read_photograph(png(blocks()), encoding="linear")
    pose = Pose(np.array([0, 0, 0.8]), np.array([0, 1.0, 0, 0]))
    seen = to_photograph(raw, intrinsics_from_focal(96, 64, 90.0), pose, {"mug": np.ones((64, 96), bool)})
    np.testing.assert_allclose(seen.image, blocks() / 255, atol=1e-6)
    assert seen.on_table
    assert list(seen.masks) == ["mug"]
