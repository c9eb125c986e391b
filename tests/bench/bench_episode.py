"""How responsive the service stays while an episode runs, with 20 clients that poll and 5 that listen. Run alone.

python -m tests.bench.bench_episode [--data-dir DIR] [--seconds 90]
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

from app.storage.paths import default_data_dir
from tests.bench.bench_service import call, viewer_updates
from tests.bench.machine import machine
from tests.live import service_of

CLIENTS, LISTENERS, POLL_S = 20, 5, 0.5


@dataclass(frozen=True)
class Arguments:
    """What to measure with."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are; nothing is written there."""
    seconds: float = 90.0
    """How long to measure; the episode's first looks and some steps take about a minute."""


def poll(url: str, paths: list[str], stop: threading.Event, times: list[float]) -> None:
    """Ask for one path after the other, twice a second, and note how long the answers take [ms]."""
    while not stop.wait(POLL_S):
        for path in paths:
            start = time.perf_counter()
            urllib.request.urlopen(url + path, timeout=30).read()
            times.append(1000 * (time.perf_counter() - start))


def listen(url: str, stop: threading.Event, counts: list[int]) -> None:
    """Read the event stream, live images and all, and count its lines."""
    with urllib.request.urlopen(f"{url}/api/events?frames=1", timeout=60) as stream:
        while not stop.is_set():
            if stream.readline().startswith(b"event:"):
                counts.append(1)


def main() -> None:
    """Measure and print."""
    arguments = tyro.cli(Arguments)
    print(machine())
    with service_of(arguments.data_dir / "objects") as url:
        made = call(f"{url}/api/presets/three", {})
        asked = {"scene": made["scene"]["id"], "goal": made["goal"]["id"], "settings": {"despite_doubts": True}}
        episode = call(f"{url}/api/episodes", asked)["id"]
        stop, events, rate = threading.Event(), [], []
        times: list[list[float]] = [[] for _ in range(CLIENTS)]
        paths = [f"/api/episodes/{episode}", "/api/health"]
        threads = [threading.Thread(target=poll, args=(url, paths, stop, own)) for own in times]
        threads += [threading.Thread(target=listen, args=(url, stop, events)) for _ in range(LISTENERS)]
        threads.append(
            threading.Thread(target=lambda: rate.append(asyncio.run(viewer_updates(url, arguments.seconds))))
        )
        for thread in threads:
            thread.start()
        time.sleep(arguments.seconds)
        stop.set()
        for thread in threads:
            thread.join()
        with urllib.request.urlopen(f"{url}/api/episodes/{episode}") as answer:
            after = json.load(answer)
    every = np.concatenate(times)
    print(f"{len(every)} requests of {CLIENTS} clients: median {np.median(every):.1f} ms, "
          f"p99 {np.quantile(every, 0.99):.1f} ms, most {every.max():.0f} ms")  # fmt: skip
    print(f"{len(events) / arguments.seconds:.1f} events a second to {LISTENERS} listeners")
    print(f"viewer updates {rate[0]:.0f} a second; meanwhile the episode did {after['done']} steps ({after['status']})")


if __name__ == "__main__":
    main()
