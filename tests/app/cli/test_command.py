import io
import sys

import pytest

from app.cli.command import follow
from osfcore.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_the_last_step_comes_back_and_notes_are_shown_on_stderr(monkeypatch, capsys, stream):
    err = stream()
    monkeypatch.setattr(sys, "stderr", err)
    last = follow(Progress(i, 10, f"Converting [thing] /a ({i} of 10)") for i in range(11))
    assert last == Progress(10, 10, "Converting [thing] /a (10 of 10)")
    assert "[thing] /a" in err.getvalue()
    assert capsys.readouterr().out == ""


def test_a_log_gets_few_lines(monkeypatch):
    err = io.StringIO()
    monkeypatch.setattr(sys, "stderr", err)
    follow(Progress(i, 1000, f"Downloading ({i} MB)") for i in range(1001))
    assert 5 < len(err.getvalue().splitlines()) < 30


def test_nothing_to_do():
    assert follow(iter(())) is None


def test_errors_pass_through():
    def steps():
        yield Progress(0, 1, "Starting")
        raise KeyError("x")

    with pytest.raises(KeyError):
        follow(steps())
