"""The real service in a process of its own."""

import json
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

START_S = 60
SMALL = {"steps": 30, "samples": 8, "horizon": 4}  # settings of an episode that is done soon


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start_service(
    data_dir: Path, port: int, log: Path | None = None, more: Sequence[str] = ()
) -> subprocess.Popen[bytes]:
    """Start the service, with more options if there are any, and wait until page and stage are ready."""
    command = [sys.executable, "-m", "app.cli", "serve", "--port", str(port), "--data-dir", str(data_dir), *more]
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


def call(port: int, method: str, path: str, body: object = None) -> Any:
    """Content of one answer, read if it is JSON."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}/api/{path}", method=method)
    if body is not None:
        request.data = json.dumps(body).encode()
        request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=60) as answer:
        content = answer.read()
    return (
        json.loads(content)
        if content and answer.headers.get("Content-Type", "").startswith("application/json")
        else content
    )


def children(process: int) -> list[int]:
    """Processes that a process has started, the newest last."""
    threads = Path(f"/proc/{process}/task").glob("*/children")
    return sorted((int(pid) for path in threads for pid in path.read_text().split()), key=_started)


def _started(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[19])


def begun(port: int, scene: str, settings: dict[str, Any]) -> str:
    """An episode whose goal no short looks ahead will reach."""
    objects = call(port, "GET", f"scenes/{scene}")["objects"]
    poses = [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in objects]
    poses[0]["position"][0] += 0.15 if poses[0]["position"][0] < 0 else -0.15
    return call(port, "POST", "episodes", {"scene": scene, "poses": poses, "settings": settings})["id"]


def resident_mb(process: int) -> float:
    """Memory of a process and of all that it has started."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text()
    found = re.search(r"^Pss: +(\d+) kB", text, re.MULTILINE)  # in which shared pages count once in all
    assert found is not None
    return int(found[1]) / 1024 + sum(resident_mb(child) for child in children(process))


@contextmanager
def service_of(objects: Path) -> Iterator[str]:
    """The address of a service with a data directory of its own, which goes with it, but the objects of a folder."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "objects").symlink_to(objects.resolve())
        with live_service(Path(folder)) as url:
            yield url
