"""Wall time of the stages of a closed loop, without what whoever drives its generator takes between two steps."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

StepT = TypeVar("StepT")


class StageTimer:
    """Adds up seconds by stage."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time within the context."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - began

    def steps(self, name: str, steps: Iterator[StepT]) -> Iterator[StepT]:
        """Pass on steps, and count the time until each of them is there."""
        while True:
            with self.stage(name):
                step = next(steps, None)
            if step is None:
                return
            yield step

    def taken(self) -> dict[str, float]:
        """Seconds of each stage since this was asked last."""
        taken, self._seconds = self._seconds, {}
        return taken
