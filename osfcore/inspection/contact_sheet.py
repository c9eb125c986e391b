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
    blocks = []
    for i in range(0, len(columns), per_row):
        shown = columns[i : i + per_row]
        rows = {truth: [c.truth for c in shown], "ours": [c.ours for c in shown]}
        differences = [DIFFERENCE_GAIN * np.abs(c.truth.astype(int) - c.ours) for c in shown]
        rows[f"diff x{DIFFERENCE_GAIN}"] = [np.clip(difference, 0, 255).astype(np.uint8) for difference in differences]
        blocks.append(_grid(rows, [c.label for c in shown], _ROW_LABEL_PX))
    return stacked(blocks)


def stacked(blocks: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> UInt8[np.ndarray, "H W 3"]:
    """Put pictures of any width below each other, with white to the right of the narrower ones."""
    width = max(block.shape[1] for block in blocks)
    padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_PAPER) for b in blocks]
    return np.vstack(padded)


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
    return _grid(rows, columns, _NAME_PX)


def _grid(
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "h w 3"]]], columns: Sequence[str], margin: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Put images of one size into rows and columns; the rows' names have a margin of so many pixels on the left."""
    height, width = next(iter(rows.values()))[0].shape[:2]
    sheet = np.full((_LABEL_PX + len(rows) * height, margin + len(columns) * width, 3), _PAPER, np.uint8)
    for number, name in enumerate(columns):
        put_text(sheet, name, (margin + number * width + 2, _LABEL_PX - 5), width - 4)
    for number, (name, images) in enumerate(rows.items()):
        top = _LABEL_PX + number * height
        put_text(sheet, name, (1, top + height // 2), margin)
        sheet[top : top + height, margin:] = np.hstack(images)
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


def write_sheet(path: Path, models: PhotoModels, photo: Photograph, found: PhotoObject) -> None:
    """Draw a PNG of the photo, the outlines of mask (red) and pose (green) in it, and the object in its pose.

    Args:
        path: of the file.
        models: of the objects.
        photo: in whose frame the pose is.
        found: the object and its pose.

    Raises:
        CannotWrite: if the disk refuses.
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
    write_png(path, np.hstack([picture, outlined, to_uint8(srgb_of_linear(albedo))]))


_VIEWS, _VIEW_SIDE = 24, 96
_FIELD_OF_VIEW_DEG = 24.0
_ELEVATION_RAD = np.deg2rad(22.0)
_LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD = np.deg2rad(-50.0), np.deg2rad(48.0)  # from the left, above the camera


def turntable_png(mesh: TexturedMesh) -> bytes:
    """Render an object that turns once under a lamp that stays: 24 views of 96 x 96 pixels, side by side, as PNG.

    It is transparent around the object, and not premultiplied.
    """
    traced = TracedMesh(mesh)
    tracer = RayTracer({"object": traced})
    distance = 1.02 * traced.radius_m / np.sin(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2)
    pictures = []
    for azimuth in 2 * np.pi * np.arange(_VIEWS) / _VIEWS:
        position = distance * _direction(azimuth, _ELEVATION_RAD)
        camera = Camera.look_at("turn", position, (0, 0, 0), size=_VIEW_SIDE, fov_y_deg=_FIELD_OF_VIEW_DEG)
        light = _direction(azimuth + _LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD)
        picture = tracer.render_alone("object", light, camera)
        alpha = picture.coverage[0]
        colour = picture.rgb / np.maximum(alpha, 1e-3)[..., None]
        pictures.append(np.dstack([to_uint8(colour[..., ::-1]), to_uint8(alpha)]))
    return cv2.imencode(".png", np.hstack(pictures), [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    level = np.cos(elevation)
    return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])
