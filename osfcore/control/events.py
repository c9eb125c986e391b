"""Events and settings of an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import InvalidInput, check_ranges
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanRound, PlanSettings

# Events of an episode, in the order in which they happen.


Look = Literal["first", "goal", "next", "search"]
Matter = Literal["goal", "lamp", "object", "lost", "found", "stalled", "camera", "brightness", "pictures", "prepared"]
Outcome = Literal["reached", "out of steps", "refused"]


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """The cameras took their images.

    Attributes:
        number: actions executed so far.
        observation: the images, and the pusher as the robot reports it.
    """

    number: int
    observation: Observation


@dataclass(frozen=True, eq=False, slots=True)
class Looking:
    """An estimator took a step.

    Attributes:
        number: actions executed so far.
        look: what is estimated: the "first" frame, the "goal" image, the "next" frame, or a lost object ("search").
        step: step of the estimator.
        rendered: renderings of the best scene so far, 8-bit RGB, by name of the camera; empty until they are made.
        difference: root mean square difference between renderings and images, over all pixels and colours, in [0, 1].
    """

    number: int
    look: Look
    step: EstimateStep
    rendered: Mapping[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)
    difference: float = float("nan")


@dataclass(frozen=True, eq=False, slots=True)
class GoalFound:
    """The goal poses are known.

    Attributes:
        goal: the goal poses.
        image: the goal image, or a rendering of the goal poses; linear RGB in [0, 1].
        camera: camera of the image.
        estimate: estimate from the goal image; None if the goal was given as poses.
        photo: a photograph that the goal poses were found in, for people to look at; None if there is none.
    """

    goal: PoseGoal
    image: Float[np.ndarray, "h w 3"]
    camera: Camera
    estimate: EstimatedState | None
    photo: Float[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Planning:
    """A round of planning is done. The last one before `ActionExecuted` holds the plan.

    Attributes:
        number: actions executed so far.
        round: result of the round.
    """

    number: int
    round: PlanRound


@dataclass(frozen=True, eq=False, slots=True)
class ActionExecuted:
    """The world executed an action.

    Attributes:
        number: actions executed so far, including this one.
        action: velocity (vx, vy, 0) of the pusher in the world [m/s].
    """

    number: int
    action: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False, slots=True)
class Stepped:
    """A round of the loop has ended. The first of these events comes before the first round.

    Attributes:
        number: actions executed so far.
        steps: largest number of actions. It grows when a disturbance is noticed.
        estimate: estimate of the present state.
        offsets_m: distance of each object from its goal on the table's plane [m]; empty if it is not known.
        offsets_rad: angle of each object from its goal orientation [rad]; empty if it is not known.
        image_cost: mean squared difference between the goal image and the estimate, rendered under the goal's light.
        rendered: that rendering, linear RGB in [0, 1].
        seconds: time spent on each stage of this round [s]: "first", "goal", "estimate", "plan" or "act".
    """

    number: int
    steps: int
    estimate: EstimatedState
    offsets_m: Float[np.ndarray, "N"]
    offsets_rad: Float[np.ndarray, "N"]
    image_cost: float
    rendered: Float[np.ndarray, "h w 3"]
    seconds: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Noticed:
    """A message that a person should read.

    Attributes:
        number: actions executed so far.
        matter: the kind of message.
        text: the message, one sentence.
        names: names of the objects that it is about.
    """

    number: int
    matter: Matter
    text: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Finished:
    """The episode has ended. This is the last event.

    Attributes:
        number: actions executed.
        outcome: how the episode ended.
        text: the outcome in one sentence.
        state: the last estimate of the state.
    """

    number: int
    outcome: Outcome
    text: str
    state: SceneState


Event = Observed | Looking | GoalFound | Planning | ActionExecuted | Stepped | Noticed | Finished


# Settings of an episode, which may change while it runs.


CostKind = Literal["pose", "image"]
MAX_STEPS = 1000


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """Settings of an episode.

    Attributes:
        steps: largest number of actions. Counting starts again after a disturbance (see `renewed`). The paper has 30.
        replan_every: actions of each plan that are executed before the next plan (r in the paper).
        cost: "pose" compares futures with the goal poses; "image" compares renderings of futures with the goal image,
            as in the paper.
        plan: settings of the planner.
        planning: whether to make new plans. If not, the last plan is followed to its end.
        acting: whether to execute plans. If not, the episode only observes the world.
        despite_doubts: whether to continue if the estimate of the goal image cannot be trusted.
        reached_m: largest distance from its goal at which an object has arrived [m].
        reached_rad: largest angle from its goal at which an object has arrived [rad].
        renewed: whether to count steps from 0 again after a disturbance. Turn it off to compare numbers of actions.

    Raises:
        InvalidInput: if a value is out of range.

    Example:
        >>> EpisodeSettings(steps=30, cost="image").reached_m
        0.008
    """

    steps: int = 100
    replan_every: int = 1
    cost: CostKind = "pose"
    plan: PlanSettings = field(default_factory=PlanSettings)
    planning: bool = True
    acting: bool = True
    despite_doubts: bool = False
    reached_m: float = 0.008
    reached_rad: float = 0.06
    renewed: bool = True

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            ("number of steps", self.steps, 1, MAX_STEPS),
            ("actions of each plan", self.replan_every, 1, MAX_STEPS),
            ("distance that counts as arrived [m]", self.reached_m, 0.0, 0.1),
            ("angle that counts as arrived [rad]", self.reached_rad, 0.0, 3.2),
        )
        if self.cost not in ("pose", "image"):
            raise InvalidInput("cost", repr(self.cost), '"pose" or "image"')
