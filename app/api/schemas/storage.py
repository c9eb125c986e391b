"""Responses that concern what the data directory holds."""

from __future__ import annotations

from pydantic import BaseModel, Field


class StorageOut(BaseModel):
    """What the data directory holds; figures may be half a minute old."""

    bytes: dict[str, int] | None = Field(
        description='By kind: "objects", "fields", "goals", "sets", "jobs" (episodes and estimates, too), "training", '
        '"downloads", "other"; null until it has been measured.'
    )
    total: int | None = Field(description="Of all kinds [bytes].")
    seconds_ago: float | None = Field(description="When that was measured [s].")
    allowed: int | None = Field(description="That the directory may hold [bytes]; null for any.")
    free: int = Field(description="On its disk, now [bytes].")
    must_stay_free: int = Field(description="[bytes]")


class LeftoverOut(BaseModel):
    """Files of a training that has not finished; the same order goes on from them."""

    name: str = Field(description="Of the field.")
    bytes: int
    changed_at: str = Field(description="UTC, ISO 8601.")
    job: str | None = Field(description="That trains it or waits to; null where it can be deleted.")


class LeftoverList(BaseModel):
    """All of them, sorted by name."""

    leftovers: list[LeftoverOut]
