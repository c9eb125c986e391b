"""`osf demo` in a process of its own, as a person starts it."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest

from tests.app.conftest import until

OBJECT = "009_gelatin_box"


@pytest.fixture
def source(ycb_folder, tmp_path):
    """A folder to fetch one object from."""
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / OBJECT).symlink_to((ycb_folder / OBJECT).resolve())
    return folder


def demo(source, data_dir, *more, **environment):
    command = [sys.executable, "-m", "app.cli", "demo", "--source", source, "--data-dir", data_dir, "--port", "0"]
    environment = {**os.environ, "BROWSER": "", "DISPLAY": "", "WAYLAND_DISPLAY": "", **environment}
    return subprocess.Popen(
        [*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def page_of(process):
    """The address that the command prints; the page is there by then."""
    url = next((line for line in process.stdout if line.startswith("http://")), "").strip()
    assert url, process.stderr.read()
    with urllib.request.urlopen(url, timeout=20) as answer:
        assert b"<html" in answer.read()
    return url


@pytest.mark.slow
def test_from_nothing_to_the_page_in_a_browser_and_back(source, tmp_path):
    opened = tmp_path / "opened"
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > {opened}\n')
    browser.chmod(0o755)
    with demo(source, tmp_path / "data", BROWSER=f"{browser} %s") as process:
        try:
            url = page_of(process)
            assert until(lambda: opened.exists() and opened.read_text().strip()) == url
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "gelatin box" in err
    assert "Traceback" not in err
    opened.unlink()
    with demo(source, tmp_path / "data", "--no-browser", BROWSER=f"{browser} %s") as process:
        try:
            page_of(process)
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert not opened.exists()


@pytest.mark.slow
def test_a_port_that_is_taken_is_told_before_anything_is_fetched(source, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        process = demo(source, tmp_path / "data", "--port", str(port))
        _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert str(port) in err
    assert not (tmp_path / "data").exists()
