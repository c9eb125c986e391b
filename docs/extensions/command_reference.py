"""Sphinx extension: appends what `--help` of every command prints to the page `reference/commands`."""

import io
import os
import re
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from pathlib import Path

from sphinx.application import Sphinx

from app.cli.main import COMMANDS, main

PAGE = "reference/commands"


def help_of(*words: str) -> str:
    """Return what a command prints when it is asked for help, with the home folder as `~`."""
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        main([*words, "--help"])
    lines = printed.getvalue().replace(f"{Path.home()}/", "~/").splitlines()
    return "\n".join(line.rstrip() for line in lines).strip()


def sections() -> Iterator[str]:
    """Yield a section of Markdown for each command, and one within it for each of its subcommands."""
    for command in COMMANDS:
        text = help_of(command)
        yield f"## osf {command}\n\n```text\n{text}\n```"
        choice = re.match(rf"usage: osf {command} \[-h\] \{{([\w,]+)\}}\n", text)
        for sub in choice[1].split(",") if choice else ():
            yield f"### osf {command} {sub}\n\n```text\n{help_of(command, sub)}\n```"


def fill(_app: Sphinx, page: str, source: list[str]) -> None:
    """Append the sections to their page when it is read."""
    if page == PAGE:
        os.environ["COLUMNS"] = "80"  # what fits beside the site's menu
        os.environ.pop("OSF_DATA_DIR", None)  # the default is shown, and not this machine's choice
        source[0] = "\n\n".join([source[0], *sections()])


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True}
