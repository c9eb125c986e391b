"""Rows of the database: what is written for scenes and jobs, and what is checked when it is read again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import Annotated, Any

from pydantic import Field, FiniteFloat

from app.processes.messages.scene_messages import SceneRecord
from app.storage.schema import FILE
from osfcore.errors import InvalidInput, shown
from osfcore.geometry.cameras import image_side
from osfcore.io.json_codec import Entry, Text, decode, encode
from osfcore.io.scene_file import StateJson

SCENE_COLUMNS: tuple[str, ...] = ("id", "seed", "created_at", "image_size", "initial", "state", "time_s", "revision")
SENSELESS = (ValueError, TypeError, RecursionError)  # what reading a row raises if it makes no sense
_Count = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, slots=True)
class SetAside:
    """Something stored that makes no sense to this version, and was moved out of the way.

    Attributes:
        kind: "scene", "job" or "database".
        id: identifier, or the name that a whole file has now.
        row: all that was stored, as JSON; empty for a file.
        reason: why it makes no sense.
        at: UTC, ISO 8601.
    """

    kind: str
    id: str
    row: str
    reason: str
    at: str

    @property
    def sentence(self) -> str:
        """What happened, for people."""
        if self.kind == "database":
            return f"{FILE} cannot be used: {self.reason}; it is named {self.id} now, and an empty one took its place."
        return f"The stored {self.kind} {shown(self.id)} makes no sense and was set aside: {self.reason}."


def set_aside_row(entry: SetAside) -> tuple[str, ...]:
    """Its values; halves of characters, which no database takes, are spelled out."""
    return tuple(text.encode("utf-8", "backslashreplace").decode() for text in astuple(entry))


class _Scene(Entry):
    id: Text
    seed: _Count
    created_at: Text
    image_size: int
    initial: StateJson
    state: StateJson
    time_s: Annotated[FiniteFloat, Field(ge=0)]
    revision: _Count


def scene_row(record: SceneRecord) -> tuple[Any, ...]:
    """The values of a scene in the order of the columns."""
    states = {name: json.dumps(encode(StateJson.of(getattr(record, name)))) for name in ("initial", "state")}
    return tuple(states.get(name, getattr(record, name)) for name in SCENE_COLUMNS)


def scene_of_row(row: Mapping[str, Any]) -> SceneRecord:
    """The scene in a row, by the names of the columns.

    Raises:
        ValueError, TypeError, RecursionError: if it makes no sense.
    """
    texts = {name: json.loads(row[name]) for name in ("initial", "state")}
    entry = decode(_Scene, {**row, **texts}, "scene")
    initial, state = entry.initial.state(), entry.state.state()
    if initial.names != state.names:
        raise InvalidInput("list of objects", ", ".join(state.names), f"as it began: {', '.join(initial.names)}")
    facts = {name: getattr(entry, name) for name in ("id", "seed", "created_at", "time_s", "revision")}
    return SceneRecord(**facts, image_size=image_side(entry.image_size), initial=initial, state=state)


def job_of_row(text: str, job: str | None = None) -> dict[str, Any]:
    """The fields of a job in a row, such that they can be told to pages.

    Args:
        text: that was stored.
        job: identifier of the row, if it has one.

    Raises:
        ValueError, TypeError, RecursionError: if they make no sense.
    """
    fields = json.loads(text)
    if not isinstance(fields, dict):
        raise InvalidInput("job", shown(fields), "a JSON object")
    if job is not None and fields.get("id", job) != job:
        raise InvalidInput("id", shown(fields["id"]), f"that of its row, {shown(job)}")
    json.dumps(fields, allow_nan=False, ensure_ascii=False).encode()  # neither NaN nor halves of characters
    return fields
