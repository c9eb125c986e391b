"""The job that trains a field: take images of the mesh if there is no set, train, put the field in place.

Where there is a field of that name already, both are measured on the same held-out images, and the better one stays.
The other new one is kept with the job, so that it can be used all the same. A field as published goes to a place of its
own and never takes that of ours; it is in use at once, without such a comparison.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, model_validator

from osfcore.errors import CorruptFile
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE, FieldLibrary
from osfcore.fields.kiloosf import read_field
from osfcore.io.files import write_atomically, writing
from osfcore.io.image_file import to_uint8, write_png
from osfcore.paper.method import Method, own_field_path
from osfcore.progress import Progress

from ...storage.field_files import clear_workshop, install, install_published, open_workshop
from ..job import Job
from ..kind import JobKind
from ..params import Identifier, ImageCount, JobParams, ObjectName, Seed

if TYPE_CHECKING:
    from ..context import JobContext

PREVIEW, COMPARISON = "preview.png", "comparison.png"
_COMPARING = "Comparing it with the field that is there"
# What the parts count in the progress: about as long as they take on two cores [s], most of them for each image.
_START_S, _CARVE_S = 4, 6
_TAKE_S, _MEASURE_S, _COMPARE_S = 0.08, 0.035, 0.08


class FieldSource(JobParams):
    """What to learn a field from: a mesh, of which images are then taken first, or an uploaded image set."""

    mesh: ObjectName | None = Field(None, description="An object whose mesh is on this machine.")
    set: Identifier | None = Field(None, description="Identifier of an uploaded image set.")

    @model_validator(mode="after")
    def _names_one(self) -> FieldSource:
        if (self.mesh is None) == (self.set is None):
            raise ValueError("give either mesh or set")
        return self


class TrainFieldParams(JobParams):
    """A field to train. It replaces one of this name only if it is no worse on the same held-out images.

    But for one as published: that takes the place of an earlier one as published, and never that of ours.
    """

    name: ObjectName = Field(description="Of the field; scenes need a mesh of the same name.")
    source: FieldSource
    minutes: float = Field(30, ge=0.1, le=1440, description="How long to train [min].")
    seed: Seed = 0
    images: ImageCount = Field(300, description="Images to take of a mesh; a set has its own.")
    hollow: bool = Field(False, description="The object has hollows that no silhouette shows, such as a bowl's.")
    method: Method = Field(
        "ours",
        description='Whose field: "ours", or "paper", a KiloOSF as published, which is kept beside ours, uncompared.',
    )

    @model_validator(mode="after")
    def _fits(self) -> TrainFieldParams:
        if self.method == "paper" and self.hollow:
            raise ValueError("hollow is of our method alone; leave it out with the one as published")
        return self


@dataclass(frozen=True, slots=True)
class TrainingStep(Progress):
    """How far the job is, in seconds of work, about; while training, the note has PSNR and time left.

    Attributes:
        psnr_full: on held-out images [dB]; None until measured.
        psnr_mask: the same inside the silhouettes, dilated by 2 px [dB].
        previews: how many preview images were made so far, so that a page knows when to fetch the next.
        before_full: of the field that was there, on the same images [dB]; None if there was none, or until measured.
        before_mask: likewise, inside the silhouettes.
        in_use: whether the new field is; None until it is decided.
        left_s: time left, over all parts [s].
    """

    psnr_full: float | None = None
    psnr_mask: float | None = None
    previews: int = 0
    before_full: float | None = None
    before_mask: float | None = None
    in_use: bool | None = None
    left_s: float | None = None

    @property
    def must_be_reported(self) -> bool:
        """Whether a part begins that reports nothing before its end."""
        return self.note == _COMPARING


def train_field_job(params: TrainFieldParams, place: JobContext) -> Iterator[TrainingStep]:
    """Train a field, and put it in place unless one that is better is there.

    The same order after a kill goes on from the images and the checkpoint that are there.

    Raises:
        OsfError: if the object or the set is gone or unsound, or the disk refuses.
    """
    for step in _trained(params, place):
        yield replace(step, left_s=float(step.total - step.done))


def _trained(params: TrainFieldParams, place: JobContext) -> Iterator[TrainingStep]:
    name, mesh = params.name, params.source.mesh
    images = params.images if mesh else len(list(_uploaded(params.source, place).glob("*/*.png")))
    collect_s = _START_S + round(_TAKE_S * images) if mesh else _START_S
    train_s = _CARVE_S + max(1, round(60 * params.minutes)) + round(_MEASURE_S * images)
    compare_s = round(_COMPARE_S * images) if _is_compared(name, params.method, place) else 0
    step = TrainingStep(0, collect_s + train_s + compare_s, "Starting")
    yield step
    shop = open_workshop(place.data_dir, name, _order(params, place))
    if mesh:
        data = shop / mesh
        yield from _collect(mesh, params, data, place, step)
    else:
        data = _uploaded(params.source, place)
    step = replace(step, done=collect_s)
    if not (shop / METRICS_FILE).is_file():  # it is written last
        begin, optimise_s = step, train_s - _CARVE_S - round(_MEASURE_S * images)
        for step in _train(params, data, shop / FIELD_FILE, place.folder / PREVIEW, begin, optimise_s):
            yield step
    metrics = json.loads((shop / METRICS_FILE).read_text(encoding="utf-8"))
    step = replace(step, done=collect_s + train_s, psnr_full=metrics["psnr_full"], psnr_mask=metrics["psnr_mask"])
    if _is_compared(name, params.method, place):
        yield replace(step, note=_COMPARING)
        with contextlib.suppress(CorruptFile):  # a damaged one is replaced
            step = _compared(step, name, data, shop, place)
    in_use = step.before_mask is None or step.psnr_mask is None or step.psnr_mask >= step.before_mask
    if params.method == "paper":
        install_published(shop, own_field_path(name, place.data_dir))
    elif in_use:
        install(shop, place.data_dir / "fields" / name)
    _offer(shop, place.folder, name)
    clear_workshop(place.data_dir, name)
    note = "Done" if in_use else "Done; the field that was there is better and stays"
    yield replace(step, done=step.total, note=note, in_use=in_use)


def _is_compared(name: str, method: Method, place: JobContext) -> bool:
    """Whether a field of ours is there, and one of ours is to come."""
    return method == "ours" and name in FieldLibrary(place.data_dir).names()


def _compared(step: TrainingStep, name: str, data: Path, shop: Path, place: JobContext) -> TrainingStep:
    """Both fields on all held-out images; pictures of some, side by side, go to the job's folder."""
    from osfcore.fields.train_osf import Holdout
    from osfcore.io.image_set import read_image_set

    holdout = Holdout(read_image_set(data, "test"))
    before, new = FieldLibrary(place.data_dir).load(name), read_field(shop / FIELD_FILE)
    there, ours = holdout.everything(before), holdout.everything(new)
    write_png(place.folder / COMPARISON, _encoded(holdout.beside((before, new))))
    return replace(
        step,
        psnr_full=round(ours.psnr_full, 3),
        psnr_mask=round(ours.psnr_mask, 3),
        before_full=round(there.psnr_full, 3),
        before_mask=round(there.psnr_mask, 3),
    )


def _uploaded(source: FieldSource, place: JobContext) -> Path:
    assert source.set is not None, "it is one or the other"
    return place.data_dir / "sets" / source.set / "images"


def _order(params: TrainFieldParams, place: JobContext) -> dict[str, Any]:
    """What an earlier run must have been about for this one to go on from it: the same order of the same mesh."""
    mesh = params.source.mesh
    facts = place.library.root / mesh / "object.json" if mesh else None
    changed_at = facts.stat().st_mtime_ns if facts is not None and facts.is_file() else None
    return {**params.to_json(), "mesh_changed_at": changed_at}


def _collect(
    mesh: str, params: TrainFieldParams, out: Path, place: JobContext, begin: TrainingStep
) -> Iterator[TrainingStep]:
    from osfcore.world.collect_images import CollectObject, collect_object

    if out.is_dir():  # whole, or it would not have its name
        return
    config = CollectObject(mesh, out, params.images, seed=params.seed)
    for progress in collect_object(config, place.library):
        yield replace(begin, done=_START_S + round(_TAKE_S * progress.done), note=progress.note)


def _train(
    params: TrainFieldParams, data: Path, out: Path, preview: Path, begin: TrainingStep, train_s: int
) -> Iterator[TrainingStep]:
    """Train a field with the images in `data`, by the method that is asked for, for about `train_s`."""
    if params.method == "paper":
        from osfcore.fields.train_osf import FieldSettings
        from osfcore.paper.train_fields import train_paper_field

        steps = train_paper_field(FieldSettings(data, out, minutes=params.minutes, seed=params.seed))
    else:
        from osfcore.fields.train_kiloosf import TrainField, train_field

        config = TrainField(data, out, minutes=params.minutes, seed=params.seed, hollow=params.hollow)
        steps = train_field(config)
    previews = 0
    for step in steps:
        if step.preview is not None:
            write_png(preview, _for_eyes(step.preview))
            previews += 1
        share = step.progress.done / max(step.progress.total, 1)  # of training; before it is carved, after it measured
        yield replace(
            begin,
            done=begin.done + _CARVE_S + round(share * train_s),
            note=step.progress.note,
            psnr_full=step.psnr_full,
            psnr_mask=step.psnr_mask,
            previews=previews,
        )


def _for_eyes(strip: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Truth, rendering and difference, the first two as screens expect them."""
    pictures = 2 * strip.shape[1] // 3
    return np.hstack([_encoded(strip[:, :pictures]), strip[:, pictures:]])


def _encoded(radiance: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures as screens expect them: radiance itself looks nearly black."""
    return to_uint8(srgb_of_linear(np.arange(256) / 255))[radiance]


def _offer(shop: Path, folder: Path, name: str) -> None:
    """Copy what was made to where the job's files can be downloaded from."""
    with writing(folder):
        for file in (FIELD_FILE, METRICS_FILE):
            write_atomically(folder / f"{name}{Path(file).suffix}", (shop / file).read_bytes())


def _clear(data_dir: Path, job: Job, others: Sequence[Job]) -> None:
    """Remove what the next training of this name would find, unless another one works there."""
    name = TrainFieldParams.from_json(job.params).name
    if not any(TrainFieldParams.from_json(other.params).name == name for other in others):
        clear_workshop(data_dir, name)


TRAIN_FIELD = JobKind("train_field", "training", train_field_job, TrainFieldParams, goes_on=True, on_cancelled=_clear)
