"""The jobs that collect training data, and the one that downloads objects."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE
from osfcore.io.files import file_at_once
from osfcore.objects.catalogue import DEFAULT_NAMES
from osfcore.objects.fetch import fetch, source_from

from ..kind import JobKind
from ..params import ImageCount, ImageSize, JobParams, ObjectCount, ObjectName, Seed

if TYPE_CHECKING:
    from ..context import JobContext

_WORDS = "data collection"


class CollectPushesParams(JobParams):
    """Episodes of random pushes for learning dynamics, as one HDF5 file."""

    episodes: int = Field(1000, ge=1, le=100_000)
    steps: int = Field(50, ge=1, le=1000, description="Actions of 0.2 s an episode.")
    objects: ObjectCount = Field(3, description="Objects a scene, drawn at random.")
    policy: Literal["paper", "directed"] = Field(
        "paper", description="Uniform random velocities, or a pusher that seeks sustained contact."
    )
    seed: Seed = 0
    images: bool = Field(False, description="Keep frames of camera 0 as well.")


class CollectTableParams(JobParams):
    """Images of the bare table under many lights."""

    images: ImageCount = 300
    size: ImageSize = DEFAULT_IMAGE_SIDE
    seed: Seed = 0


class CollectObjectParams(CollectTableParams):
    """Images of one object from all sides under many lights."""

    name: ObjectName


class FetchAssetsParams(JobParams):
    """Objects to fetch: from the package index, and from the official YCB download what that does not have."""

    names: list[ObjectName] = Field(default=[], max_length=64, description="Empty for all that the index has.")


def _collect_pushes(params: CollectPushesParams, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_pushes import CollectPushes, collect_pushes

    yield from collect_pushes(CollectPushes(out=place.folder / "pushes.h5", **dict(params)), place.library)


def _check_pushes(params: CollectPushesParams, check_object: Callable[[str], object], available: int) -> None:
    if params.objects > available:
        allowed = f"at most {available}, as many as were fetched" if available else "0 until some have been fetched"
        raise InvalidInput("number of objects", params.objects, allowed)


def _collect_object(params: CollectObjectParams, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectObject, collect_object

    out = place.folder / params.name
    yield from collect_object(CollectObject(out=out, **dict(params)), place.library)
    _pack(out)


def _check_name(params: CollectObjectParams, check_object: Callable[[str], object], available: int) -> None:
    check_object(params.name)


def _collect_table(params: CollectTableParams, place: JobContext) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectTable, collect_table

    out = place.folder / "table"
    yield from collect_table(CollectTable(out=out, **dict(params)))
    _pack(out)


def _fetch_assets(params: FetchAssetsParams, place: JobContext) -> Iterator[Any]:
    names = dict.fromkeys(params.names or DEFAULT_NAMES)
    indexed = tuple(name for name in names if name in DEFAULT_NAMES)
    others = tuple(name for name in names if name not in DEFAULT_NAMES)
    for chosen, source in ((indexed, "pypi"), (others, "ycb")):
        if chosen:
            yield from fetch(chosen, source_from(source, place.data_dir / "downloads"), place.library)


def _check_names(params: FetchAssetsParams, check_object: Callable[[str], object], available: int) -> None:
    for name in params.names:
        check_object(name)


def _pack(folder: Path) -> None:
    """Put a folder into one ZIP beside it, for downloading; PNGs do not shrink, so they are only stored."""
    place = folder.with_name(f"{folder.name}.zip")
    with file_at_once(place) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))


COLLECT_PUSHES = JobKind(
    "collect_pushes", _WORDS, _collect_pushes, CollectPushesParams, check=_check_pushes, uses_physics=True
)
COLLECT_OBJECT = JobKind(
    "collect_object", _WORDS, _collect_object, CollectObjectParams, check=_check_name, uses_physics=True
)
COLLECT_TABLE = JobKind("collect_table", _WORDS, _collect_table, CollectTableParams, uses_physics=True)
FETCH_ASSETS = JobKind(
    "fetch_assets", "download of objects", _fetch_assets, FetchAssetsParams, check=_check_names, has_folder=False
)
