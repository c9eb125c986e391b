"""What a check of a photo's content answers; apart from the check, so that whoever asks need not load its models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["shown", "doubtful", "others", "bare", "elsewhere"]


@dataclass(frozen=True, slots=True)
class ContentCheck:
    """What a photo shows.

    Attributes:
        verdict: "shown" if the objects are in it, "doubtful" if they may be, "others" if something else is, "bare" if
            nothing stands out from the table, "elsewhere" if it does not show the table as its camera would.
        colours: share of the photo's colours that are the objects', times the share of theirs that is found in it.
        template: log of the factor by which the photometric loss grows without the object that is seen best; 0
            where the colours sufficed, or the photo shows no such table.
    """

    verdict: Verdict
    colours: float = 0.0
    template: float = 0.0
