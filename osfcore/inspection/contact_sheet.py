"""Contact sheets: truth, ours and the difference; photographed objects; one object from all around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import to_uint8, write_png
from osfcore.objects.asset import TexturedMesh
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import draw, object_windows
from osfcore.photo.poses import FINE_ACROSS, PhotoModels, PhotoObject
from osfcore.world.imaging import RayTracer, TracedMesh

DIFFERENCE_GAIN = 4
_LABEL_PX = 16
_ROW_LABEL_PX = 40
_NAME_PX = 76  # of a row of a grid
_PAPER = 255


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """One column of a contact sheet.

    Attributes:
        label: a few letters above it.
        truth: the image as it should be.
        ours: the image as it is.
    """

    label: str
    truth: UInt8[np.ndarray, "h w 3"]
    ours: UInt8[np.ndarray, "h w 3"]


def contact_sheet(
    columns: Sequence[Comparison], *, per_row: int = 8, truth: str = "truth"
) -> UInt8[np.ndarray, "H W 3"]:
    """Put columns side by side, in blocks of `per_row`: truth, ours and four times their absolute difference.

    Args:
        columns: at least one.
        per_row: columns in a block.
        truth: name of the first row, in a few letters.

    Raises:
        InvalidInput: if there is nothing to show, or sizes differ.
    """
    if len({c.truth.shape for c in columns} | {c.ours.shape for c in columns}) != 1:
        raise InvalidInput("images of a contact sheet", f"{len(columns)} pairs", "at least one, all of one size")
    blocks = [_block(columns[i : i + per_row], truth) for i in range(0, len(columns), per_row)]
    width = max(block.shape[1] for block in blocks)
    padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_PAPER) for b in blocks]
    return np.vstack(padded)


def _block(columns: Sequence[Comparison], first: str) -> UInt8[np.ndarray, "H W 3"]:
    """Put columns into three rows, with a line of labels above and a margin of row names on the left."""
    height, width = columns[0].truth.shape[:2]
    sheet = np.full((_LABEL_PX + 3 * height, _ROW_LABEL_PX + len(columns) * width, 3), _PAPER, np.uint8)
    for row, name in enumerate((first, "ours", f"diff x{DIFFERENCE_GAIN}")):
        put_text(sheet, name, (1, _LABEL_PX + row * height + height // 2), _ROW_LABEL_PX)
    for number, column in enumerate(columns):
        left = _ROW_LABEL_PX + number * width
        put_text(sheet, column.label, (left + 2, _LABEL_PX - 5), width - 4)
        difference = np.abs(column.truth.astype(int) - column.ours)
        shown = np.clip(DIFFERENCE_GAIN * difference, 0, 255).astype(np.uint8)
        for row, image in enumerate((column.truth, column.ours, shown)):
            top = _LABEL_PX + row * height
            sheet[top : top + height, left : left + width] = image
    return sheet


def image_grid(
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "h w 3"]]], columns: Sequence[str]
) -> UInt8[np.ndarray, "H W 3"]:
    """Put images into rows and columns, with the columns' names above and the rows' on the left.

    Args:
        rows: by name.
        columns: names, as many as each row has images.

    Raises:
        InvalidInput: if there is nothing to show, rows differ in length, or images in size.
    """
    shapes = {image.shape for row in rows.values() for image in row}
    if len(shapes) != 1 or {len(row) for row in rows.values()} != {len(columns)}:
        raise InvalidInput("images of a grid", f"{len(rows)} rows", "full rows of images, all of one size")
    height, width = shapes.pop()[:2]
    sheet = np.full((_LABEL_PX + len(rows) * height, _NAME_PX + len(columns) * width, 3), _PAPER, np.uint8)
    for number, name in enumerate(columns):
        put_text(sheet, name, (_NAME_PX + number * width + 2, _LABEL_PX - 5), width - 4)
    for number, (name, images) in enumerate(rows.items()):
        top = _LABEL_PX + number * height
        put_text(sheet, name, (1, top + height // 2), _NAME_PX)
        sheet[top : top + height, _NAME_PX:] = np.hstack(images)
    return sheet


def put_text(sheet: UInt8[np.ndarray, "H W 3"], text: str, place: tuple[int, int], width: int) -> None:
    """Write small black letters into an image, in place.

    Args:
        sheet: the image.
        text: letters that do not fit are left out at its end.
        place: (x, y) of the lower left corner of the text [px].
        width: room for the text [px].
    """
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.32
    while text and cv2.getTextSize(text, font, scale, 1)[0][0] > width:
        text = text[:-1]
    cv2.putText(sheet, text, place, font, scale, (0, 0, 0), 1, cv2.LINE_AA)


_SIDE = 180  # of a mask [px]
_MASK_COLOUR, _FOUND_COLOUR = (255, 60, 60), (60, 220, 60)


def sheet(models: PhotoModels, photo: Photograph, found: PhotoObject) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the photo, the outlines of the mask (red) and of the pose (green) in it, and the object in its pose.

    Args:
        models: of the objects.
        photo: in whose frame the pose is.
        found: the object and its pose.
    """
    window = object_windows([photo], found.name, _SIDE)[0]
    surfels, pose = models.surfels(found.name, FINE_ACROSS), found.best.pose
    index = draw(surfels, window, Pose(pose.position[None], pose.quaternion[None]))[0][0]
    shown = index >= 0
    picture = to_uint8(srgb_of_linear(window.image))
    outlined = picture.copy()
    for mask, colour in ((window.mask, _MASK_COLOUR), (shown, _FOUND_COLOUR)):
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(outlined, contours, -1, colour, 1)
    albedo = np.where(shown[..., None], surfels.albedo[np.maximum(index, 0)], 0)
    return np.hstack([picture, outlined, to_uint8(srgb_of_linear(albedo))])


def write_sheet(path: Path, models: PhotoModels, photo: Photograph, found: PhotoObject) -> None:
    """Write a sheet as PNG.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_png(path, sheet(models, photo, found))


VIEWS, SIDE = 24, 96
_FIELD_OF_VIEW_DEG = 24.0
_ELEVATION_RAD = np.deg2rad(22.0)
_LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD = np.deg2rad(-50.0), np.deg2rad(48.0)  # from the left, above the camera


def turntable(mesh: TexturedMesh, views: int = VIEWS, side: int = SIDE) -> UInt8[np.ndarray, "side width 4"]:
    """Render an object that turns once under a lamp that stays, by the project's image model; views side by side.

    Args:
        mesh: the object.
        views: how many, 360 / views degrees apart.
        side: of each [px].

    Returns:
        RGBA, transparent around the object; not premultiplied.
    """
    traced = TracedMesh(mesh)
    tracer = RayTracer({"object": traced})
    distance = 1.02 * traced.radius_m / np.sin(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2)
    pictures = []
    for azimuth in 2 * np.pi * np.arange(views) / views:
        position = distance * _direction(azimuth, _ELEVATION_RAD)
        camera = Camera.look_at("turn", position, (0, 0, 0), size=side, fov_y_deg=_FIELD_OF_VIEW_DEG)
        light = _direction(azimuth + _LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD)
        picture = tracer.render_alone("object", light, camera)
        alpha = picture.coverage[0]
        colour = picture.rgb / np.maximum(alpha, 1e-3)[..., None]
        pictures.append(np.concatenate([to_uint8(colour), to_uint8(alpha)[..., None]], axis=-1))
    return np.concatenate(pictures, axis=1)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    level = np.cos(elevation)
    return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])


def turntable_png(mesh: TexturedMesh) -> bytes:
    """Return the views of `turntable` as PNG."""
    picture = turntable(mesh)
    in_file_order = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    return cv2.imencode(".png", in_file_order, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()
