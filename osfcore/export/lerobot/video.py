"""Images of one camera as a video that can be read from any frame on."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8

from osfcore.errors import CannotWrite
from osfcore.geometry.workspace import STEP_S

FPS = round(1 / STEP_S)
CODEC, PIXELS = "h264", "yuv420p"
_EVERY = "2"  # every other frame stands for itself: programs that learn read frames in any order, LeRobot's choice too


def write_video(path: Path, images: UInt8[np.ndarray, "T h w 3"]) -> None:
    """An MP4 of one image for each action.

    Raises:
        CannotWrite: if it cannot be encoded or written.
    """
    height, width = images.shape[1:3]
    options = ["-crf", "12", "-g", _EVERY, "-bf", "0"]
    encoder = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=FPS, codec="libx264", pix_fmt_out=PIXELS, macro_block_size=2,
        ffmpeg_log_level="error", output_params=options,
    )  # fmt: skip
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()  # tells what is wrong with the place, better than ffmpeg does
        encoder.send(None)
        for image in images:
            encoder.send(np.ascontiguousarray(image))
    except OSError as error:
        raise CannotWrite(path, error.strerror or "it could not be encoded") from error
    finally:
        encoder.close()


def video_info(height: int, width: int) -> dict[str, object]:
    """What a data set tells of its videos."""
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": CODEC,
        "video.pix_fmt": PIXELS,
        "video.is_depth_map": False,
        "video.fps": FPS,
        "video.channels": 3,
        "has_audio": False,
    }
