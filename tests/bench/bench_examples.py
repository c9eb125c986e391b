"""Whether every example reaches its goal when it is run live, with how many pushes and in what time. Run alone.

python -m tests.bench.bench_examples [--data-dir DIR] [--seeds 0 10] [--names first pair]
"""

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from app.services.examples import PRESETS
from app.storage.paths import default_data_dir
from tests.bench.bench_service import call
from tests.bench.machine import machine
from tests.live import service_of


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are; nothing is written there."""
    seeds: tuple[int, int] = (0, 10)
    """First seed of the searches, and the one after the last."""
    names: tuple[str, ...] = tuple(one.id for one in PRESETS)
    """Examples."""


def run(url: str, name: str, seed: int) -> dict:
    """What the page's "Run this live" does, by requests: the finished episode."""
    made = call(f"{url}/api/presets/{name}", {})
    asked = {"scene": made["scene"]["id"], "goal": made["goal"]["id"], "seed": seed}
    episode = call(f"{url}/api/episodes", asked)
    while episode["status"] in ("queued", "running"):
        time.sleep(1)
        episode = call(f"{url}/api/episodes/{episode['id']}")
    return episode


def main() -> None:
    """Run them, and print a line for each and a summary."""
    arguments = tyro.cli(Arguments)
    print(machine())
    with service_of(arguments.data_dir / "objects") as url:
        for name in arguments.names:
            episodes = [run(url, name, seed) for seed in range(*arguments.seeds)]
            pushes, seconds = ([one[key] for one in episodes] for key in ("done", "seconds"))
            print(json.dumps({
                "example": name,
                "reached": sum(one["outcome"] == "reached" for one in episodes),
                "of": len(episodes),
                "pushes": pushes,
                "pushes_mean": float(np.mean(pushes)),
                "seconds": seconds,
                "seconds_mean": float(np.mean(seconds)),
            }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
