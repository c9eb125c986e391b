"""How fast the simulated tabletop is, by each simulator: observations, actions, scenes, episodes. Run alone.

python -m tests.bench.bench_world [--data-dir DIR] [--episodes 60]
"""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import tyro

from app.storage.paths import default_data_dir
from osfcore.geometry.cameras import default_cameras
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.simulators import Simulator
from osfcore.world.tabletop import Tabletop
from osfcore.world.tiny_renderer import TinyScene
from tests.bench.machine import machine


@dataclass(frozen=True)
class Arguments:
    """What to measure with."""

    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are."""
    episodes: int = 60
    """Episodes of 50 steps per policy."""
    scenes: int = 20
    """Scenes over which observations are averaged."""


def milliseconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Median time of a call [ms]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - start))
    return float(np.median(times))


def observations(library: AssetLibrary, scenes: int) -> None:
    """Four views of random three-object scenes, against TinyRenderer."""
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        rows: dict[str, list[float]] = {}
        fast, plain = Tabletop(library, executor=threads), Tabletop(library)
        for seed in range(scenes):
            fast.arrange(seed)
            plain.arrange(seed)
            fast.observe(masks=True)  # builds ray structures of objects not seen before
            plain.observe(masks=True)
            for name, world in (("embree, all cores", fast), ("embree, one core", plain)):
                rows.setdefault(name, []).append(milliseconds(partial(world.observe, masks=True)))
            for name, shadow in (("TinyRenderer with its shadow", True), ("TinyRenderer without", False)):
                tiny = TinyScene(plain.assets, shadow=shadow)
                state = plain.truth()
                render = milliseconds(partial(tiny.render, state, default_cameras()), 3)
                rows.setdefault(name, []).append(render)
                tiny.close()
        for name, values in rows.items():
            print(
                f"observation, 4 views 128 x 128, 3 objects + pusher, {name}: "
                f"median {np.median(values):.0f} ms, worst {np.max(values):.0f} ms"
            )
        fast.close()
        plain.close()


def physics(library: AssetLibrary, simulator: Simulator) -> None:
    """Scenes and actions."""
    for count in (3, 8):
        if count > len(library.names()):
            continue
        world = Tabletop(library, request=SceneRequest(count=count), conditions=Conditions(simulator=simulator))
        world.arrange(0)
        arrange = np.median([milliseconds(partial(world.arrange, seed), 1) for seed in range(10)])
        actions = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2)), np.zeros(50)])
        act = np.median([milliseconds(partial(world.act, action), 1) for action in actions])
        print(
            f"{simulator}, {count} objects: new scene {arrange:.0f} ms, "
            f"action of 0.2 s {act:.1f} ms ({200 / act:.0f} x real time)"
        )
        world.close()


def episodes(library: AssetLibrary, count: int, simulator: Simulator) -> None:
    """Collecting pushes with two workers; processes are started before the clock."""
    for policy in ("paper", "directed"):
        with (
            tempfile.TemporaryDirectory() as folder,
            ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor,
        ):
            warm = CollectPushes(Path(folder) / "warm.h5", episodes=8, policy=policy, simulator=simulator)
            for _ in collect_pushes(warm, library, executor):
                pass
            config = replace(warm, out=Path(folder) / "pushes.h5", episodes=count, seed=1)
            last = list(collect_pushes(config, library, executor))[-1]
        print(
            f"{simulator}, collect pushes --policy {policy}, 2 workers: {last.episodes_per_s:.1f} episodes of 50 steps "
            f"a second, {last.contact_share:.0%} of steps with contact, {last.motion_share:.0%} with motion"
        )


def main() -> None:
    """Measure everything and print it."""
    arguments = tyro.cli(Arguments)
    library = AssetLibrary(arguments.data_dir / "objects")
    print(machine())
    observations(library, arguments.scenes)
    for simulator in get_args(Simulator):
        physics(library, simulator)
        episodes(library, arguments.episodes, simulator)


if __name__ == "__main__":
    main()
