"""What a robot's cameras saw last, in the folder of an episode: cameras/NAME.jpg, rewritten with every look."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from app.episodes.file_names import CAMERAS_FOLDER
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.states import Observation
from osfcore.io.files import write_atomically
from osfcore.io.image_file import encode_jpeg, to_uint8


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """What a camera saw.

    Attributes:
        jpeg: the picture.
        at_s: when it had been taken, since the epoch [s].
    """

    jpeg: bytes
    at_s: float


def write_pictures(folder: Path, seen: Observation) -> None:
    """Keep what all cameras see, as cameras encode it, in place of what they saw before.

    Raises:
        CannotWrite: if the disk refuses.
    """
    for camera, image in zip(seen.cameras, seen.images, strict=True):
        write_atomically(_path(folder, camera.name), encode_jpeg(to_uint8(srgb_of_linear(image))))


def read_picture(folder: Path, camera: str) -> CameraPicture | None:
    """What a camera saw last; None if nothing was kept.

    Args:
        folder: of the episode.
        camera: its name.
    """
    path = _path(folder, camera)
    try:
        return CameraPicture(path.read_bytes(), path.stat().st_mtime)
    except OSError:
        return None


def _path(folder: Path, camera: str) -> Path:
    return folder / CAMERAS_FOLDER / f"{quote(camera, safe='')}.jpg"  # names of ROS have slashes
