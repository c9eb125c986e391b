"""Episodes of Push-T by several planners that are given the same start states, dynamics, cost and budget.

Everything is timed in one run and in one thread. With simulated dynamics all planners spend nearly all their time in
the same simulation, so each one also plans again from the states that it met with dynamics that cost next to nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from osfcore.errors import check_ranges, check_seed
from osfcore.experiments.benchmarks.pusht.environment import PushT, Simulation, drift
from osfcore.experiments.benchmarks.pusht.planners import PLANNERS, Planner, Problem
from osfcore.experiments.benchmarks.pusht.report import PlannerReport, PushTEpisode
from osfcore.experiments.benchmarks.pusht.table import goal_of
from osfcore.experiments.pieces import torch_in_one_thread
from osfcore.geometry.rollouts import MAX_HORIZON
from osfcore.random_streams import Stream, stream_rng, stream_seed

_MOST = 10_000
_FEWEST_SAMPLES = 19  # ours needs eight in each of its two rounds, and compares three sequences after them


@dataclass(frozen=True, slots=True)
class BenchPlanner:
    """What to measure, and how often.

    Attributes:
        tasks: start states, of the environment's seeds from `seed` on.
        samples: sequences that each plan looks at.
        horizon: actions in each, of 0.2 s.
        steps: actions in an episode at most.
        seed: the first of the environment's seeds, and of all planners' samples.
    """

    tasks: int = 20
    samples: int = 64
    horizon: int = 15
    steps: int = 50
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_ranges(
            ("number of tasks", self.tasks, 1, _MOST),
            ("number of samples", self.samples, _FEWEST_SAMPLES, _MOST),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("number of steps", self.steps, 1, _MOST),
        )
        check_seed(self.seed)


@dataclass(frozen=True, eq=False, slots=True)
class BenchPlannerStep:
    """How far the measurement is.

    Attributes:
        done: episodes finished.
        total: episodes in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: PlannerReport | None = None


def bench_planner(config: BenchPlanner) -> Iterator[BenchPlannerStep]:
    """Let every planner do every task.

    Args:
        config: what to measure, and how often.

    Raises:
        MissingPushT: if the benchmark is not installed.
    """
    total, episodes = config.tasks * len(PLANNERS), list[PushTEpisode]()
    stage = _Stage(config)
    yield BenchPlannerStep(0, total, "Warming up")
    with torch_in_one_thread():
        for name in PLANNERS:
            stage.episode(name, 0, steps=1)
    for task in range(config.tasks):
        for name in PLANNERS:
            yield BenchPlannerStep(len(episodes), total, f"Pushing (task {task + 1} of {config.tasks}, {name})")
            with torch_in_one_thread():
                episodes.append(stage.episode(name, task, config.steps))
    yield BenchPlannerStep(total, total, "Everything is measured", PlannerReport(tuple(episodes)))


class _Stage:
    """The environment, and the simulation that all planners share."""

    def __init__(self, config: BenchPlanner) -> None:
        self._config, self._world, self._simulation = config, PushT(), Simulation()

    def episode(self, name: str, task: int, steps: int) -> PushTEpisode:
        """One task by one planner."""
        world, config = self._world, self._config
        world.reset(config.seed + task)
        start = coverage = world.coverage()
        problem = Problem(goal_of(world.goal), self._simulation, config.samples, config.horizon)
        clock = _Clock(PLANNERS[name](problem, stream_rng(config.seed, Stream.BENCHMARK, task)))
        own = Problem(problem.goal, drift, config.samples, config.horizon)
        states: list[Float[np.ndarray, "7"]] = []
        with torch.random.fork_rng(devices=[]):  # one of the planners draws from torch's global generator
            torch.manual_seed(stream_seed(config.seed, Stream.BENCHMARK, task))
            while not states or (len(states) < steps and coverage <= world.success_coverage):
                states.append(world.state)
                coverage = max(coverage, world.act(clock.plan(states[-1])))
            own_clock = _Clock(PLANNERS[name](own, stream_rng(config.seed, Stream.BENCHMARK, task)))
            for state in states:
                own_clock.plan(state)
        is_success = coverage > world.success_coverage
        return PushTEpisode(
            name, config.seed + task, start, coverage, is_success, len(states), clock.seconds, own_clock.seconds
        )


class _Clock:
    """A planner that is timed."""

    def __init__(self, planner: Planner) -> None:
        self._planner, self._seconds = planner, list[float]()

    @property
    def seconds(self) -> tuple[float, ...]:
        """How long each plan took [s]."""
        return tuple(self._seconds)

    def plan(self, state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        """The next action [m/s]."""
        start = time.perf_counter()
        action = self._planner.plan(state)
        self._seconds.append(time.perf_counter() - start)
        return action
