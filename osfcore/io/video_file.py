"""Images as an MP4 that browsers, players and programs that learn show in the same colours: H.264, 4:2:0, BT.709.

ffmpeg converts to BT.601 unless told otherwise, and players take a high picture without tags for BT.709: saturated
colours are then up to a tenth off. So the file is BT.709, and says so. Its index comes first: browsers play it before
they have all of it.

ffmpeg is a program of its own, under the GPL where it encodes H.264: the extra video brings one, and one on the path
serves as well.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from osfcore.errors import CannotWrite, InvalidInput
from osfcore.extras import missing, need
from osfcore.io.files import file_at_once

_COLOURS = "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709"


def ffmpeg_or_none() -> str | None:
    """Return the program that encodes: that of the extra video, else the one on the path, if there is any."""
    if missing("video"):
        return shutil.which("ffmpeg")
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()


def need_ffmpeg(what: str) -> str:
    """Return the program that encodes.

    Args:
        what: needs it, for the sentence.

    Raises:
        MissingExtra: if there is none.
    """
    program = ffmpeg_or_none()
    if program is None:
        need("video", what)
        raise AssertionError("without ffmpeg, the extra is missing")
    return program


@contextmanager
def mp4_at_once(
    path: Path, width: int, height: int, fps: float, *options: str
) -> Iterator[Callable[[UInt8[np.ndarray, "h w 3"]], None]]:
    """Give a function that takes the images one by one; the file appears only when it is whole.

    Args:
        path: an MP4, which is replaced.
        width: of the images, even [px].
        height: of the images, even [px].
        fps: images a second.
        options: of ffmpeg's encoder, such as "-crf", "20".

    Raises:
        MissingExtra: if there is no ffmpeg.
        InvalidInput: if an image is of another size or kind.
        CannotWrite: if it cannot be encoded or written; what was there before is untouched.
    """
    command = [need_ffmpeg("A video"), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-", "-vf", _COLOURS, "-an", "-vcodec", "libx264"]
    command += ["-pix_fmt", "yuv420p", *options, "-movflags", "+faststart", "-f", "mp4"]
    with file_at_once(path) as partial:
        ffmpeg = subprocess.Popen([*command, str(partial)], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        assert ffmpeg.stdin is not None
        pipe = ffmpeg.stdin

        def put(image: np.ndarray) -> None:  # checked by hand: a wrong one would shift all that follow
            if image.shape != (height, width, 3) or image.dtype != np.uint8:
                is_now = f"{image.dtype} {image.shape}"
                raise InvalidInput("image of a video", is_now, f"uint8 {(height, width, 3)}")
            pipe.write(np.ascontiguousarray(image).data)

        try:
            yield put
        except BrokenPipeError:
            pass  # ffmpeg has ended: its exit status is looked at below
        except BaseException:
            ffmpeg.kill()
            raise
        finally:
            _, said = ffmpeg.communicate()
        if ffmpeg.returncode:
            last = said.decode(errors="replace").rstrip().rpartition("] ")[2]  # after the part of ffmpeg that says it
            raise CannotWrite(path, last or "it could not be encoded")
