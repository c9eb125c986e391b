"""Whatever a stranger sends is either a picture of moderate size or refused in one sentence."""

import io
import os
import signal
import struct
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pillow_heif import register_heif_opener

from app.processes.client import ProcessUnavailable
from app.processes.server import OutOfMemory
from app.storage.photos import GOAL_SIDE, Photo, PhotoCrop, PhotoReader, PhotoRefused, central_crop, check_crop, cut_out
from app.storage.photos import read_photo as decoded
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import goal_camera
from osfcore.photo.read_photograph import KEPT_SIDE, MIN_SIDE

TURNED = 6  # EXIF: the camera was held upright, so its first row is the right edge
ORIENTATION = 0x0112


register_heif_opener()


def picture(width=96, height=64, seed=0):
    """Blocks of colours, so that JPEG keeps them."""
    small = np.random.default_rng(seed).integers(0, 256, (-(-height // 16), -(-width // 16), 3), np.uint8)
    return Image.fromarray(small.repeat(16, axis=0).repeat(16, axis=1)[:height, :width])


def encoded(image, kind="PNG", **options):
    data = io.BytesIO()
    image.save(data, kind, **options)
    return data.getvalue()


def read_photo(data):
    return decoded(data).pixels


def turned_exif():
    exif = Image.Exif()
    exif[ORIENTATION] = TURNED
    exif[0x010F] = "maker" * 20
    return exif.tobytes()


def png_of(width, height, *chunks, depth=8, colour=2):
    """A PNG by hand: header, the given chunks, end."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunk(*own) for own in chunks) + chunk(b"IEND", b"")


def taken_or_refused(data):
    """What came of it; anything but a picture of moderate size or a refusal fails the test."""
    try:
        pixels = read_photo(data)
    except PhotoRefused as error:
        assert str(error).startswith(("The photo ", "The file "))
        assert "\n" not in str(error)
        return None
    assert pixels.dtype == np.uint8
    assert pixels.ndim == 3
    assert pixels.shape[2] == 3
    assert 1 <= min(pixels.shape[:2]) <= max(pixels.shape[:2]) <= KEPT_SIDE
    return pixels


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "1"])
def test_every_kind_of_png_is_understood(mode):
    image = picture().convert(mode)
    np.testing.assert_array_equal(read_photo(encoded(image)), np.asarray(image.convert("RGB")))


def test_sixteen_bits_become_eight():
    values = np.linspace(0, 65535, 64 * 64).astype(np.uint16).reshape(64, 64)
    seen = read_photo(encoded(Image.fromarray(values)))
    np.testing.assert_array_equal(seen[..., 0], np.round(values / 257))
    assert (seen == seen[..., :1]).all()


def test_what_is_transparent_is_white():
    image = picture().convert("RGBA")
    image.putalpha(0)
    assert (read_photo(encoded(image)) == 255).all()


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
def test_a_jpeg_looks_as_it_did(mode):
    image = picture().convert(mode)
    seen = read_photo(encoded(image, "JPEG", quality=95))
    assert np.abs(seen.astype(int) - np.asarray(image.convert("RGB"))).mean() < 8


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("mode", ["RGB", "L", "I;16"])
def test_photos_stand_upright(kind, mode):
    image = picture(96, 64).convert("L" if mode == "I;16" else mode)
    if mode == "I;16":
        if kind == "JPEG":
            pytest.skip("JPEG has 8 bits a channel")
        image = Image.fromarray(np.asarray(image, np.uint16) * 257)
    plain = read_photo(encoded(image, kind))
    turned = read_photo(encoded(image, kind, exif=turned_exif()))
    assert turned.shape == (96, 64, 3)
    assert np.abs(turned.astype(int) - np.rot90(plain, -1)).mean() < 8


@given(width=st.integers(MIN_SIDE, 5000), height=st.integers(MIN_SIDE, 300), kind=st.sampled_from(["PNG", "JPEG"]))
def test_sizes_are_bounded_and_proportions_kept(width, height, kind):
    photo = decoded(encoded(Image.new("RGB", (width, height), (200, 100, 50)), kind))
    seen = photo.pixels
    assert (photo.width, photo.height) == (width, height)
    assert max(seen.shape) == min(max(width, height), KEPT_SIDE)
    assert seen.shape[0] == pytest.approx(height * seen.shape[1] / width, abs=1.01)
    assert np.abs(seen.mean(axis=(0, 1)) - [200, 100, 50]).max() < 4


def test_the_size_is_told_of_the_upright_photo():
    photo = decoded(encoded(picture(96, 64), "JPEG", exif=turned_exif()))
    assert (photo.width, photo.height) == (64, 96)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((20_000, 12_000), "20000 x 12000 pixels; 200 million"),
        ((60_000, 60_000), "far too many pixels; 200 million"),
        ((2**31 - 1, 2**31 - 1), "far too many pixels"),
        ((MIN_SIDE - 1, 64), f"at least {MIN_SIDE}"),
        ((1, 1), f"at least {MIN_SIDE}"),
    ],
)
def test_sizes_are_judged_by_the_header_alone(size, words):
    """The pixels could not be decoded."""
    with pytest.raises(PhotoRefused, match=words):
        read_photo(png_of(*size, (b"IDAT", zlib.compress(b"0"))))


def test_a_bomb_of_metadata_is_refused():
    text = b"Comment\0\0" + zlib.compress(b"0" * 200_000_000, 9)
    with pytest.raises(PhotoRefused):
        read_photo(png_of(64, 64, (b"zTXt", text), (b"IDAT", zlib.compress(b"\0" * 64 * 193))))


@pytest.mark.parametrize("kind", ["PNG", "GIF", "WEBP"])
def test_the_first_image_of_an_animation_counts(kind):
    frames = [Image.new("RGB", (64, 64), colour) for colour in ("red", "blue")]
    seen = read_photo(encoded(frames[0], kind, save_all=True, append_images=frames[1:]))
    assert np.abs(seen.astype(int) - [255, 0, 0]).max() < 8


def test_a_jpeg_that_brings_further_views_is_a_photo():
    """Telephones write such files; the first image is the photo."""
    first, second = picture(seed=1), picture(seed=2)
    seen = read_photo(encoded(first, "MPO", save_all=True, append_images=[second], quality=95))
    assert np.abs(seen.astype(int) - np.asarray(first)).mean() < 8


@pytest.mark.parametrize("kind", ["BMP", "TIFF", "WEBP", "AVIF", "HEIF"])
def test_every_usual_format_is_understood(kind):
    seen = read_photo(encoded(picture(), kind, quality=95))
    assert np.abs(seen.astype(int) - np.asarray(picture())).mean() < 8


def test_a_photo_of_an_iphone_stands_upright():
    seen = decoded(encoded(picture(96, 64), "HEIF", quality=95, exif=turned_exif()))
    assert (seen.width, seen.height) == (64, 96)
    assert np.abs(seen.pixels.astype(int) - np.rot90(np.asarray(picture()), -1)).mean() < 8


@pytest.mark.parametrize("data", [b"%PDF-1.7 ...", b"", encoded(picture(), "PPM")])
def test_what_is_no_picture_is_told_so(data):
    with pytest.raises(PhotoRefused, match="no picture that can be read here; send a JPEG, PNG"):
        read_photo(data)


@given(data=st.binary(max_size=300), head=st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"]))
def test_bytes_that_are_no_photo_are_refused(data, head):
    assert taken_or_refused(head + data) is None


SOUND = [
    encoded(picture(), "PNG"),
    encoded(picture().convert("P"), "PNG", exif=turned_exif()),
    encoded(picture(), "JPEG", exif=turned_exif()),
    encoded(picture(), "JPEG", progressive=True, icc_profile=b"profile" * 40),
    encoded(picture().convert("CMYK"), "JPEG"),
]


@pytest.mark.parametrize("sound", SOUND, ids=lambda data: f"{len(data)} bytes")
def test_a_photo_that_was_cut_off_is_refused(sound):
    assert taken_or_refused(sound) is not None
    whole = [cut for cut in range(0, len(sound), 7) if taken_or_refused(sound[:cut]) is not None]
    assert all(cut > len(sound) - 24 for cut in whole), "only the end mark and a checksum may be missing"


def mutated(rng):
    """A sound photo of which a few bytes are something else."""
    data = bytearray(SOUND[rng.integers(len(SOUND))])
    for _ in range(rng.integers(1, 12)):
        where = rng.integers(min(len(data), 400) if rng.random() < 0.7 else len(data))  # metadata stands in front
        match rng.integers(3):
            case 0:
                data[where] = rng.integers(256)
            case 1:
                data[where:where] = rng.bytes(rng.integers(1, 5))
            case _:
                del data[where : where + rng.integers(1, 5)]
    return bytes(data)


@pytest.mark.parametrize("count", [300, pytest.param(2000, marks=pytest.mark.soak)])
def test_damage_anywhere_is_refused_or_harmless(count):
    outcomes = [taken_or_refused(mutated(np.random.default_rng([count, number]))) for number in range(count)]
    assert 0 < sum(seen is None for seen in outcomes) < count


# Odd metadata


def segment(marker, data):
    return bytes([0xFF, marker]) + struct.pack(">H", len(data) + 2) + data


def jpeg_with(*segments, size=(96, 64)):
    plain = encoded(picture(*size), "JPEG", quality=95)
    return plain[:2] + b"".join(segments) + plain[2:]


def tiff(*entries, order="<", count=None, offset=8):
    """The metadata that EXIF is: a table of (tag, type, count, value)."""
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HL", 42, offset)
    table = b"".join(struct.pack(f"{order}HHLL", *entry) for entry in entries)
    return head + struct.pack(f"{order}H", len(entries) if count is None else count) + table + bytes(4)


def exif(data):
    return segment(0xE1, b"Exif\0\0" + data)


def xmp(data):
    return segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + data)


RIGHT, WIDTH, PACKET = (ORIENTATION, 3, 1, TURNED), 0x011A, 0x02BC
ODD_TURNED = {  # understood as far as needed, though what else they say makes no sense
    "maker is a fraction": exif(tiff(RIGHT, (0x010F, 5, 1, 8))),
    "maker is a number": exif(tiff(RIGHT, (0x010F, 11, 1, 7))),
    "resolution is text": exif(tiff(RIGHT, (WIDTH, 2, 4, 0x363636))),
    "resolution is bytes": exif(tiff(RIGHT, (WIDTH, 7, 4, 7))),
    "XMP packet is a number": exif(tiff(RIGHT, (PACKET, 12, 1, 8))),
    "XMP packet is text": exif(tiff(RIGHT, (PACKET, 2, 4, 0x363636))),
    "XMP packet is a list of numbers": exif(tiff(RIGHT, (PACKET, 11, 2, 8))),
    "strips are nowhere": exif(tiff(RIGHT, (0x0111, 4, 1, 2**32 - 1))),
    "orientation is a list": exif(tiff((ORIENTATION, 3, 2, 6 + (6 << 16)))),
    "XMP is no XML": xmp(b'<<\xff\xfe tiff:Orientation="6"'),
}
ODD_UPRIGHT = {
    "orientation is text": exif(tiff((ORIENTATION, 2, 4, 0x363636))),
    "orientation is bytes": exif(tiff((ORIENTATION, 7, 4, 6))),
    "orientation is a fraction by zero": exif(tiff((ORIENTATION, 5, 1, 26)) + bytes(8)),
    "orientation is a fraction from nowhere": exif(tiff((ORIENTATION, 5, 1, 2**32 - 1))),
    "orientation is unknown": exif(tiff((ORIENTATION, 3, 1, 99))),
    "type is unknown": exif(tiff((ORIENTATION, 77, 1, 6))),
    "table is nowhere": exif(tiff(RIGHT, offset=2**31)),
    "table is the head": exif(tiff(RIGHT, offset=0)),
    "head is cut off": exif(b"II*"),
    "head is of no known kind": exif(b"IX*\0\0\0\0\0" * 3),
    "nothing": exif(b""),
    "another order of bytes": exif(b"MM" + tiff(RIGHT)[2:]),
    "XMP says nonsense": xmp(b'<a tiff:Orientation="9"/>'),
    "XMP in another encoding": xmp('<a tiff:Orientation="6"/>'.encode("utf-16")),
}
ODD_ANY = {
    "colour profile without its number": segment(0xE2, b"ICC_PROFILE\0"),
    "JFIF without a version": segment(0xE0, b"JFIF"),
    "Adobe without a version": segment(0xEE, b"Adobe"),
    "further views from nowhere": segment(0xE2, b"MPF\0" + tiff((0xB001, 4, 1, 9), (0xB002, 7, 2**31, 2**31))),
    "a table of 65535 entries": exif(tiff(RIGHT, count=65535)),
    "resources that end early": segment(0xED, b"Photoshop 3.0\x008BIM\4\4\xff"),
}


@pytest.mark.parametrize("odd", ODD_TURNED.values(), ids=ODD_TURNED)
def test_odd_metadata_does_not_hide_which_way_is_up(odd):
    seen = read_photo(jpeg_with(odd))
    assert np.abs(seen.astype(int) - np.rot90(np.asarray(picture()), -1)).mean() < 8


@pytest.mark.parametrize("odd", ODD_UPRIGHT.values(), ids=ODD_UPRIGHT)
def test_metadata_that_cannot_be_understood_turns_nothing(odd):
    seen = read_photo(jpeg_with(odd))
    assert np.abs(seen.astype(int) - np.asarray(picture())).mean() < 8


@pytest.mark.parametrize("odd", ODD_ANY.values(), ids=ODD_ANY)
def test_other_odd_metadata_is_refused_or_harmless(odd):
    taken_or_refused(jpeg_with(odd))


@given(noise=st.binary(max_size=80), place=st.integers(0, 80), kind=st.sampled_from([exif, xmp]))
def test_random_metadata_never_spoils_a_photo(noise, place, kind):
    sound = tiff(RIGHT, (WIDTH, 5, 1, 8), (PACKET, 7, 4, 7))
    assert taken_or_refused(jpeg_with(kind(sound[:place] + noise + sound[place + len(noise) :]))) is not None


# In a process


@pytest.fixture
def reader(request):
    reader = PhotoReader(*getattr(request, "param", ()))
    yield reader
    reader.stop()


def odd_reader(data):
    """Misbehaves as asked, and otherwise says how long what was sent is."""
    if data == b"hang":
        time.sleep(600)
    if data == b"crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if data == b"devour":
        return bytearray(4 << 30)
    return len(data)


def test_photos_are_decoded_elsewhere(reader):
    for mode in ("RGB", "L"):
        image = picture().convert(mode)
        np.testing.assert_array_equal(reader.read(encoded(image)).pixels, np.asarray(image.convert("RGB")))
    with pytest.raises(PhotoRefused):
        reader.read(b"%PDF-1.7")


@pytest.mark.slow
def test_the_largest_photos_fit_into_the_memory_of_the_process(reader):
    pixels = np.random.default_rng(0).integers(0, 256, (512, 512, 4), np.uint8).repeat(16, axis=0).repeat(16, axis=1)
    photos = {
        "CMYK": encoded(Image.fromarray(pixels, "CMYK"), "JPEG", progressive=True),
        "RGBA": encoded(Image.fromarray(pixels), compress_level=1),
        "I;16": encoded(Image.fromarray(pixels[..., 0].astype(np.uint16) * 257), compress_level=1, exif=turned_exif()),
    }
    for mode, data in photos.items():
        assert reader.read(data).pixels.shape == (2048, 2048, 3), mode


@pytest.mark.slow
def test_a_bomb_in_the_process_is_refused_and_hurts_nobody(reader):
    text = b"Comment\0\0" + zlib.compress(b"0" * 200_000_000, 9)
    with pytest.raises(PhotoRefused):
        reader.read(png_of(64, 64, (b"zTXt", text), (b"IDAT", zlib.compress(b"\0" * 64 * 193))))
    assert reader.read(encoded(picture())).pixels.shape == (64, 96, 3)


@pytest.mark.slow
@pytest.mark.parametrize("reader", [(odd_reader, 8.0)], indirect=True)
def test_a_decoder_that_hangs_is_ended_and_heals(reader):
    with pytest.raises(PhotoRefused, match="8 s"):
        reader.read(b"hang")
    assert reader.read(b"sound") == 5


@pytest.mark.slow
@pytest.mark.parametrize("reader", [(odd_reader,)], indirect=True)
def test_a_decoder_that_crashes_or_devours_memory_is_told_and_heals(reader):
    assert reader.read(b"sound") == 5
    with pytest.raises(ProcessUnavailable):
        reader.read(b"crash")
    assert reader.read(b"sound") == 5
    with pytest.raises(OutOfMemory):
        reader.read(b"devour")
    assert reader.read(b"sound") == 5


# Cutting a goal image out of a photo: in the photo's own pixels, without shifts, turned about the middle

CAMERA = goal_camera(64)
WIDE = replace(CAMERA, height=32)
SIZES = st.integers(40, 5000)


def noise(width, height):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def ramp(width, height, full_width):
    """Each pixel's own place in a photo of which this is a smaller copy, red across and green down [px / 20]."""
    scale = full_width / width
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = (np.arange(width) + 0.5) * scale / 20
    pixels[..., 1] = ((np.arange(height) + 0.5) * scale / 20)[:, None]
    return pixels


@given(width=SIZES, height=SIZES, camera=st.sampled_from([CAMERA, WIDE]))
def test_the_central_crop_touches_two_borders_and_is_always_allowed(width, height, camera):
    crop = central_crop(width, height, camera)
    check_crop(replace(crop, width=max(crop.width, 64)), max(width, 128), max(height, 128), camera)
    assert min(crop.left, crop.top) == pytest.approx(0, abs=1e-6)
    assert crop.left * 2 + crop.width == pytest.approx(width)
    assert crop.top * 2 + crop.width * camera.height / camera.width == pytest.approx(height)


def test_a_whole_square_photo_stays_as_it_is():
    pixels = noise(200, 200)
    np.testing.assert_array_equal(cut_out(Photo(pixels, 200, 200), PhotoCrop(0, 0, 200), CAMERA), pixels)


def test_a_part_is_cut_out_to_the_pixel():
    pixels = noise(200, 150)
    seen = cut_out(Photo(pixels, 200, 150), PhotoCrop(30, 20, 64), WIDE)
    np.testing.assert_array_equal(seen, pixels[20:52, 30:94])


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_are_exact(quarters):
    pixels = noise(100, 100)
    seen = cut_out(Photo(pixels, 100, 100), PhotoCrop(0, 0, 100, 90.0 * quarters), CAMERA)
    np.testing.assert_array_equal(seen, np.rot90(pixels, quarters))


@given(left=st.floats(0, 1500), top=st.floats(0, 500), width=st.floats(100, 2500), turn=st.floats(-30, 30))
def test_places_are_those_of_the_photo_as_it_was_sent(left, top, width, turn):
    """The photo had 4000 x 3000 pixels, of which a quarter as many a side are kept."""
    photo = Photo(ramp(1000, 750, 4000), 4000, 3000)
    seen = cut_out(photo, PhotoCrop(left, top, width, turn), CAMERA)
    assert seen.shape[0] == seen.shape[1] <= GOAL_SIDE
    middle = (
        seen[len(seen) // 2 - 1 : len(seen) // 2 + 1].mean(axis=0)[len(seen) // 2 - 1 : len(seen) // 2 + 1].mean(axis=0)
    )
    assert middle[:2] * 20 == pytest.approx([left + width / 2, top + width / 2], abs=45)


@pytest.mark.parametrize(
    ("crop", "words"),
    [
        (PhotoCrop(-5, 0, 100), "-5 to 95 across"),
        (PhotoCrop(150, 0, 100), "within the photo's 200 x 150"),
        (PhotoCrop(0, 60, 100), "60 to 160 down"),
        (PhotoCrop(0, 0, 20), "20 x 20.*at least 32"),
        (PhotoCrop(0, 0, 100, 200), "200"),
        (PhotoCrop(0, 0, 100, float("nan")), "nan"),
    ],
)
def test_what_cannot_be_cut_out_is_told_in_the_photos_pixels(crop, words):
    with pytest.raises(InvalidInput, match=words):
        check_crop(crop, 200, 150, CAMERA)
