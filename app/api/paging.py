"""Lists in pages. A page begins after a given entry, not at a count, so that nothing that comes or goes shifts it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Protocol, TypeVar

from fastapi import Query
from pydantic import BaseModel, Field

from ..storage.records import Damaged

DEFAULT_PAGE = 100
_AFTER = "The `next` of the page before; the list begins with its first entry if left out."
Limit = Annotated[int, Query(ge=1, le=500, description="Entries at most.")]
AfterJob = Annotated[int | None, Query(ge=0, le=2**53, description=_AFTER)]
AfterEntry = Annotated[str | None, Query(max_length=200, description=_AFTER)]


class DamagedOut(BaseModel):
    """Something of which the files are damaged, so that it can only be deleted."""

    id: str
    reason: str = Field(description="What is wrong with it.")

    @staticmethod
    def of(damaged: Iterable[Damaged]) -> list[DamagedOut]:
        """Return what a store has found damaged."""
        return [DamagedOut(id=each.id, reason=each.reason) for each in damaged]


class JobPageOut(BaseModel):
    """Where a page of jobs of whatever kind stands in the list."""

    total: int = Field(description="Entries in all.")
    next: int | None = Field(description="Give it as `after` to have the next page; null at the end.")


class PageOut(BaseModel):
    """Where a page stands in its list."""

    total: int = Field(description="Entries in all.")
    next: str | None = Field(description="Give it as `after` to have the next page; null at the end.")


class Entry(Protocol):
    """What is listed by when it was made."""

    @property
    def id(self) -> str:
        """Identifier."""
        ...

    @property
    def created_at(self) -> str:
        """UTC, ISO 8601."""
        ...


Listed = TypeVar("Listed", bound=Entry)


def page(
    entries: Sequence[Listed], limit: int, after: str | None, *, newest_first: bool
) -> tuple[list[Listed], int, str | None]:
    """Return some of the entries, how many there are, and where the next page begins (None at the end).

    Args:
        entries: all of them in their order, which is not that of their times if the clock was set back.
        limit: how many at most.
        after: key of the entry before the page; if it is gone meanwhile, its time says where the page begins.
        newest_first: the order.
    """
    keys = [_key(entry) for entry in entries]
    if after is None or after in keys:
        rest = entries[0 if after is None else keys.index(after) + 1 :]
    else:
        rest = [e for e in entries if (_key(e) < after if newest_first else _key(e) > after)]
    shown = list(rest[:limit])
    return shown, len(entries), _key(shown[-1]) if len(rest) > limit else None


def _key(entry: Entry) -> str:
    return f"{entry.created_at}_{entry.id}"
