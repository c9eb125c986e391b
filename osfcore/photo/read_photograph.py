"""Reading photos that people send: upright, at a moderate size, with the focal length from EXIF data.

The header of a file is checked first. Every error of a decoder becomes one sentence.
"""

from __future__ import annotations

import contextlib
import io
import struct
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import ExifTags, Image, ImageCms, ImageFile
from PIL.TiffImagePlugin import TiffImageFile

from osfcore.errors import CorruptFile, OsfError, check_ranges, shown
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.extras import MissingExtra, missing
from osfcore.geometry.poses import Pose
from osfcore.photo.board import Intrinsics, camera_matrix
from osfcore.photo.photograph import Masks, Photograph

FORMATS = ("PNG", "JPEG", "WEBP", "HEIF", "AVIF", "TIFF", "GIF", "BMP")
MAX_PIXELS = 200_000_000
MAX_BYTES = 500_000_000
MIN_SIDE = 32
KEPT_SIDE = 2048  # larger photos are scaled down to this
SATURATED, BLACK = 251 / 255, 1 / 255  # encoded values from which and up to which radiance is unknown
ASSUMED_DIAGONAL_DEG = 75.0  # field of view of a phone's main camera, from corner to corner
_FILM_DIAGONAL_MM = 43.27  # of the 36 x 24 mm to which equivalent focal lengths refer
_FOCAL_RANGE = 0.2, 50.0  # per longest side: what lies outside is a mistake in the metadata
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of EXIF's FocalPlaneResolutionUnit
_HEIC = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")  # brands of ISO/IEC 23008-12
_WIDE_MODES = ("I;16", "I;16B", "I;16L", "I;16N")
# Quarter turns counter-clockwise, then whether to mirror, by EXIF's orientation.
_UPRIGHT = {2: (0, True), 3: (2, False), 4: (2, True), 5: (3, True), 6: (3, False), 7: (1, True), 8: (1, False)}


@dataclass(frozen=True, eq=False, slots=True)
class RawPhotograph:
    """A decoded photo, upright.

    Attributes:
        encoded: values of the file, in the primaries of sRGB; perhaps scaled down.
        encoding: encoding of these values.
        sent_size: width and height of the upright photo as it was sent [px].
        focal_px: focal length in pixels of `encoded`, from EXIF; None if it is missing there.
        notes: sentences for the user about what was done to the photo.
    """

    encoded: UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]
    encoding: Encoding
    sent_size: tuple[int, int]
    focal_px: float | None
    notes: tuple[str, ...]

    @property
    def eight_bit(self) -> UInt8[np.ndarray, "h w 3"]:
        """The encoded values as 8-bit values, for people to look at."""
        if self.encoded.dtype == np.uint8:
            return self.encoded
        return ((self.encoded.astype(np.uint32) + 128) // 257).astype(np.uint8)


def read_photograph(data: bytes | Path, *, encoding: Encoding = "srgb", most_pixels: int = MAX_PIXELS) -> RawPhotograph:
    """Read a photo in any usual format, upright, no side longer than 2048 px.

    It reads grey images, palettes, CMYK, and 16 bits a channel (in PNG and grey TIFF). Transparent parts become white.
    8-bit colours of another profile are converted to sRGB. Of an animation, the first image is used.

    Args:
        data: the file, or its contents.
        encoding: encoding of its values.
        most_pixels: largest number of pixels.

    Raises:
        CorruptFile: if it is no such image, is damaged, or has too many or too few pixels.
    """
    name, content = ("The photo", data) if isinstance(data, bytes) else (shown(data), content_of(data, data, MAX_BYTES))
    allowed = f"{most_pixels // 1_000_000} million are allowed"
    try:
        with _without_warnings(), _opened(name, content) as image:
            width, height = image.size
            if width * height > 2 * most_pixels:
                raise CorruptFile(name, f"it has far too many pixels; {allowed}")
            if width * height > most_pixels:
                raise CorruptFile(name, f"it has {width} x {height} pixels; {allowed}")
            if min(width, height) < MIN_SIDE:
                raise CorruptFile(name, f"it has {width} x {height} pixels; at least {MIN_SIDE} a side are needed")
            return _read(image, content, encoding)
    except OsfError:  # a ValueError itself
        raise
    except MemoryError:
        raise CorruptFile(name, "it needs too much memory to be decoded; take a smaller one") from None
    except Image.DecompressionBombError:  # the decoders of WebP and GIF have a limit of their own, below ours
        raise CorruptFile(name, "it has too many pixels for its format; send it as a JPEG") from None
    except Exception:  # decoders raise whatever their own code stumbles over
        raise CorruptFile(name, "it is damaged or incomplete, and cannot be decoded; send it again") from None


def content_of(path: Path, name: Path | str, most: int) -> bytes:
    """Return the contents of a file of at most `most` bytes.

    Raises:
        CorruptFile: if it cannot be read or is larger; the message uses `name`.
    """
    try:
        if path.stat().st_size > most:
            raise CorruptFile(name, f"it is larger than {most // 1_000_000} MB")
        return path.read_bytes()
    except OSError as error:
        raise CorruptFile(name, error.strerror or str(error)) from error


class _LargeTiff(TiffImageFile):
    """A TIFF without Pillow's limit on its size; its pixels are counted before they are decoded."""

    def load_prepare(self) -> None:
        if self._im is None:
            self.im = Image.core.new(self.mode, self._tile_size)
        ImageFile.ImageFile.load_prepare(self)


def _opened(name: str, content: bytes) -> Image.Image:
    """Read a picture's header, as `Image.open` does, but without its limit on pixels, which all threads share."""
    Image.init()
    without_heic = missing("heic")
    if not without_heic:
        from pillow_heif import register_heif_opener

        register_heif_opener()
    for kind in FORMATS:
        if kind not in Image.OPEN:
            continue
        opener, accepts = Image.OPEN[kind]
        with contextlib.suppress(SyntaxError, IndexError, TypeError, struct.error):  # of another format
            accepted = accepts is None or accepts(content[:16])
            if accepted and not isinstance(accepted, str):  # which says why this Pillow cannot
                return (_LargeTiff if opener is TiffImageFile else opener)(io.BytesIO(content), "")
    if without_heic and content[4:8] == b"ftyp" and content[8:12] in _HEIC:
        lacking = str(MissingExtra("HEIC", "heic", without_heic)).removesuffix(".")
        raise CorruptFile(name, f"{lacking}, or send a JPEG")
    kinds = "a JPEG, PNG, WebP, HEIC, AVIF, TIFF, GIF or BMP file"
    raise CorruptFile(name, f"it is no picture that can be read here; send {kinds}")


_quiet_lock, _quiet_threads, _filters = threading.Lock(), 0, contextlib.ExitStack()


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Ignore Pillow's warnings about odd metadata. All threads share the filters, so the last one restores them."""
    global _quiet_threads
    with _quiet_lock:
        if _quiet_threads == 0:
            _filters.enter_context(warnings.catch_warnings(action="ignore"))
        _quiet_threads += 1
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_threads -= 1
            if _quiet_threads == 0:
                _filters.close()


def intrinsics_from_focal(width: int, height: int, focal_px: float) -> Intrinsics:
    """Return K of a camera with square pixels and its principal point in the middle; pixel centres at +0.5.

    Raises:
        InvalidInput: if the focal length is less than a fifth of the image's longest side, or more than 50 times that.
    """
    low, high = (factor * max(width, height) for factor in _FOCAL_RANGE)
    check_ranges(("focal length [px]", focal_px, low, high))
    return camera_matrix(focal_px, width / 2, height / 2)


def guessed_intrinsics(raw: RawPhotograph) -> tuple[Intrinsics, str]:
    """Return K from EXIF data, or else that of a phone's main camera, and a note that names the source."""
    height, width = raw.encoded.shape[:2]
    if raw.focal_px is not None:
        note = f"The focal length, {raw.focal_px:.0f} pixels, comes from the photo's EXIF data."
        return intrinsics_from_focal(width, height, raw.focal_px), note
    focal = np.hypot(width, height) / 2 / np.tan(np.deg2rad(ASSUMED_DIAGONAL_DEG) / 2)
    phone = f"that of a phone's main camera is assumed ({ASSUMED_DIAGONAL_DEG:g} degrees from corner to corner)"
    note = f"The photo has no focal length; {phone}, unless two or more objects show another one."
    return intrinsics_from_focal(width, height, float(focal)), note


def to_photograph(
    raw: RawPhotograph, intrinsics: Intrinsics, T_world_camera: Pose | None = None, masks: Masks | None = None
) -> Photograph:
    """Return the linear radiance of a decoded photo, and which of its pixels are well exposed.

    Args:
        raw: the photo as it was read.
        intrinsics: K of `raw.encoded` [px].
        T_world_camera: pose of the camera over the table's plane z = 0; None if the table is not known.
        masks: masks of the objects, by name.

    Raises:
        InvalidInput: if intrinsics, pose or masks do not fit the photo.
    """
    most = np.iinfo(raw.encoded.dtype).max
    radiance = linear_from_encoded(np.arange(most + 1) / most, raw.encoding).astype(np.float32)
    brightest = raw.encoded.max(axis=2)
    well_exposed = (brightest > BLACK * most) & (brightest < SATURATED * most)
    pose = Pose.identity() if T_world_camera is None else T_world_camera
    return Photograph(radiance[raw.encoded], well_exposed, intrinsics, pose, T_world_camera is not None, masks or {})


def _read(image: Image.Image, content: bytes, encoding: Encoding) -> RawPhotograph:
    width, height = image.size
    orientation, focal = _orientation(image), _focal_per_diagonal(image)
    if image.mode in _WIDE_MODES or (image.format == "PNG" and content[24] == 16):
        encoded, notes = _sixteen_bit(image, content), ()
    else:
        encoded, notes = _eight_bit_rgb(image, encoding)
    turns, is_mirrored = _UPRIGHT.get(orientation, (0, False))
    upright = np.rot90(encoded, turns)
    upright = np.ascontiguousarray(upright[:, ::-1] if is_mirrored else upright)
    sent = (height, width) if turns % 2 else (width, height)
    kept = upright.shape[1], upright.shape[0]
    if kept != sent:
        reduced = f"The photo was reduced from {sent[0]} x {sent[1]} to {kept[0]} x {kept[1]} pixels."
        notes = (reduced, *notes)
    focal_px = None if focal is None else focal * float(np.hypot(*kept))
    return RawPhotograph(upright, encoding, sent, focal_px, notes)


def _eight_bit_rgb(image: Image.Image, encoding: Encoding) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[str, ...]]:
    image.draft("RGB", (KEPT_SIDE, KEPT_SIDE))  # lets a JPEG be decoded small at once
    mode = "RGBA" if image.has_transparency_data else "RGB"
    plain = image if image.mode == mode else image.convert(mode)
    plain.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.BOX)
    notes: list[str] = []
    if mode == "RGBA":
        if np.asarray(plain.getchannel("A")).min() < 255:
            notes.append("Transparent parts of the photo are read as white.")
        plain = Image.alpha_composite(Image.new("RGBA", plain.size, "white"), plain).convert("RGB")
    profile = image.info.get("icc_profile")
    if profile and encoding == "srgb" and image.mode in ("RGB", "RGBA"):
        plain, note = _in_srgb(plain, profile)
        notes += [note] if note else []
    return np.asarray(plain), tuple(notes)


def _in_srgb(image: Image.Image, profile: bytes) -> tuple[Image.Image, str]:
    """Convert colours from the photo's profile to sRGB, since phones write a wider gamut."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = shown(ImageCms.getProfileDescription(source).strip())
        if name.startswith("sRGB"):
            return image, ""
        converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
        assert converted is not None
        return converted, f"The photo's colours were converted from {name} to sRGB."
    except Exception:  # profiles may be wrong in as many ways as other metadata
        return image, "The photo's colour profile cannot be read; its colours are read as sRGB."


def _sixteen_bit(image: Image.Image, content: bytes) -> UInt16[np.ndarray, "h w 3"]:
    """Decode all sixteen bits, of which Pillow keeps only eight in colour images. Transparent parts become white."""
    image.load()  # finds out damage, which OpenCV passes over
    if image.mode in _WIDE_MODES:
        values = np.asarray(image).astype(np.uint16)
    else:
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if decoded is None:
            raise OSError("OpenCV cannot decode what Pillow can")
        values = decoded
    scale = KEPT_SIDE / max(values.shape[:2])
    if scale < 1:
        size = max(round(values.shape[1] * scale), 1), max(round(values.shape[0] * scale), 1)
        values = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    if values.ndim == 2:
        return np.repeat(values[..., None], 3, axis=2)
    rgb = values[..., 2::-1]
    if values.shape[2] == 4:
        alpha = values[..., 3:] / 65535
        rgb = np.round(rgb * alpha + 65535 * (1 - alpha)).astype(np.uint16)
    return rgb


def _orientation(image: Image.Image) -> int:
    """Return EXIF's orientation; 1 if the metadata cannot be read (ImageOps then fails)."""
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        return orientation if orientation in _UPRIGHT else 1
    except Exception:  # there are too many kinds of mistakes in metadata to name them
        return 1


def _focal_per_diagonal(image: Image.Image) -> float | None:
    """Return the focal length in units of the diagonal, from EXIF; None if it is missing or implausible."""
    width, height = image.size
    diagonal = float(np.hypot(width, height))
    try:
        tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
        if equivalent := float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)):
            focal = equivalent / _FILM_DIAGONAL_MM
        else:
            unit = _MM_PER_UNIT[int(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))]
            px_per_mm = float(tags[ExifTags.Base.FocalPlaneXResolution]) / unit
            focal = float(tags[ExifTags.Base.FocalLength]) * px_per_mm / diagonal
    except Exception:  # as above
        return None
    low, high = _FOCAL_RANGE
    return focal if low <= focal * diagonal / max(width, height) <= high else None
