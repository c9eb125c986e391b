"""The job that trains a field: take images of the mesh if there is no set, train, put the field in place."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.storage.field_files import clear_workshop, install, open_workshop
from osfcore.errors import CannotWrite
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE
from osfcore.io.files import write_atomically
from osfcore.io.image_file import write_png

if TYPE_CHECKING:
    from app.jobs.context import JobContext

PREVIEW = "preview.png"
_S_PER_IMAGE = 0.03  # what taking an image counts in the progress, about as long as it takes


@dataclass(frozen=True, slots=True)
class TrainingStep:
    """How far the job is.

    Attributes:
        done: seconds of work done, about.
        total: seconds of work in all.
        note: what is being done; while training with PSNR and time left.
        psnr_full: on held-out images [dB]; None until measured.
        psnr_mask: the same inside the silhouettes, dilated by 2 px [dB].
        previews: how many preview images were made so far, so that a page knows when to fetch the next.
    """

    done: int
    total: int
    note: str
    psnr_full: float | None = None
    psnr_mask: float | None = None
    previews: int = 0


def train_field_job(params: dict[str, Any], place: JobContext) -> Iterator[TrainingStep]:
    """Train a field and put it in place.

    The same order after a kill goes on from the images and the checkpoint that are there.

    Raises:
        OsfError: if the object or the set is gone or unsound, or the disk refuses.
    """
    name, mesh = params["name"], params["source"]["mesh"]
    train_s = max(1, round(60 * params["minutes"]))
    collect_s = round(_S_PER_IMAGE * params["images"]) if mesh else 0
    step = TrainingStep(0, collect_s + train_s, "Starting")
    yield step
    shop = open_workshop(place.data_dir, name, _order(params, place))
    if mesh:
        data = shop / mesh
        yield from _collect(mesh, params, data, place, step)
    else:
        data = place.data_dir / "sets" / params["source"]["set"] / "images"
    step = replace(step, done=collect_s)
    if not (shop / METRICS_FILE).is_file():  # it is written last
        begin = step
        for step in _train(params, data, shop / FIELD_FILE, place.folder / PREVIEW, begin):
            yield step
    install(shop, place.data_dir / "fields" / name)
    _offer(shop, place.folder, name)
    metrics = json.loads((shop / METRICS_FILE).read_text(encoding="utf-8"))
    clear_workshop(place.data_dir, name)
    yield replace(
        step,
        done=step.total,
        note="Done",
        psnr_full=metrics.get("psnr_full", step.psnr_full),
        psnr_mask=metrics.get("psnr_mask", step.psnr_mask),
    )


def _order(params: dict[str, Any], place: JobContext) -> dict[str, Any]:
    """What an earlier run must have been about for this one to go on from it: the same order of the same mesh."""
    mesh = params["source"]["mesh"]
    facts = place.library.root / mesh / "object.json" if mesh else None
    changed_at = facts.stat().st_mtime_ns if facts is not None and facts.is_file() else None
    return {**params, "mesh_changed_at": changed_at}


def _collect(
    mesh: str, params: dict[str, Any], out: Path, place: JobContext, begin: TrainingStep
) -> Iterator[TrainingStep]:
    from osfcore.world.collection.collect_images import CollectObject, collect_object

    if out.is_dir():  # whole, or it would not have its name
        return
    config = CollectObject(mesh, out, params["images"], seed=params["seed"])
    for progress in collect_object(config, place.library):
        yield replace(begin, done=round(_S_PER_IMAGE * progress.done), note=progress.note)


def _train(params: dict[str, Any], data: Path, out: Path, preview: Path, begin: TrainingStep) -> Iterator[TrainingStep]:
    from osfcore.fields.training.kiloosf_training import train_field
    from osfcore.fields.training.recipes import TrainField

    config = TrainField(data, out, minutes=params["minutes"], seed=params["seed"], hollow=params["hollow"])
    previews = 0
    for step in train_field(config):
        if step.preview is not None:
            write_png(preview, step.preview)
            previews += 1
        share = step.progress.done / max(step.progress.total, 1)
        yield replace(
            begin,
            done=begin.done + round(share * (begin.total - begin.done)),
            note=step.progress.note,
            psnr_full=step.psnr_full,
            psnr_mask=step.psnr_mask,
            previews=previews,
        )


def _offer(shop: Path, folder: Path, name: str) -> None:
    """Copy what was made to where the job's files can be downloaded from."""
    try:
        for file in (FIELD_FILE, METRICS_FILE):
            write_atomically(folder / f"{name}{Path(file).suffix}", (shop / file).read_bytes())
    except OSError as error:
        raise CannotWrite(folder, error.strerror or str(error)) from error
