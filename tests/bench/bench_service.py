"""How responsive the service stays while the world steps: REST latencies and viewer updates. Run alone on the machine.

python -m tests.bench.bench_service [--data-dir DIR] [--seconds 20]
"""

import asyncio
import json
import threading
import time
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
import viser
from websockets.asyncio.client import connect

from app.storage.paths import default_data_dir
from tests.bench.machine import machine
from tests.live import service_of

ACTIONS = [[0.2, 0.1, 0], [-0.2, 0.1, 0], [-0.2, -0.1, 0], [0.2, -0.1, 0]]


@dataclass(frozen=True)
class Arguments:
    """What to measure with."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are; nothing is written there."""
    seconds: float = 20.0
    """How long to measure."""


def call(url: str, body: object = None) -> dict:
    """One request with a JSON answer."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def push_on(url: str, scene: str, stop: threading.Event, counts: list[int]) -> None:
    """Push in circles, one request after the other, until told to stop."""
    while not stop.is_set():
        call(f"{url}/api/scenes/{scene}/actions", {"actions": ACTIONS})
        counts.append(len(ACTIONS))


async def viewer_updates(url: str, seconds: float) -> float:
    """Websocket messages a second that a browser would get from the viewer."""
    address = url.replace("http", "ws") + "/viewer"
    protocol = f"viser-v{viser.__version__}"
    async with connect(address, subprotocols=[protocol], max_size=None, origin=url) as socket:
        deadline = time.monotonic() + seconds
        await asyncio.sleep(1)  # the scene itself arrives first
        received, start = 0, time.monotonic()
        while (left := deadline - time.monotonic()) > 0:
            try:
                await asyncio.wait_for(socket.recv(), left)
            except TimeoutError:
                break
            received += 1
        return received / (time.monotonic() - start)


def latencies(url: str, paths: list[str], seconds: float) -> dict[str, np.ndarray]:
    """Milliseconds of requests for each path, 40 a second in all."""
    times: dict[str, list[float]] = {path: [] for path in paths}
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for path in paths:
            start = time.perf_counter()
            urllib.request.urlopen(url + path, timeout=30).read()
            times[path].append(1000 * (time.perf_counter() - start))
            time.sleep(0.025)
    return {path: np.array(values) for path, values in times.items()}


def main() -> None:
    """Measure and print."""
    arguments = tyro.cli(Arguments)
    print(machine())
    with service_of(arguments.data_dir / "objects") as url:
        scene = call(f"{url}/api/scenes", {"count": 3, "seed": 1})["id"]
        stop, actions, rate = threading.Event(), [], []
        pusher = threading.Thread(target=push_on, args=(url, scene, stop, actions))
        watcher = threading.Thread(target=lambda: rate.append(asyncio.run(viewer_updates(url, arguments.seconds))))
        pusher.start()
        watcher.start()
        start = time.monotonic()
        paths = ["/api/health", f"/api/scenes/{scene}", "/api/objects", "/api/jobs"]
        measured = latencies(url, paths, arguments.seconds)
        elapsed = time.monotonic() - start
        stop.set()
        pusher.join()
        watcher.join()
    every = np.concatenate(list(measured.values()))
    for path, values in measured.items():
        where = path.replace(scene, "ID")
        print(f"GET {where}: median {np.median(values):.1f} ms, p99 {np.quantile(values, 0.99):.1f} ms")
    print(f"all: median {np.median(every):.1f} ms, p99 {np.quantile(every, 0.99):.1f} ms over {len(every)} requests")
    print(f"meanwhile {sum(actions) / elapsed:.1f} actions of 0.2 s a second, viewer updates {rate[0]:.0f} a second")


if __name__ == "__main__":
    main()
