"""Orders to the process that looks at photographs of tables, and their answers. Places are pixels of the picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from osfcore.geometry.poses import Pose
from osfcore.photo.board import Board
from osfcore.photo.calibration import Calibration, Sighting
from osfcore.photo.camera_files import KnownCamera

CameraSource = Literal["board", "given", "file", "objects", "assumed"]
Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class ReadPhoto:
    """Decode a photograph and find its camera. Answered by a PhotoRead.

    Attributes:
        data: the file as it was sent.
        focal_px: focal length in pixels of the photo as it was sent; None where nobody knows.
        camera: that took it, if it was calibrated; the focal length does not count then.
        board: that may be in view.
    """

    data: bytes
    focal_px: float | None = None
    camera: KnownCamera | None = None
    board: Board = field(default_factory=Board)


@dataclass(frozen=True, eq=False, slots=True)
class PhotoRead:
    """A decoded photograph.

    Attributes:
        jpeg: the picture, free of the lens's distortion, no side longer than 2048 px.
        straight: PNG of all its bits, free of distortion; None where the lens shows none.
        width: of the picture [px].
        height: of the picture [px].
        sent_width: of the photo as it was sent [px].
        K: intrinsics [px].
        source: where the focal length comes from.
        T_world_camera: pose over the printed board; None if the photo shows none.
        notes: sentences for the user.
    """

    jpeg: bytes
    straight: bytes | None
    width: int
    height: int
    sent_width: int
    K: tuple[tuple[float, ...], ...]
    source: CameraSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Stroke:
    """A line of the brush.

    Attributes:
        adds: whether what it covers belongs to the object; else it does not.
        radius: of the brush [px].
        points: that it runs through.
    """

    adds: bool
    radius: float
    points: Points


@dataclass(frozen=True, slots=True)
class Mark:
    """How a person points at an object.

    Attributes:
        box: left, top, right, bottom, around the object.
        on: clicks on it.
        off: clicks beside it.
        strokes: of the brush, in their order.
    """

    box: tuple[float, float, float, float]
    on: Points = ()
    off: Points = ()
    strokes: tuple[Stroke, ...] = ()


@dataclass(frozen=True, slots=True)
class FindMask:
    """Find which pixels show an object. Answered by a MaskFound.

    Attributes:
        jpeg: the picture.
        mark: where the object is.
    """

    jpeg: bytes
    mark: Mark


@dataclass(frozen=True, slots=True)
class MaskFound:
    """A mask.

    Attributes:
        png: 255 where the object is.
        outline: closed polygons around it, and around its holes.
        doubt: a sentence if it does not fill its box; "" if it does.
    """

    png: bytes
    outline: tuple[Points, ...]
    doubt: str


@dataclass(frozen=True, slots=True)
class SightBoard:
    """Find the printed board in a photograph. Answered by a Sighting.

    Attributes:
        data: the file as it was sent.
        name: of the photograph, for people.
        board: that is looked for.
    """

    data: bytes
    name: str
    board: Board = field(default_factory=Board)


@dataclass(frozen=True, eq=False, slots=True)
class AssessCamera:
    """Calibrate a camera. Answered by a Calibration.

    Attributes:
        views: of the board.
        table: of the board on the table; None if there is none.
        T_world_board: where the board lies then.
    """

    views: tuple[Sighting, ...]
    table: Sighting | None
    T_world_board: Pose


PhotoOrder = ReadPhoto | FindMask | SightBoard | AssessCamera
PhotoAnswer = PhotoRead | MaskFound | Sighting | Calibration
