"""The files that a mesh names: its materials, buffers and images, found as other programs wrote their names."""

from __future__ import annotations

import functools
import io
import unicodedata
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.objects.surface import MAX_IMAGE_PIXELS

# Others that Pillow knows start programs or hold no pictures of surfaces.
_IMAGE_KINDS = ("PNG", "JPEG", "WEBP", "AVIF", "TIFF", "TGA", "BMP", "GIF", "PPM", "DDS", "JPEG2000")


class NamedFiles:
    """Finds a file by its path from the mesh, or else by its name alone in any spelling.

    Paths of the machine that the mesh was made on, other case, composed and decomposed letters are understood.

    Args:
        mesh: the mesh.
        root: for what a stranger sent, the folder that holds all of it; nothing else is read. None for a file of one's
            own, which may name files anywhere; they are sought in its folder and one below.

    Attributes:
        source: what messages call the mesh.
        missing: names of files that were not found.
    """

    def __init__(self, mesh: Path, root: Path | None = None) -> None:
        self._mesh, self._root = mesh, None if root is None else root.resolve()
        self.source = str(mesh if root is None else mesh.relative_to(root))
        self.missing: list[str] = []

    def find(self, reference: str) -> Path | None:
        """Return where a file lies, or None."""
        plain = reference.strip().strip('"').replace("\\", "/")
        for path in dict.fromkeys((reference, plain, unquote(plain))):  # a name may begin with a space
            direct = self._inside(path)
            if direct is not None:
                return direct
            parts = _folded(path).split("/")
            found = [(_agreeing(parts, known), file) for known, file in self._known if known[-1] == parts[-1]]
            if found:
                return max(found, key=lambda pair: pair[0])[1]
        return None

    def get(self, reference: str) -> bytes:
        """Return the contents of a file.

        Raises:
            FileNotFoundError: if there is none; it is then in `missing`, too.
        """
        path = self.find(reference)
        if path is None:
            name = PurePosixPath(reference.strip().replace("\\", "/")).name
            self.missing.append(shown(name))
            raise FileNotFoundError(name)
        return path.read_bytes()

    def image(self, reference: str) -> UInt8[np.ndarray, "h w 3"]:
        """Return the pixels of an image file.

        Raises:
            FileNotFoundError: as `get`.
            CorruptFile, InvalidInput: as `decoded`.
        """
        return self.decoded(self.get(reference), PurePosixPath(reference.replace("\\", "/")).name)

    def decoded(self, data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
        """Return the pixels of an encoded image; transparency is left out.

        Raises:
            CorruptFile: if it is no image of a kind that can be read.
            InvalidInput: if it has over 67 million pixels.
        """
        try:
            with Image.open(io.BytesIO(data), formats=_IMAGE_KINDS) as image:
                if image.width * image.height > MAX_IMAGE_PIXELS:
                    size = f"{image.width} x {image.height}"
                    raise InvalidInput(f"size of the texture {shown(name)} [px]", size, "at most 8192 x 8192")
                if image.mode.startswith("I;16"):  # Pillow would cut it to the lowest 8 bits
                    return np.repeat((np.asarray(image) >> 8).astype(np.uint8)[..., None], 3, axis=2)
                return np.asarray(image.convert("RGB"))
        except (InvalidInput, MemoryError):
            raise
        except Exception as error:  # decoders raise anything on damaged input
            reason = f"its texture {shown(name)} cannot be read; save it as PNG or JPEG"
            raise CorruptFile(self.source, reason) from error

    def check(self) -> None:
        """Refuse a mesh that names files which did not come with it.

        Raises:
            CorruptFile: if there is one.
        """
        if self.missing:
            missing = ", ".join(dict.fromkeys(self.missing))
            way = "which is not beside it; put it there"
            if self._root is not None:
                way = "which did not come with it; put the mesh and it into one zip"
            if not missing.isascii():  # a zip of an old Windows garbles letters of many languages
                way += ", with the letters a to z in all names"
            raise CorruptFile(self.source, f"it names {missing}, {way}")

    def _inside(self, path: str) -> Path | None:
        try:
            direct = (self._mesh.parent / path).resolve()
            is_there = direct.is_file() and (self._root is None or direct.is_relative_to(self._root))
        except (OSError, ValueError):  # too long, or with a null character
            return None
        return direct if is_there else None

    @functools.cached_property
    def _known(self) -> list[tuple[list[str], Path]]:
        folder = self._mesh.parent
        paths = self._root.rglob("*") if self._root else (*folder.glob("*"), *folder.glob("*/*"))
        return [(_folded(path.as_posix()).split("/"), path) for path in sorted(paths) if path.is_file()]


def _folded(path: str) -> str:
    """Return a path in composed letters without case: macOS stores decomposed ones, and Windows ignores case."""
    return unicodedata.normalize("NFC", path).casefold()


def _agreeing(parts: list[str], known: list[str]) -> int:
    """Count the last parts that two paths share."""
    return next((i for i, (a, b) in enumerate(zip(parts[::-1], known[::-1], strict=False)) if a != b), len(parts))
