"""Whether a stored job is one that this version of the program can tell of, and go on with."""

from __future__ import annotations

from typing import Any

from app.jobs.job import Job
from app.jobs.kinds.episodes import settings_of
from osfcore.io.json_codec import Entry, Text, decode


class _Named(Entry):
    name: Text


class _Source(Entry):
    mesh: Text | None
    set: Text | None


class _Training(_Named):
    source: _Source


class _Adding(_Named):
    object: dict[str, Any]
    file_name: Text


class _Of(Entry):
    scene: Text | None


class _Estimate(Entry):
    mode: Text
    names: list[Text]
    cameras: list[Text]
    of: _Of


class _Goal(Entry):
    id: Text | None


class _Episode(Entry):
    scene: Text
    names: list[Text]
    seed: int
    settings: dict[str, Any]
    goal: _Goal


class _Clip(Entry):
    episode: Text
    title: Text


class _Photo(Entry):
    photo: Text
    title: Text
    names: list[Text]


_PARAMS = {
    "collect_object": _Named,
    "add_object": _Adding,
    "train_field": _Training,
    "estimate": _Estimate,
    "episode": _Episode,
    "clip": _Clip,
    "photo": _Photo,
}


def check_stored(job: Job) -> None:
    """Refuse a job with parameters of another version.

    Raises:
        InvalidInput: if it is one.
        TypeError: if settings of an episode are unknown to this version.
    """
    params = _PARAMS.get(job.kind)
    if params is not None:
        decode(params, job.params, "job")
    if job.kind == "episode":
        settings_of(job.params["settings"])
