"""The step that every long piece of work yields, so that progress, cancelling and tests need nothing else."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a piece of work is.

    Attributes:
        done: units finished.
        total: units in all.
        note: what is being done, in a few words for a person.
    """

    done: int
    total: int
    note: str
