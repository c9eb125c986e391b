"""The process that decodes photographs of tables, finds their cameras and the masks of objects in them.

Decoders have defects, so strangers' files are looked at here only: it may die or be ended without hurting the service.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool

from osfcore.errors import CorruptFile, OsfError
from osfcore.io.image_file import encode_png

from .child_process import limit_memory
from .messages.photo_messages import (
    AssessCamera,
    FindMask,
    Mark,
    MaskFound,
    PhotoAnswer,
    PhotoOrder,
    PhotoRead,
    ReadPhoto,
    SightBoard,
)
from .server import ProcessServer

if TYPE_CHECKING:
    from osfcore.photo.read_photograph import RawPhotograph


_MEMORY_BYTES = 3 << 29  # sound photos take two thirds of it
_JPEG_QUALITY = 95


class PhotoRefused(OsfError):
    """A photo that cannot be used."""


def photo_main(server: ProcessServer) -> None:
    """Look at the photographs that are sent."""
    limit_memory(_MEMORY_BYTES)
    server.serve(lambda order, _: carry_out(order))


def carry_out(order: PhotoOrder) -> PhotoAnswer:
    """Do what an order says.

    Raises:
        PhotoRefused: if the photo cannot be used, or shows no board or one that contradicts others where it should.
        InvalidInput: if the focal length or a mark makes no sense.
    """
    from osfcore.photo.calibration import assess, sight
    from osfcore.photo.read_photograph import read_photograph

    try:
        match order:
            case ReadPhoto():
                return _read(order, read_photograph(order.data))
            case SightBoard():
                return sight(read_photograph(order.data), order.name, order.board)
            case AssessCamera():
                return assess(order.views, order.table, order.T_world_board)
            case FindMask():
                return _mask(order)
    except CorruptFile as error:
        raise PhotoRefused(str(error)) from None


def _read(order: ReadPhoto, raw: RawPhotograph) -> PhotoRead:
    from osfcore.photo.summary import locate, locate_calibrated

    camera, board = order.camera, order.board
    found = locate(raw, order.focal_px, board) if camera is None else locate_calibrated(raw, camera, board)
    height, width = found.raw.encoded.shape[:2]
    return PhotoRead(
        _encoded(".jpg", found.raw.eight_bit, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]),
        _encoded(".png", found.raw.encoded) if found.lens.radial else None,
        width,
        height,
        raw.sent_size[0],
        tuple(tuple(float(value) for value in row) for row in found.intrinsics),
        found.source,
        found.T_world_camera,
        found.notes,
    )


def _encoded(kind: str, picture: np.ndarray, options: list[int] | None = None) -> bytes:
    done, encoded = cv2.imencode(kind, picture[..., ::-1], options or [])
    assert done
    return encoded.tobytes()


def _mask(order: FindMask) -> MaskFound:
    from osfcore.photo.segmentation import outline_doubt, outline_of, propose_mask

    picture, mark = cv2.imdecode(np.frombuffer(order.jpeg, np.uint8), cv2.IMREAD_COLOR_RGB), order.mark
    assert picture is not None
    add, remove = _painted(mark, picture.shape[:2])
    clicks = (np.reshape(np.array(points, float), (-1, 2)) for points in (mark.on, mark.off))
    mask = propose_mask(picture, mark.box, *clicks, add=add, remove=remove)
    doubt = "" if mark.strokes else outline_doubt("the object", mark.box, mask)  # what is painted was judged by eye
    return MaskFound(encode_png(np.where(mask, 255, 0).astype(np.uint8)), outline_of(mask), doubt)


def _painted(mark: Mark, shape: tuple[int, int]) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """What the brush adds and what it takes away; of strokes that cross the last one counts."""
    canvas = np.zeros(shape, np.uint8)
    for stroke in mark.strokes:
        value, thickness = (1 if stroke.adds else 2), max(round(2 * stroke.radius), 1)
        points = np.floor(np.array(stroke.points)).astype(np.int32)
        cv2.polylines(canvas, [points], False, value, thickness)
        for x, y in points[[0, -1]].tolist():
            cv2.circle(canvas, (x, y), max(round(stroke.radius), 1), value, -1)
    return canvas == 1, canvas == 2
