"""Episodes of Push-T by several planners that are given the same start states, dynamics, cost and budget.

Everything is timed in one run and in one thread. With simulated dynamics all planners spend nearly all their time in
the same simulation, so each one also plans again from the states that it met with dynamics that cost next to nothing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from osfcore.dynamics.shapes import ObjectShape, solid_shape
from osfcore.errors import check_ranges, check_seed
from osfcore.experiments.harness import EvaluationStep, torch_in_one_thread
from osfcore.experiments.statistics import compare_means, compare_shares, mean_interval, share_interval, spread
from osfcore.extras import need
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import MAX_HORIZON, Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, STEP_S
from osfcore.paper.mppi import GaussianMPPI, GaussianPlanSettings
from osfcore.planning.costs import PoseCost, PoseGoal
from osfcore.planning.mppi import COMPARED, MPPIPlanner, PlanSettings
from osfcore.planning.pushes import PushProposals
from osfcore.random_streams import Stream, stream_rng, stream_seed

# Push-T as gym-pusht publishes it (Chi et al., 2023), and copies of it that planners look ahead with.
#
# A round pusher moves a T on a plane of 512 px until the T covers 95 % of its outline at the goal. The
# environment's actions are targets, to which a spring and a damper draw the pusher, ten times a second. Ours are
# velocities, held for 0.2 s: two of its steps, in each of which the target is as far ahead as makes the pusher keep
# that velocity.


STATE = 7  # place and velocity of the pusher [px, px/s], origin [px] and angle [rad] of the T
PX_M = 0.001  # 1 px is 1 mm: then the pusher's radius of 15 px is that of ours

# Moves K copies of the plane on by an action each.
Step = Callable[[Float[np.ndarray, "K 7"], Float[np.ndarray, "K 2"]], Float[np.ndarray, "K 7"]]


class _Plane:
    """One instance of the environment, whose actions are made of velocities.

    Raises:
        MissingExtra: if gym-pusht is not installed.
    """

    def __init__(self) -> None:
        need("pusht", "Push-T")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would be printed among the figures
        from gym_pusht.envs.pusht import PushTEnv  # pyright: ignore[reportMissingImports]  an extra

        self._env: Any = PushTEnv()  # it has no types
        self._env.reset(seed=0)
        self._steps = round(STEP_S * self._env.control_hz)  # of the environment in one of our actions
        self._substeps = int(1 / (self._env.dt * self._env.control_hz))  # of the physics in one of those
        space = self._env.action_space
        self._low, self._high, self._lead_px = float(space.low.min()), float(space.high.max()), self._lead_s() / PX_M

    @property
    def state(self) -> Float[np.ndarray, "7"]:
        """Where pusher and T are."""
        agent, block = self._env.agent, self._env.block
        return np.array([*agent.position, *agent.velocity, *block.position, block.angle])

    def _target(self, velocity: Float[np.ndarray, "2"]) -> list[float]:
        """Return the environment's action that lets the pusher keep a velocity [m/s], within the plane."""
        pairs = zip(self._env.agent.position, velocity, strict=True)
        return [min(max(float(at + self._lead_px * v), self._low), self._high) for at, v in pairs]

    def _lead_s(self) -> float:
        """Return how far ahead a target is of a pusher that moves by its velocity u times the duration h of a step [s].

        A step multiplies (x - target, v) by P. Then v is the same before and after it for v = -P10 lead u / (1 - P11),
        and x moves by h u.
        """
        dt, k_p, k_v = self._env.dt, self._env.k_p, self._env.k_v
        one = np.array([[1 - k_p * dt**2, dt - k_v * dt**2], [-k_p * dt, 1 - k_v * dt]])
        P = np.linalg.matrix_power(one, self._substeps)
        return float(self._substeps * dt / (1 - P[0, 0] - P[0, 1] * P[1, 0] / (1 - P[1, 1])))


class PushT(_Plane):
    """The environment that is acted on."""

    def reset(self, seed: int) -> None:
        """Begin anew, as the environment draws it from a seed."""
        self._env.reset(seed=seed)

    @property
    def goal(self) -> Float[np.ndarray, "3"]:
        """Where the T should be: origin [px] and angle [rad]."""
        return np.asarray(self._env.goal_pose, float)

    @property
    def success_coverage(self) -> float:
        """Share of the goal that the T has to cover."""
        return float(self._env.success_threshold)

    def coverage(self) -> float:
        """Return the share of the goal that the T covers."""
        return float(self._env._get_coverage())

    def act(self, velocity: Float[np.ndarray, "2"]) -> float:
        """Execute one action, unless the goal is reached half-way.

        Args:
            velocity: of the pusher [m/s].

        Returns:
            The largest coverage at the end of one of the environment's steps.
        """
        most = 0.0
        for _ in range(self._steps):
            *_, is_done, _, info = self._env.step(np.array(self._target(velocity)))
            most = max(most, float(info["coverage"]))
            if is_done:
                break
        return most


class Simulation(_Plane):
    """Another instance of the environment, put into any state: the true dynamics.

    The physics engine warm-starts its contact solver with the impulses of the step before, which are in no state. So
    the prediction of an action differs from what happens by a fraction of a pixel, by more where the T is jammed
    against a wall.
    """

    def __call__(
        self, states: Float[np.ndarray, "K 7"], velocities: Float[np.ndarray, "K 2"]
    ) -> Float[np.ndarray, "K 7"]:
        """Return the states after one action each [m/s]."""
        after = []
        for state, velocity in zip(states, velocities, strict=True):
            self._forget_contacts()
            self._put(state.tolist())
            for _ in range(self._steps):
                self._follow(*self._target(velocity))
            after.append(self.state)
        return np.array(after)

    def _forget_contacts(self) -> None:
        """Let a moment pass in which nothing is near anything, and keep no contact from before it."""
        env = self._env
        env.agent.velocity = env.block.velocity = (0.0, 0.0)
        env.agent.position, env.block.position = (-1e3, -1e3), (1e3, 1e3)
        kept, env.space.collision_persistence = env.space.collision_persistence, 0
        env.space.step(env.dt)
        env.space.collision_persistence = kept

    def _put(self, state: list[float]) -> None:
        agent, block = self._env.agent, self._env.block
        agent.position, agent.velocity = tuple(state[:2]), tuple(state[2:4])
        block.angle = state[6]  # first, for it turns the T about its centre of mass
        block.position = tuple(state[4:6])
        block.velocity, block.angular_velocity = (0.0, 0.0), 0.0  # which full damping makes of them in any case

    def _follow(self, x: float, y: float) -> None:
        """Take one of the environment's steps, without the areas and observations that its own `step` computes."""
        env, agent = self._env, self._env.agent
        for _ in range(self._substeps):
            (at_x, at_y), (v_x, v_y) = agent.position, agent.velocity
            agent.velocity = (
                v_x + (env.k_p * (x - at_x) - env.k_v * v_x) * env.dt,
                v_y + (env.k_p * (y - at_y) - env.k_v * v_y) * env.dt,
            )
            env.space.step(env.dt)


def drift(states: Float[np.ndarray, "K 7"], velocities: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 7"]:
    """Return the states after one action each if the pusher met nothing: dynamics that cost next to no time."""
    after = states.copy()
    after[:, 2:4] = velocities / PX_M
    after[:, :2] += STEP_S * after[:, 2:4]
    return after


# Figures of planners that did the same tasks of Push-T.


_OURS = "ours"


@dataclass(frozen=True, slots=True)
class PushTEpisode:
    """One task by one planner.

    Attributes:
        planner: its name.
        seed: of the environment.
        start: coverage before anything moves.
        coverage: the most that was reached.
        is_success: whether that is enough.
        steps: actions executed.
        plan_s: duration of each plan, with simulated dynamics [s].
        own_s: likewise, from the same states with dynamics that cost next to nothing [s].
    """

    planner: str
    seed: int
    start: float
    coverage: float
    is_success: bool
    steps: int
    plan_s: Sequence[float]
    own_s: Sequence[float]


def report_json(episodes: Sequence[PushTEpisode]) -> dict[str, Any]:
    """Return shares and coverages in [0, 1] with 95 % intervals, times in seconds, rates in plans a second.

    Args:
        episodes: all of them, the tasks of each planner in the same order.

    Returns:
        "tasks", "start_mean" (coverage before anything moves), "planners" by name, "against" (ours against each
        other one, task by task) and "episodes".
    """
    names = dict.fromkeys(e.planner for e in episodes)
    planners = {name: [e for e in episodes if e.planner == name] for name in names}
    first, ours = next(iter(planners.values())), planners.get(_OURS, [])
    others = {name: rows for name, rows in planners.items() if ours and name != _OURS}
    keys = ("planner", "seed", "start", "coverage", "steps")
    return {
        "tasks": len(first),
        "start_mean": float(np.mean([episode.start for episode in first])),
        "planners": {name: _figures(rows) for name, rows in planners.items()},
        "against": {
            name: {
                "success": compare_shares([e.is_success for e in ours], [e.is_success for e in rows]),
                "coverage": compare_means([e.coverage for e in ours], [e.coverage for e in rows]),
            }
            for name, rows in others.items()
        },
        "episodes": [{key: getattr(e, key) for key in keys} for e in episodes],
    }


def _figures(episodes: Sequence[PushTEpisode]) -> dict[str, Any]:
    successes, coverages = [e.is_success for e in episodes], [e.coverage for e in episodes]
    return {
        "success": float(np.mean(successes)),
        "success_interval": list(share_interval(sum(successes), len(successes))),
        "coverage_mean": float(np.mean(coverages)),
        "coverage_interval": mean_interval(coverages),
        "coverage_median": float(np.median(coverages)),
        "coverage_p10": float(np.quantile(coverages, 0.1)),
        "coverage_least": min(coverages),
        "steps_mean": float(np.mean([e.steps for e in episodes])),
        **_times([s for e in episodes for s in e.plan_s], "plan"),
        **_times([s for e in episodes for s in e.own_s], "own"),
    }


def _times(seconds: Sequence[float], what: str) -> dict[str, float | None]:
    mean_s = float(np.mean(seconds))
    tail = spread(f"{what}_s", seconds, ("mean", "median", "p90", "p99"))
    return {f"{what}_hz": 1 / mean_s, **tail, f"{what}_s_most": max(seconds)}


# The plane of Push-T as our table: the T is an object that lies on it, the pusher is ours.
#
# The plane's centre is the table's, 1 px is 1 mm, x and y are the same axes (the plane's y points down in its
# pictures).


NAME = "tee"
_PLANE_CENTRE_PX = 256.0
# Both boxes, x and y, in the frame of the environment's T; its origin is the middle of the bar's outer side [px].
_BAR, _STEM = ((-60.0, 60.0), (0.0, 30.0)), ((-15.0, 15.0), (30.0, 120.0))
_MIDDLE_PX = (0.0, 60.0)  # of its bounding box, the origin of our object frames
_HALF_HEIGHT_M = 0.025
_ARM_M = 0.045  # the T's radius of gyration: what a rotation by 1 rad moves it by


def tee_shape() -> ObjectShape:
    """Return the T as two boxes."""
    boxes = [np.array([[x, y, z] for x in xs for y in ys for z in (-1, 1)]) for xs, ys in (_BAR, _STEM)]
    scale, shift = (PX_M, PX_M, _HALF_HEIGHT_M), (*_MIDDLE_PX, 0.0)
    corners = [(box - shift) * scale for box in boxes]
    areas = [np.ptp(xs) * np.ptp(ys) for xs, ys in (_BAR, _STEM)]
    centre = np.average([box.mean(axis=0) for box in corners], axis=0, weights=areas)
    return solid_shape(np.concatenate(corners), centre, corners)


def pose_of(tee: Float[np.ndarray, "*batch 3"]) -> Pose:
    """Return the T's pose on the table, given its origin [px] and angle [rad] on the plane."""
    sine, cosine = np.sin(tee[..., 2]), np.cos(tee[..., 2])
    (x, y), height = _MIDDLE_PX, np.full(tee.shape[:-1], _HALF_HEIGHT_M)
    flat = _on_table(tee[..., :2] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1))
    turn = np.zeros((*tee.shape[:-1], 3))
    turn[..., 2] = tee[..., 2]
    return Pose(np.concatenate([flat, height[..., None]], axis=-1), quaternion_exp(turn))


def scene_of(state: Float[np.ndarray, "7"]) -> SceneState:
    """Return the plane's state as a scene."""
    return SceneState((NAME,), pose_of(state[None, 4:]), Light(np.array([0.0, 0.0, 1.0])), _pusher(state[:2]))


def rollouts_of(states: Float[np.ndarray, "K T1 7"]) -> Rollouts:
    """Return sequences of the plane's states as futures of the scene."""
    poses = pose_of(states[:, :, None, 4:])
    return Rollouts((NAME,), poses.position, poses.quaternion, _pusher(states[..., :2]))


def goal_of(tee: Float[np.ndarray, "3"]) -> PoseGoal:
    """Return the pose goal of a place [px, rad] on the plane."""
    return PoseGoal((NAME,), pose_of(tee[None]))


def cost_of(goal: PoseGoal) -> PoseCost:
    """Return the cost of futures, the same for all planners."""
    return PoseCost(goal, _ARM_M)


def _pusher(places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    height = np.full((*places.shape[:-1], 1), PUSHER_CENTRE_Z_M)
    return np.concatenate([_on_table(places), height], axis=-1)


def _on_table(places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    return (places - _PLANE_CENTRE_PX) * PX_M


# Planners that are compared: ours, the paper's and pytorch-mppi's, with one cost, budget and dynamics.
#
# All choose among velocities within the same limits and compare the same futures by the same cost of poses. K
# sequences of T actions are looked at for each action: all at once by the Gaussian ones, in two rounds and a
# comparison by ours.


NOISE_M_S = 0.2  # of both Gaussian planners' velocities, as in the paper's implementation
PYTORCH_MPPI_LAMBDA = 0.001  # of the cost [m]; the best of 0.0003 to 0.03 on three tasks of other seeds


@dataclass(frozen=True, eq=False, slots=True)
class Problem:
    """A task as a planner gets it.

    Attributes:
        goal: where the T should be.
        step: the dynamics.
        samples: sequences for each plan (K).
        horizon: actions in each (T).
    """

    goal: PoseGoal
    step: Step
    samples: int
    horizon: int


# Returns the next action in a state of the plane [m/s], planned anew.
Planner = Callable[[Float[np.ndarray, "7"]], Float[np.ndarray, "2"]]


def our_planner(problem: Problem, rng: np.random.Generator) -> Planner:
    """Return MPPI with straight push proposals: as it ships, but plans are not recombined nor judged over begins."""
    futures, samples = _Futures(problem.step), (problem.samples - COMPARED) // 2
    settings = PlanSettings(samples, problem.horizon, recombined=0, begins_m=0.0)
    planner = MPPIPlanner(futures, PushProposals({NAME: tee_shape()}), settings)

    def plan(state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        *_, last = planner.plan(futures.begin(state), problem.goal, cost_of(problem.goal), rng)
        planner.shift(1)
        return last.actions[0, :2]

    return plan


def paper_planner(problem: Problem, rng: np.random.Generator) -> Planner:
    """Return the Gaussian MPPI of the paper."""
    futures = _Futures(problem.step)
    settings = GaussianPlanSettings(samples=problem.samples, horizon=problem.horizon, noise_m_s=NOISE_M_S)
    planner = GaussianMPPI(futures, settings)

    def plan(state: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2"]:
        actions = planner.plan(futures.begin(state), cost_of(problem.goal), rng).actions
        planner.shift()
        return actions[0, :2]

    return plan


def pytorch_mppi(problem: Problem, _rng: np.random.Generator) -> Planner:
    """Return `MPPI` of pytorch-mppi (University of Michigan), begun at rest; it adds its own cost of actions.

    It draws from torch's global generator.

    Raises:
        MissingExtra: if it is not installed.
    """
    need("pusht", "Push-T")
    from pytorch_mppi import MPPI  # pyright: ignore[reportMissingImports]  an extra

    cost = cost_of(problem.goal)

    def dynamics(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(problem.step(states.numpy(), actions.numpy()))

    def cost_of_all(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        after = states[0].numpy()  # K x T, without the state before; the cost leaves the first one out
        return torch.from_numpy(cost(rollouts_of(np.concatenate([after[:, :1], after], axis=1))))

    limit = torch.full((2,), MAX_SPEED_M_S, dtype=torch.float64)
    planner: Any = MPPI(
        dynamics, lambda states, _actions: states.new_zeros(len(states)), STATE,
        NOISE_M_S**2 * torch.eye(2, dtype=torch.float64),
        num_samples=problem.samples, horizon=problem.horizon, terminal_state_cost=cost_of_all,
        lambda_=PYTORCH_MPPI_LAMBDA, u_min=-limit, u_max=limit,
        U_init=torch.zeros(problem.horizon, 2, dtype=torch.float64),
    )  # fmt: skip
    return lambda state: planner.command(state).numpy().clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)


PLANNERS = {_OURS: our_planner, "paper": paper_planner, "pytorch_mppi": pytorch_mppi}


class _Futures:
    """Rolls out from one state of the plane, which holds more than a scene: the pusher's velocity."""

    def __init__(self, step: Step) -> None:
        self._step, self._now = step, np.zeros(STATE)

    def begin(self, state: Float[np.ndarray, "7"]) -> SceneState:
        """Set where futures begin from here on, and return it as a scene."""
        self._now = state
        return scene_of(state)

    def __call__(self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None) -> Rollouts:
        """Return the futures of K sequences."""
        states = [np.tile(self._now, (len(actions), 1))]
        for t in range(actions.shape[1]):
            states.append(self._step(states[-1], actions[:, t, :2]))
        return rollouts_of(np.stack(states, axis=1))


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


def bench_planner(config: BenchPlanner) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Let every planner do every task; the report is that of `report_json`.

    Args:
        config: what to measure, and how often.

    Raises:
        MissingExtra: if the benchmark is not installed.
    """
    total, episodes = config.tasks * len(PLANNERS), list[PushTEpisode]()
    world, simulation = PushT(), Simulation()
    yield EvaluationStep(0, total, "Warming up")
    for name in PLANNERS:
        _episode(config, name, 0, 1, world, simulation)
    for task in range(config.tasks):
        for name in PLANNERS:
            yield EvaluationStep(len(episodes), total, f"Pushing (task {task + 1} of {config.tasks}, {name})")
            episodes.append(_episode(config, name, task, config.steps, world, simulation))
    yield EvaluationStep(total, total, "Everything is measured", report_json(episodes))


def _episode(
    config: BenchPlanner, name: str, task: int, steps: int, world: PushT, simulation: Simulation
) -> PushTEpisode:
    """Let one planner do one task, with torch in one thread."""
    world.reset(config.seed + task)
    start = coverage = world.coverage()
    states: list[Float[np.ndarray, "7"]] = []

    def planner(step: Step) -> Planner:
        problem = Problem(goal_of(world.goal), step, config.samples, config.horizon)
        return PLANNERS[name](problem, stream_rng(config.seed, Stream.BENCHMARK, task))

    # One of the planners draws from torch's global generator.
    with torch_in_one_thread(), torch.random.fork_rng(devices=[]):
        one, plan_s = planner(simulation), list[float]()
        torch.manual_seed(stream_seed(config.seed, Stream.BENCHMARK, task))
        while not states or (len(states) < steps and coverage <= world.success_coverage):
            states.append(world.state)
            coverage = max(coverage, world.act(_timed_plan(one, states[-1], plan_s)))
        one, own_s = planner(drift), list[float]()
        for state in states:
            _timed_plan(one, state, own_s)
    is_success = coverage > world.success_coverage
    return PushTEpisode(name, config.seed + task, start, coverage, is_success, len(states), plan_s, own_s)


def _timed_plan(planner: Planner, state: Float[np.ndarray, "7"], seconds: list[float]) -> Float[np.ndarray, "2"]:
    """Return the next action [m/s], and note how long the plan took."""
    start = time.perf_counter()
    action = planner(state)
    seconds.append(time.perf_counter() - start)
    return action
