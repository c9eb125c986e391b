"""A progress bar on stderr for anything that yields steps with `done`, `total` and `note`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Protocol, TypeVar


class Step(Protocol):
    """How far a piece of work is; `osfcore.progress.Progress` and richer steps fit."""

    @property
    def done(self) -> int:
        """Units finished."""
        ...

    @property
    def total(self) -> int:
        """Units in all."""
        ...

    @property
    def note(self) -> str:
        """What is being done."""
        ...


StepT = TypeVar("StepT", bound=Step)


def follow(steps: Iterable[StepT]) -> StepT | None:
    """Run through the steps and show them: as a bar with the time left on a terminal, else as a line now and then.

    Returns:
        The last step, or None if there was none.
    """
    return _follow_with_bar(steps) if sys.stderr.isatty() else _follow_with_lines(steps)


def _follow_with_bar(steps: Iterable[StepT]) -> StepT | None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    last = None
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None)
        for last in steps:
            bar.update(task, completed=last.done, total=last.total, description=last.note)
    return last


def _follow_with_lines(steps: Iterable[StepT]) -> StepT | None:
    last, shown, percent_shown = None, "", -1
    for last in steps:
        activity = last.note.split("(")[0]  # what follows in brackets counts up: a log needs no line for each
        percent = 100 * last.done // max(last.total, 1)
        if activity != shown or percent >= percent_shown + 5:
            print(f"[{percent:3d} %] {last.note}", file=sys.stderr, flush=True)
            shown, percent_shown = activity, percent
    return last
