"""Whatever a stranger sends is either a picture of moderate size or refused in one sentence."""

import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from app.storage.photos import KEPT_SIDE, MAX_RATIO, MAX_SIDE, MIN_SIDE, PhotoRefused, read_photo

TURNED = 6  # EXIF: the camera was held upright, so its first row is the right edge
ORIENTATION = 0x0112


def picture(width=96, height=64, seed=0):
    """Blocks of colours, so that JPEG keeps them."""
    small = np.random.default_rng(seed).integers(0, 256, (-(-height // 16), -(-width // 16), 3), np.uint8)
    return Image.fromarray(small.repeat(16, axis=0).repeat(16, axis=1)[:height, :width])


def encoded(image, kind="PNG", **options):
    data = io.BytesIO()
    image.save(data, kind, **options)
    return data.getvalue()


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
        assert str(error).startswith("The photo ")
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
    np.testing.assert_allclose(seen[..., 0], values / 257, atol=0.5)
    assert (seen == seen[..., :1]).all()


def test_what_is_transparent_is_taken_for_its_colour():
    image = picture().convert("RGBA")
    image.putalpha(7)
    np.testing.assert_array_equal(read_photo(encoded(image)), np.asarray(picture()))


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


@given(width=st.integers(MIN_SIDE, 1300), height=st.integers(MIN_SIDE, 1300), kind=st.sampled_from(["PNG", "JPEG"]))
def test_sizes_are_bounded_and_proportions_kept(width, height, kind):
    image = Image.new("RGB", (width, height), (200, 100, 50))
    seen = taken_or_refused(encoded(image, kind))
    if max(width, height) > MAX_RATIO * min(width, height):
        assert seen is None
    else:
        assert seen.shape[1] == pytest.approx(seen.shape[0] * width / height, abs=4.5)
        assert max(seen.shape) == min(max(width, height), KEPT_SIDE)
        assert np.abs(seen.mean(axis=(0, 1)) - [200, 100, 50]).max() < 4


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((MAX_SIDE + 1, MAX_SIDE), f"{MAX_SIDE + 1} x {MAX_SIDE} pixels; {MAX_SIDE} a side"),
        ((11_000, 9_000), "far too many pixels"),
        ((60_000, 60_000), "far too many pixels"),
        ((2**31 - 1, 2**31 - 1), "far too many pixels"),
        ((MIN_SIDE - 1, 64), f"at least {MIN_SIDE}"),
        ((1, 1), f"at least {MIN_SIDE}"),
        ((64, 64 * MAX_RATIO + 1), f"{MAX_RATIO} times the other"),
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


def test_animations_are_refused():
    frames = [picture(seed=seed) for seed in range(3)]
    with pytest.raises(PhotoRefused, match="animated"):
        read_photo(encoded(frames[0], "PNG", save_all=True, append_images=frames[1:]))


def test_a_jpeg_that_brings_further_views_is_a_photo():
    """Telephones write such files; the first image is the photo."""
    first, second = picture(seed=1), picture(seed=2)
    seen = read_photo(encoded(first, "MPO", save_all=True, append_images=[second], quality=95))
    assert np.abs(seen.astype(int) - np.asarray(first)).mean() < 8


@pytest.mark.parametrize("kind", ["GIF", "BMP", "TIFF", "WEBP", "PPM"])
def test_other_formats_are_refused(kind):
    with pytest.raises(PhotoRefused, match="neither a PNG nor a JPEG"):
        read_photo(encoded(picture(), kind))


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
