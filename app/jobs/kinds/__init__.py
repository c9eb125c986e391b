"""All kinds of jobs. A new one has a module here with its record, and a line in each of the two lists below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from osfcore.errors import InvalidInput, shown

from ..job import Job
from ..kind import JobKind
from .clips import CLIP
from .collections import COLLECT_OBJECT, COLLECT_PUSHES, COLLECT_TABLE, FETCH_ASSETS
from .episodes import EPISODE
from .estimates import ESTIMATE
from .fields import TRAIN_FIELD
from .objects import ADD_OBJECT
from .photos import PHOTO
from .robots import ROBOT

KindName = Literal[
    "collect_pushes", "collect_object", "collect_table", "fetch_assets", "add_object", "train_field", "estimate",
    "episode", "clip", "photo", "robot",
]  # fmt: skip
_ALL = (
    COLLECT_PUSHES, COLLECT_OBJECT, COLLECT_TABLE, FETCH_ASSETS, ADD_OBJECT, TRAIN_FIELD, ESTIMATE, EPISODE, CLIP,
    PHOTO, ROBOT,
)  # fmt: skip
KINDS: Mapping[str, JobKind] = {kind.name: kind for kind in _ALL}


def in_words(job: Job) -> str:
    """Return what a job is called for people."""
    return KINDS[job.kind].words if job.kind in KINDS else "job"


def check_stored(job: Job) -> None:
    """Refuse a stored job that this version cannot show or go on with.

    Raises:
        InvalidInput: if its kind is unknown, or its parameters are those of another version.
        TypeError: if settings of an episode are unknown to this version.
    """
    if job.kind not in KINDS:
        raise InvalidInput("kind of job", shown(job.kind), f"one of {', '.join(KINDS)}")
    KINDS[job.kind].params.from_json(job.params)
