"""The job that makes a clip of an episode; it leaves it in the episode's folder."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from app.episodes.file_names import CLIP_FILE
from app.jobs.kind import JobKind
from osfcore.io.json_codec import Entry, Text

if TYPE_CHECKING:
    from app.episodes.clip import ClipStep
    from app.jobs.context import JobContext

_THREADS = 2  # the parts of the view


def clip_job(params: dict[str, Any], place: JobContext) -> Iterator[ClipStep]:
    """Draw the episode named "episode"; raises what `clip_of` does."""
    from app.episodes.clip import clip_of

    folder = place.folder.parent / params["episode"]
    with ThreadPoolExecutor(_THREADS) as executor:
        yield from clip_of(folder, place.library, folder / CLIP_FILE, executor)


class ClipParams(Entry):
    """What a stored clip must name."""

    episode: Text
    title: Text


CLIP = JobKind("clip", "clip", clip_job, params=ClipParams)
