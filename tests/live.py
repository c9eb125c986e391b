"""The real service in a process of its own."""

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_S = 60


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start_service(data_dir: Path, port: int, log: Path | None = None) -> subprocess.Popen[bytes]:
    """Start the service and wait until page and stage are ready."""
    command = [sys.executable, "-m", "app.cli", "serve", "--port", str(port), "--data-dir", str(data_dir)]
    with (log or data_dir / "service.log").open("ab") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output)
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/health", timeout=2) as answer:
                if json.load(answer)["stage"] == "ready":
                    return process
        except OSError:
            pass
        time.sleep(0.1)
    process.kill()
    process.wait()
    raise RuntimeError(f"the service did not start:\n{(log or data_dir / 'service.log').read_text()[-2000:]}")


def stop_service(process: subprocess.Popen[bytes]) -> None:
    """Ask the service to stop as Ctrl-C does."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


@contextmanager
def live_service(data_dir: Path) -> Iterator[str]:
    """The address of a service that runs while the context is open."""
    port = free_port()
    process = start_service(data_dir, port)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        stop_service(process)
