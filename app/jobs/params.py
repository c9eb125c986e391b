"""Parameters of jobs: one model for what REST takes, what is stored, and what the job's process gets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

from osfcore.geometry.cameras import MAX_IMAGE_SIDE, MIN_IMAGE_SIDE
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.json_codec import decode

MAX_SEED = 2**31 - 1

Identifier = Annotated[str, Field(min_length=1, max_length=64)]
ObjectName = Annotated[Identifier, Field(examples=["006_mustard_bottle"])]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
ImageSize = Annotated[int, Field(ge=MIN_IMAGE_SIDE, le=MAX_IMAGE_SIDE, description="Side of the square images [px].")]
ImageCount = Annotated[int, Field(ge=60, le=5000)]  # of an image set
ObjectCount = Annotated[int, Field(ge=1, le=MAX_OBJECTS)]


class JobParams(BaseModel):
    """Parameters of one kind of job.

    REST refuses unknown members. In what was stored they are ignored, for another version may have added them.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @classmethod
    def from_json(cls, params: Mapping[str, Any]) -> Self:
        """Return the parameters that are stored with a job.

        Raises:
            InvalidInput: if they are those of another kind, or of a version that this one does not understand.
        """
        return decode(cls, params, "job", is_stored=True)

    def to_json(self) -> dict[str, Any]:
        """Return what `from_json` reads, as JSON."""
        return self.model_dump(mode="json")
