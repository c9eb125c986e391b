import os
import termios
import threading

import pytest

from app.cli.commands.robots.stop_key import stop_on_key


@pytest.fixture
def terminal():
    keyboard, terminal = os.openpty()
    yield keyboard, terminal
    os.close(keyboard)
    os.close(terminal)


def test_a_key_stops_once_without_a_line_end(terminal):
    keyboard, screen = terminal
    reasons, told = [], threading.Event()
    with stop_on_key(lambda reason: (reasons.append(reason), told.set()), screen) as listens:
        assert listens
        os.write(keyboard, b"q")
        assert told.wait(10)
    assert reasons == ["a key was pressed"]


def test_without_a_key_nothing_stops_and_the_terminal_is_as_before(terminal):
    before, reasons = termios.tcgetattr(terminal[1]), []
    with stop_on_key(reasons.append, terminal[1]):
        assert termios.tcgetattr(terminal[1]) != before
    assert termios.tcgetattr(terminal[1]) == before
    assert reasons == []


def test_without_a_terminal_no_key_is_waited_for(tmp_path):
    with (tmp_path / "input").open("w+b") as file, stop_on_key(pytest.fail, file.fileno()) as listens:
        assert not listens
