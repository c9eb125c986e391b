"""The report as one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from osfcore.errors import OsfError
from osfcore.io.files import write_atomically

_TEMPLATE = "page.html.jinja"


class MissingJinja(OsfError):
    """The report cannot be written."""

    def __init__(self) -> None:
        super().__init__("The report needs jinja2; install it with: pip install 'osf-manipulation[experiments]'.")


@dataclass(frozen=True, slots=True)
class About:
    """How a report came about.

    Attributes:
        date: of the run.
        machine: in words.
        command: that was run.
        seed: of everything.
        names: objects that were drawn from.
    """

    date: str
    machine: str
    command: str
    seed: int
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PagePart:
    """One part of the page.

    Attributes:
        title: over it.
        text: under the title.
        pictures: PNGs with what they show, in words.
        heads: of the table's columns.
        rows: of the table, words as they stand there.
    """

    title: str
    text: str
    pictures: Sequence[tuple[Path, str]] = ()
    heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default=())


def check_jinja() -> None:
    """Check that a page can be written.

    Raises:
        MissingJinja: if it cannot.
    """
    try:
        import jinja2  # noqa: F401  an extra, not among what every installation has
    except ImportError:
        raise MissingJinja from None


def write_page(
    path: Path, about: About, warnings: Sequence[str], findings: Sequence[str], parts: Sequence[PagePart]
) -> None:
    """Write the report; its pictures become part of it.

    Args:
        path: of the HTML file.
        about: how it came about.
        warnings: what a reader must know first.
        findings: in sentences.
        parts: from top to bottom.

    Raises:
        CannotWrite: if the disk refuses.
        MissingJinja: if jinja2 is not installed.
    """
    check_jinja()
    import jinja2

    template = (files("osfcore.experiments.reproduction") / _TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    shown = [
        {
            "title": part.title,
            "text": part.text,
            "pictures": [{"data": _data_url(picture), "alt": alt} for picture, alt in part.pictures],
            "heads": part.heads,
            "rows": part.rows,
        }
        for part in parts
    ]
    page = environment.from_string(template).render(about=about, warnings=warnings, findings=findings, parts=shown)
    write_atomically(path, page.encode())


def _data_url(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
