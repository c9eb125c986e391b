"""What the commands share: their options and libraries, the progress bar, and where results may be written."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar, Union

import tyro

from osfcore.errors import InvalidInput
from osfcore.io.output_paths import check_place

from ..storage.paths import default_data_dir

if TYPE_CHECKING:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.objects.asset_library import AssetLibrary

T = TypeVar("T")
Device = Annotated[
    Literal["auto", "cpu", "cuda"], tyro.conf.arg(help="What computes; auto takes a GPU where there is one.")
]
Seed = Annotated[int, tyro.conf.arg(help="Of everything random.")]


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """A command: its fields are the options."""

    json: bool = False
    """Print the result as one JSON object in the last line."""

    @abstractmethod
    def run(self) -> dict[str, Any]:
        """Do it; return what `--json` prints."""

    def say(self, *sentences: str) -> None:
        """Print sentences for people, at once, a line each; with `--json` nothing."""
        if not self.json:
            print(*sentences, sep="\n", flush=True)


def choice_of(**kinds: type[Command]) -> Any:  # noqa: ANN401  a type that is made while the program runs
    """Return what tyro reads as a choice between commands.

    Args:
        kinds: the command of each name.
    """
    choices = [Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items()]
    return Annotated[Union[tuple(choices)], tyro.conf.OmitSubcommandPrefixes]  # noqa: UP007


@dataclass(frozen=True, kw_only=True)
class DataCommand(Command):
    """A command that needs what this machine keeps: objects, fields, networks."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Folder for everything that osf keeps: objects, fields, networks (also: OSF_DATA_DIR)."""

    @property
    def assets(self) -> AssetLibrary:
        """The objects that were fetched or added."""
        from osfcore.objects.asset_library import AssetLibrary

        return AssetLibrary(self.data_dir / "objects")

    def say_if_no_video(self) -> None:
        """Say how to get videos, where there is nothing that encodes them."""
        from osfcore.io.video_file import ffmpeg_or_none

        if ffmpeg_or_none() is None:
            self.say("There is no video: ffmpeg is missing; get it with: pip install 'osf-manipulation[video]'")

    @property
    def trained(self) -> FieldLibrary:
        """The fields that were trained on this machine, and those that come with the program."""
        from osfcore.fields.field_library import FieldLibrary

        return FieldLibrary(self.data_dir)


def check_out(out: Path, *suffixes: str) -> str:
    """Refuse a file that cannot be written before the work begins; return which of the suffixes it has.

    Raises:
        InvalidInput: if it has none of them.
        CannotWrite: if nothing can be written there.
    """
    suffix = out.suffix.lower()
    if suffix not in suffixes:
        raise InvalidInput("output file", out, f"a path that ends in {' or '.join(suffixes)}")
    check_place(out)
    return suffix


class _Step(Protocol):
    """How far a piece of work is; `osfcore.progress.Progress` and richer steps fit."""

    @property
    def done(self) -> int: ...
    @property
    def total(self) -> int: ...
    @property
    def note(self) -> str: ...


class _StepWithProgress(Protocol):
    """A step of a kind that keeps its progress in a field."""

    @property
    def progress(self) -> _Step: ...


StepT = TypeVar("StepT", bound=_Step | _StepWithProgress)


def follow(steps: Iterable[StepT]) -> StepT | None:
    """Run through the steps and show them: as a bar with the time left on a terminal, else as a line now and then.

    Returns:
        The last step, or None if there was none.
    """
    return _follow_with_bar(steps) if sys.stderr.isatty() else _follow_with_lines(steps)


def last_of(steps: Iterable[StepT]) -> StepT:
    """Run through the steps of work that has at least one, and show them; return the last."""
    last = follow(steps)
    assert last is not None
    return last


def report_of(steps: Iterable[Any]) -> Any:  # noqa: ANN401  each kind of work has reports of its own
    """Run through the steps with a progress bar; return the report that the last one brings."""
    last = last_of(steps)
    assert last.report is not None, "the last step brings the report"
    return last.report


def _progress(step: _Step | _StepWithProgress) -> _Step:
    progress: Any = getattr(step, "progress", step)
    return progress


def _follow_with_bar(steps: Iterable[StepT]) -> StepT | None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    last = None
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None)
        for last in steps:
            now = _progress(last)
            bar.update(task, completed=now.done, total=now.total, description=now.note)
    return last


def _follow_with_lines(steps: Iterable[StepT]) -> StepT | None:
    last, shown, percent_shown = None, "", -1
    for last in steps:
        now = _progress(last)
        activity = now.note.split("(")[0]  # what follows in brackets counts up: a log needs no line for each
        percent = 100 * now.done // max(now.total, 1)
        if activity != shown or percent >= percent_shown + 5:
            print(f"[{percent:3d} %] {now.note}", file=sys.stderr, flush=True)
            shown, percent_shown = activity, percent
    return last


def show_table(rows: Iterable[Iterable[str]], titles: Iterable[str], left: Iterable[str] = ()) -> None:
    """Print a table without lines, for people.

    Args:
        rows: cells of each.
        titles: of the columns.
        left: titles of those that are not aligned at the right.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for title in titles:
        table.add_column(title, justify="left" if title in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    Console().print(table)


def options_as(kind: type[T], command: object, **others: object) -> T:
    """Return settings of the core from the options of a command that have the names of their fields.

    An option that is None leaves the settings' own default. Commands whose settings stand in a module that loads torch
    or a simulator state the options once more: taken from there, they would load it for every help page.

    Args:
        kind: of the settings.
        command: has the options.
        others: values of fields that are not taken from an option.
    """
    names = [field.name for field in fields(kind) if field.name not in others]  # pyright: ignore[reportArgumentType]
    given = {name: getattr(command, name) for name in names if getattr(command, name) is not None}
    return kind(**given, **others)
