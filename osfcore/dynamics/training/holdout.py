"""What training never sees, so that there is something left to measure on."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable

_ONE_IN = 16  # pairs
_EPISODES_ONE_IN = 12


def is_held_out_pair(first: str, second: str) -> bool:
    """Whether two objects never meet in training: one pair in 16, by their names alone."""
    text = "+".join(sorted((first, second)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") % _ONE_IN == 0


def has_held_out_pair(names: Iterable[str]) -> bool:
    """Whether any two of the objects never meet in training."""
    return any(is_held_out_pair(a, b) for a, b in itertools.combinations(names, 2))


def is_for_validation(number: int) -> bool:
    """Whether training stops by the episode of that number rather than learning from it."""
    return number % _EPISODES_ONE_IN == 0
