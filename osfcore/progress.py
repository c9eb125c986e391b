"""The step that every long piece of work yields; progress, cancelling and tests need nothing else."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a piece of work.

    Attributes:
        done: units finished.
        total: units in all.
        note: what is being done, in a few words for a person.
    """

    done: int
    total: int
    note: str
