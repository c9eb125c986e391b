"""A job process: runs the generator of one job, step by step, and listens for pause, resume and cancel."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from app.jobs.context import JobContext, JobControl
from app.processes.child_process import end_own_group, import_quietly, own_group
from app.processes.messages.job_messages import JobCancelled, JobRests, JobStep, RunJob
from app.processes.process_server import ProcessServer
from osfcore.errors import OsfError
from osfcore.io.files import file_at_once

STEP_INTERVAL_S = 0.1


def _collect_pushes(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_pushes import CollectPushes, collect_pushes

    yield from collect_pushes(CollectPushes(out=place.folder / "pushes.h5", **params), place.library)


def _collect_object(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectObject, collect_object

    out = place.folder / params["name"]
    yield from collect_object(CollectObject(out=out, **params), place.library)
    _pack(out)


def _collect_table(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectTable, collect_table

    out = place.folder / "table"
    yield from collect_table(CollectTable(out=out, **params))
    _pack(out)


def _fetch_assets(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from osfcore.objects.fetch import fetch, source_from

    source = source_from("pypi", place.data_dir / "downloads")
    yield from fetch(tuple(params["names"]), source, place.library)


def _add_object(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.objects import add_object_job

    yield from add_object_job(params, place)


def _train_field(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.fields import train_field_job

    yield from train_field_job(params, place)


def _estimate(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.estimates import estimate_job

    yield from estimate_job(params, place)


def _episode(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.episodes import episode_job

    yield from episode_job(params, place)


def _clip(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.clips import clip_job

    yield from clip_job(params, place)


def _photo(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.photos import photo_job

    yield from photo_job(params, place)


def _robot(params: dict[str, Any], place: JobContext) -> Iterator[Any]:
    from app.jobs.kinds.robots import robot_job

    yield from robot_job(params, place)


KINDS: dict[str, Callable[[dict[str, Any], JobContext], Iterator[Any]]] = {
    "collect_pushes": _collect_pushes,
    "collect_object": _collect_object,
    "collect_table": _collect_table,
    "fetch_assets": _fetch_assets,
    "add_object": _add_object,
    "train_field": _train_field,
    "estimate": _estimate,
    "episode": _episode,
    "clip": _clip,
    "photo": _photo,
    "robot": _robot,
}
_WITHOUT_PHYSICS = ("fetch_assets", "add_object", "train_field", "estimate", "clip", "photo", "robot")
_NOT_EXTRA = ("done", "total", "note", "view")


_LOADED = (  # by a process that waits for its job
    "osfcore.world.tabletop", "osfcore.control.closed_loop", "osfcore.control.estimators",
    "app.jobs.kinds.remote_world", "app.jobs.kinds.estimates", "osfcore.photo.summary",
    "app.episodes.record", "app.episodes.recording",
)  # fmt: skip


def _prepare() -> None:
    """Load code, and use it once."""
    for module in _LOADED:
        import_quietly(module)
    from app.jobs.kinds.rehearsal import rehearse

    with contextlib.suppress(OsfError):  # a job that lacks what this lacks says so
        rehearse()


def job_main(server: ProcessServer, is_in_reserve: bool = False) -> None:
    """Do the job that is asked for; one in reserve loads code beforehand."""
    own_group()
    if is_in_reserve:
        _prepare()
    control = JobControl(server.send)
    # A service that died leaves nobody who wants the result, and what is half-written counts as never begun.
    server.serve(lambda job, _: run_job(job, control, server.send), on_message=control.take, on_lost=end_own_group)


def run_job(
    job: RunJob, control: JobControl, send: Callable[[object], None], step_interval_s: float = STEP_INTERVAL_S
) -> dict[str, Any] | JobCancelled:
    """Do a job and tell of its steps.

    Args:
        job: what to do.
        control: orders that come meanwhile.
        send: takes JobStep and JobRests.
        step_interval_s: steps that come faster are not told one by one [s].

    Returns:
        What the last step told, or that the job was cancelled.

    Raises:
        OsfError: if the job cannot be done.
    """
    if job.kind not in _WITHOUT_PHYSICS:
        import_quietly("osfcore.world.tabletop")
    result: dict[str, Any] = {}
    last = 0.0
    context = JobContext(job.data_dir, job.folder, control)
    with contextlib.closing(KINDS[job.kind](job.params, context)) as steps:  # pyright: ignore[reportArgumentType]
        for step in steps:
            result = _extras(step)
            now = time.monotonic()
            if now - last >= step_interval_s or step.done == step.total or getattr(step, "must_be_told", False):
                send(JobStep(step.done, step.total, step.note, result, getattr(step, "view", None)))
                last = now
            if getattr(step, "ends_round", False) and control.rests_now():
                send(JobRests())
            if control.must_stop():
                return JobCancelled()
    return result


def _extras(step: object) -> dict[str, Any]:
    """What a step tells besides done, total, note and what the live view draws."""
    if not dataclasses.is_dataclass(step) or isinstance(step, type):
        return {}
    names = (field.name for field in dataclasses.fields(step))
    return {name: getattr(step, name) for name in names if name not in _NOT_EXTRA}


def _pack(folder: Path) -> None:
    """Put a folder into one ZIP beside it, for downloading; PNGs do not shrink, so they are only stored."""
    place = folder.with_name(f"{folder.name}.zip")
    with file_at_once(place) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))
