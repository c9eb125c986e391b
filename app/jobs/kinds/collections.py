"""The jobs that collect training data, and the one that downloads objects."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.jobs.kind import JobKind, Params
from osfcore.errors import InvalidInput
from osfcore.io.files import file_at_once
from osfcore.io.json_codec import Entry, Text

if TYPE_CHECKING:
    from app.jobs.context import JobContext

_WORDS = "data collection"


class _ObjectParams(Entry):
    name: Text


def _collect_pushes(params: Params, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_pushes import CollectPushes, collect_pushes

    yield from collect_pushes(CollectPushes(out=place.folder / "pushes.h5", **params), place.library)


def _check_pushes(params: Params, check_object: Callable[[str], object], available: int) -> None:
    if params["objects"] > available:
        allowed = f"at most {available}, as many as were fetched" if available else "0 until some have been fetched"
        raise InvalidInput("number of objects", params["objects"], allowed)


def _collect_object(params: Params, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectObject, collect_object

    out = place.folder / params["name"]
    yield from collect_object(CollectObject(out=out, **params), place.library)
    _pack(out)


def _check_name(params: Params, check_object: Callable[[str], object], available: int) -> None:
    check_object(params["name"])


def _collect_table(params: Params, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectTable, collect_table

    out = place.folder / "table"
    yield from collect_table(CollectTable(out=out, **params))
    _pack(out)


def _fetch_assets(params: Params, place: JobContext) -> Iterator[Any]:
    from osfcore.objects.fetch import fetch, source_from

    source = source_from("pypi", place.data_dir / "downloads")
    yield from fetch(tuple(params["names"]), source, place.library)


def _check_names(params: Params, check_object: Callable[[str], object], available: int) -> None:
    for name in params["names"]:
        check_object(name)


def _pack(folder: Path) -> None:
    """Put a folder into one ZIP beside it, for downloading; PNGs do not shrink, so they are only stored."""
    place = folder.with_name(f"{folder.name}.zip")
    with file_at_once(place) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))


COLLECT_PUSHES = JobKind("collect_pushes", _WORDS, _collect_pushes, check=_check_pushes, uses_physics=True)
COLLECT_OBJECT = JobKind(
    "collect_object", _WORDS, _collect_object, params=_ObjectParams, check=_check_name, uses_physics=True
)
COLLECT_TABLE = JobKind("collect_table", _WORDS, _collect_table, uses_physics=True)
FETCH_ASSETS = JobKind("fetch_assets", "download of objects", _fetch_assets, check=_check_names, has_folder=False)
