"""The job that makes a clip of an episode; it leaves it in the episode's folder."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from ...episodes.file_names import CLIP_FILE
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from ...episodes.clip import ClipStep
    from ..context import JobContext

_THREADS = 2  # the parts of the view


class ClipParams(JobParams):
    """The episode, and what it is called."""

    episode: str
    title: str


def clip_job(params: ClipParams, place: JobContext) -> Iterator[ClipStep]:
    """Draw the episode named "episode"; raises what `clip_of` does."""
    from ...episodes.clip import clip_of

    folder = place.folder.parent / params.episode
    with ThreadPoolExecutor(_THREADS) as executor:
        yield from clip_of(folder, place.library, folder / CLIP_FILE, executor)


CLIP = JobKind("clip", "clip", clip_job, ClipParams)
