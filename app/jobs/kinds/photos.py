"""The job that finds objects and lamp in photographs of one table.

Its inputs: for photo K `K`, the file free of distortion, and `K_NAME.png`, the masks of marked objects; cameras stand
in the parameters. It leaves `found.json` and a sheet `NAME.J.png` of each pose that explains the first photo.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import Field

from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.io.files import write_json
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, Vector4, encode
from osfcore.progress import Progress
from osfcore.random_streams import Stream, stream_rng

from ..job import INPUTS
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from osfcore.photo.photograph import Photograph
    from osfcore.photo.poses import PhotoModels, PhotoObject

    from ..context import JobContext

FOUND = "found.json"


class PhotoInput(Entry):
    """One photograph of the job.

    Attributes:
        K: intrinsics [px].
        T_world_camera: pose over the printed board; None if the photo shows none.
        names: of the objects that are marked in it.
        focal_known: whether its focal length is more than a guess.
        boxes: drawn around objects whose outlines nobody painted, by name [px].
    """

    K: Matrix3
    T_world_camera: Matrix4 | None
    names: list[Text]
    focal_known: bool = True
    boxes: dict[Text, Vector4] = Field(default_factory=dict)


class PhotoParams(JobParams):
    """Photographs of one table, the first of which is the one that is looked at.

    Attributes:
        photo: identifier of the first.
        title: what it is called.
        names: of all objects that are marked.
        seed: of the searches.
        notes: what a person should know of the first.
        photos: all of them.
        board: that the first may show, as `board_of` reads it.
    """

    photo: str
    title: str
    names: tuple[str, ...]
    seed: int
    notes: tuple[str, ...]
    photos: tuple[PhotoInput, ...]
    board: str = ""


@dataclass(frozen=True, slots=True)
class Finding(Progress):
    """How far the job is.

    Attributes:
        found: how many objects were found so far.
    """

    found: int = 0


def sheet_name(name: str, choice: int) -> str:
    """The file with the sheet of one of an object's poses."""
    return f"{name}.{choice}.png"


def photo_job(params: PhotoParams, place: JobContext) -> Iterator[Finding]:
    """Find the objects.

    Raises:
        OsfError: if an object has no field, nothing can be found, or the disk refuses.
    """
    from osfcore.photo.board import board_of
    from osfcore.photo.poses import PhotoConfig, PhotoModels, estimate_photo
    from osfcore.photo.summary import summarised

    yield Finding(0, 0, "Loading fields")
    names, folder = params.names, place.folder / INPUTS
    photos = [_photograph(folder, number, order) for number, order in enumerate(params.photos)]
    fields = FieldLibrary(place.data_dir)
    models = PhotoModels({name: fields.load(name) for name in names})
    rng = stream_rng(params.seed, Stream.PHOTO_SEARCH)
    step = None
    config = PhotoConfig(focal_known=params.photos[0].focal_known)
    for step in estimate_photo(models, photos, names, rng, config):
        yield Finding(step.progress.done, step.progress.total + 1, step.progress.note, len(step.found))
    assert step is not None
    yield Finding(step.progress.total, step.progress.total + 1, "The lamp", len(step.found))
    write_json(place.folder / FOUND, encode(summarised(step, models, params.notes, board_of(params.board))))
    for found in step.found:
        if found.name in step.photos[0].masks:
            _draw_sheets(place.folder, models, step.photos[0], found)
    yield Finding(step.progress.total + 1, step.progress.total + 1, "Done", len(step.found))


def inputs_of(number: int, sent: Path, masks: Mapping[str, Path]) -> dict[str, Path]:
    """What the inputs of one photograph are called, and what is copied there."""
    return {str(number): sent, **{f"{number}_{name}.png": path for name, path in masks.items()}}


def _photograph(folder: Path, number: int, order: PhotoInput) -> Photograph:
    from osfcore.photo.read_photograph import read_photograph, to_photograph

    T = None if order.T_world_camera is None else Pose.from_matrix(np.array(order.T_world_camera))
    masks = {name: _mask(folder / f"{number}_{name}.png") for name in order.names}
    photo = to_photograph(read_photograph(folder / str(number)), np.array(order.K), T, masks)
    boxes = {name: (left, top, right, bottom) for name, (left, top, right, bottom) in order.boxes.items()}
    return photo.with_masks(masks, boxes)


def _mask(path: Path) -> np.ndarray:
    decoded = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    return decoded > 127


def _draw_sheets(folder: Path, models: PhotoModels, photo: Photograph, found: PhotoObject) -> None:
    from osfcore.inspection.contact_sheet import write_sheet

    for choice, pose in enumerate((found.best, *found.rivals)):
        write_sheet(folder / sheet_name(found.name, choice), models, photo, replace(found, best=pose))


PHOTO = JobKind(
    "photo", "look at a photo", photo_job, PhotoParams, preloads=("osfcore.photo.summary",), ends_at_once=True
)
