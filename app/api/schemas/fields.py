"""Requests and responses that concern fields and the image sets that they are trained from."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from app.api.schemas.common import Input
from app.api.schemas.limits import NAME, sized
from app.api.schemas.paging import PageOut
from app.services.image_sets import SetRecord


class FieldOut(BaseModel):
    """A trained field."""

    name: str
    label: str
    source: Literal["shipped", "trained"] = Field(description="With the program, or trained on this machine.")
    bytes: int = Field(description="Size of the weights.")
    metrics: dict[str, Any] = Field(description="What was measured on unseen views under unseen lights [dB].")
    published: Literal["shipped", "trained"] | None = Field(
        description="Where the field as published beside it comes from; null if there is none."
    )
    has_mesh: bool = Field(description="Whether scenes can simulate it: they need a mesh of the same name.")
    note: str | None = Field(description="What is missing, in words.")


class FieldList(BaseModel):
    """All fields, sorted by name."""

    fields: list[FieldOut]


class UseIn(Input):
    """A field that was trained and is not in use, since the one that was there was better."""

    job: str = Field(**sized(NAME), description="Identifier of the job that trained it.")


class SetOut(BaseModel):
    """An uploaded image set that was found sound."""

    id: str
    file_name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    train: int = Field(description="Images to learn from.")
    test: int = Field(description="Images that only measure.")
    summary: str

    @staticmethod
    def of(record: SetRecord) -> SetOut:
        """From the store of sets."""
        return SetOut.model_validate(record, from_attributes=True)


class SetList(PageOut):
    """Uploaded image sets, oldest first."""

    sets: list[SetOut]
