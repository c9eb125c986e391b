"""Visual foresight (Finn and Levine, 2017; Ebert et al., 2018): model-predictive control on predicted images.

K sequences of T actions, a_k, are drawn around a mean, what the goal camera would see is predicted for each, and

    S_k = sum_t |I_k(t) - I_goal|^2,        mean <- sum_k w_k a_k,        w_k ~ exp(-(S_k - min S) / lambda)

is repeated (MPPI; Williams et al., 2015); the first action of the mean is executed and everything begins again from
what is then seen. Nothing here knows of objects, their poses or light.

Deviations, and choices where the paper that is reproduced here says nothing but "visual foresight with FitVid": MPPI
takes the place of the cross-entropy method of the original, and the whole image that of its designated pixels; lambda
is relative to the spread of the costs, temperature * (median S - min S), as for the planner of poses; noise is
correlated in time (Nagabandi et al., 2020). The numbers of sequences and rounds are those that one of our looks and
plans leaves time for on one core. Goal images show no pusher, predicted ones do.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from osfcore.control.goal import GoalImage
from osfcore.control.world import World
from osfcore.errors import InvalidInput, check_ranges
from osfcore.experiments.factors import Factor, VariedWorld
from osfcore.experiments.rearrangement_runs import Ended
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES
from osfcore.geometry.workspace import MAX_SPEED_M_S
from osfcore.metrics.success import RearrangementTask
from osfcore.objects.asset_library import AssetLibrary


class FramePredictor(Protocol):
    """Predicts images; `osfcore.experiments.rivals.fitvid.FitVidModel` is one."""

    def predict(
        self,
        context_frames: Float[np.ndarray, "2 h w 3"],
        actions: Float[np.ndarray, "K T 3"],
        pusher: Float[np.ndarray, "3"],
        *,
        between: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "K T h w 3"]:
        """Predict what will be seen after each action.

        Args:
            context_frames: what was seen one action ago, and now.
            actions: sequences [m/s].
            pusher: its centre now [m].
            between: the action between the two [m/s].
        """
        ...


@dataclass(frozen=True, slots=True)
class ForesightSettings:
    """Settings of the planner.

    Attributes:
        samples: sequences of each round (K).
        horizon: actions in each (T).
        rounds: of a plan.
        temperature: of the softmax, as a share of the spread of costs in the better half.
        noise_m_s: standard deviation of each velocity around the mean [m/s].
        smoothing: correlation of the noise from one action to the next.
    """

    samples: int = 16
    horizon: int = 10
    rounds: int = 1
    temperature: float = 0.05
    noise_m_s: float = 0.15
    smoothing: float = 0.7

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_ranges(
            ("number of samples", self.samples, 2, MAX_SEQUENCES),
            ("horizon [actions]", self.horizon, 1, MAX_HORIZON),
            ("rounds of a plan", self.rounds, 1, 10_000),
            ("temperature", self.temperature, 1e-6, 1e6),
            ("noise [m/s]", self.noise_m_s, 1e-6, MAX_SPEED_M_S),
            ("correlation of the noise", self.smoothing, 0.0, 0.999),
        )


@dataclass(frozen=True, eq=False, slots=True)
class ForesightPlan:
    """Result of planning.

    Attributes:
        actions: the mean after the last round [m/s].
        costs: of the sequences of the last round: mean over pixels, sum over steps.
        seconds: that it took [s].
    """

    actions: Float[np.ndarray, "T 3"]
    costs: Float[np.ndarray, "K"]
    seconds: float


@dataclass(frozen=True, eq=False, slots=True)
class Foreseen:
    """An action that was executed.

    Attributes:
        number: of the action, from 0.
        action: executed [m/s].
        plan: that it begins.
        image: of the goal camera, before the action.
    """

    number: int
    action: Float[np.ndarray, "3"]
    plan: ForesightPlan
    image: Float[np.ndarray, "h w 3"]


class VisualForesight:
    """Receding-horizon planner over predicted images: each plan is warm-started from the last one.

    Args:
        predictor: of images of the goal's camera.
        goal: the image to reach.
        settings: of the plan.
    """

    def __init__(
        self, predictor: FramePredictor, goal: Float[np.ndarray, "h w 3"], settings: ForesightSettings | None = None
    ) -> None:
        self._predictor, self._goal = predictor, np.asarray(goal, np.float32)
        self.settings = settings or ForesightSettings()
        self._mean = np.zeros((self.settings.horizon, 3))

    def plan(
        self,
        context: Float[np.ndarray, "2 h w 3"],
        pusher: Float[np.ndarray, "3"],
        between: Float[np.ndarray, "3"] | None,
        rng: np.random.Generator,
    ) -> ForesightPlan:
        """Plan in all rounds.

        Args:
            context: what was seen one action ago, and now.
            pusher: its centre now [m].
            between: the action between the two [m/s].
            rng: draws the sequences.
        """
        began, costs = time.perf_counter(), np.zeros(0)
        for _ in range(self.settings.rounds):
            actions = self._sampled(rng)
            costs = self._costs(self._predictor.predict(context, actions, pusher, between=between))
            spread = max(float(np.median(costs) - costs.min()), 1e-12)
            weights = np.exp(-(costs - costs.min()) / (self.settings.temperature * spread))
            self._mean = np.einsum("k,kta->ta", weights / weights.sum(), actions)
        return ForesightPlan(self._mean, costs, time.perf_counter() - began)

    def shift(self) -> None:
        """Shift the mean by the action that has been executed, to warm-start the next plan."""
        self._mean = np.concatenate([self._mean[1:], np.zeros((1, 3))])

    def _sampled(self, rng: np.random.Generator) -> Float[np.ndarray, "K T 3"]:
        """Draw the mean, and sequences around it: n_t = c n_t-1 + sqrt(1 - c^2) e_t."""
        s = self.settings
        fresh = rng.normal(0, s.noise_m_s, (s.horizon, s.samples, 2))
        noise = fresh.copy()
        for step in range(1, s.horizon):
            noise[step] = s.smoothing * noise[step - 1] + np.sqrt(1 - s.smoothing**2) * fresh[step]
        noise[:, 0] = 0
        velocities = np.pad(noise.swapaxes(0, 1), ((0, 0), (0, 0), (0, 1)))
        return (self._mean + velocities).clip(-MAX_SPEED_M_S, MAX_SPEED_M_S)

    def _costs(self, frames: Float[np.ndarray, "K T h w 3"]) -> Float[np.ndarray, "K"]:
        """Return the cost of each sequence, one after the other: all differences at once would double the memory."""
        return np.array([((video - self._goal) ** 2).mean(axis=(1, 2, 3), dtype=float).sum() for video in frames])


def foresee(
    world: World, goal: GoalImage, planner: VisualForesight, steps: int, rng: np.random.Generator
) -> Iterator[Foreseen]:
    """Push until all steps are done: images alone do not show when the goal is reached.

    Args:
        world: one of whose cameras is that of the goal image.
        goal: the image to reach.
        planner: with the same goal.
        steps: actions.
        rng: draws the sequences.

    Yields:
        Each action, after it was executed.

    Raises:
        InvalidInput: if the world has no such camera.
    """
    now, pusher = _view(world, goal)
    before, action = now, None
    for number in range(steps):
        plan = planner.plan(np.stack([before, now]), pusher, action, rng)
        action = plan.actions[0]
        world.act(action)
        planner.shift()
        yield Foreseen(number, action, plan, now)
        before, (now, pusher) = now, _view(world, goal)


def _view(world: World, goal: GoalImage) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "3"]]:
    """Return what the goal image's camera sees now, and the pusher's centre."""
    seen = world.observe()
    for camera, image in zip(seen.cameras, seen.images, strict=True):
        if camera.name == goal.camera.name and image.shape == goal.image.shape:
            assert seen.pusher is not None  # for the type checker: a robot knows its hand
            return image, seen.pusher
    sizes = [(camera.name, camera.width, camera.height) for camera in seen.cameras]
    raise InvalidInput("cameras of the world", sizes, f"among them {goal.camera.name!r} with the goal image's size")


def run_visual_foresight(
    task: RearrangementTask,
    assets: AssetLibrary,
    predictor: FramePredictor,
    settings: ForesightSettings,
    steps: int,
    rng: np.random.Generator,
    factor: Factor | None = None,
    size: int = 128,
) -> Iterator[Foreseen | Ended]:
    """Do one rearrangement task by visual foresight; the last step is how it ended.

    Args:
        task: the method sees its goal image alone.
        assets: meshes, for the simulator.
        predictor: of the goal camera's images.
        settings: of the plans.
        steps: actions.
        rng: of the plans.
        factor: how the world differs from what is taken for granted.
        size: side of the images [px], the predictor's.
    """
    camera = goal_camera(size)
    with closing(VariedWorld(assets, factor or Factor(), rng.spawn(1)[0], cameras=(camera,))) as world:
        goal = world.goal_image(task.goal, camera)
        world.restore(task.start)
        yield from foresee(world, goal, VisualForesight(predictor, goal.image, settings), steps, rng)
        yield Ended.of(world, goal)
