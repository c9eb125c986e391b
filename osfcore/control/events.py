"""What an episode yields, and what can be chosen about it."""

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

# What an episode yields: everything that a page, a report or a test may want to know, as it happens.


Look = Literal["first", "goal", "next", "search"]
Matter = Literal["goal", "lamp", "object", "lost", "found", "stalled", "camera", "brightness", "pictures", "prepared"]
Outcome = Literal["reached", "out of steps", "refused"]


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """The cameras took their images.

    Attributes:
        number: actions executed so far.
        observation: what they and the robot report.
    """

    number: int
    observation: Observation


@dataclass(frozen=True, eq=False, slots=True)
class Looking:
    """An estimator is at work.

    Attributes:
        number: actions executed so far.
        look: at the first frame, at the goal image, at a later frame, or for something that was lost.
        step: of the estimator.
        rendered: the best scene so far as each camera would see it, by camera; empty until something renders it.
        difference: of that from the images, root of the mean square over all pixels and colours, 0 to 1.
    """

    number: int
    look: Look
    step: EstimateStep
    rendered: Mapping[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)
    difference: float = float("nan")


@dataclass(frozen=True, eq=False, slots=True)
class GoalFound:
    """Where everything should be.

    Attributes:
        goal: the poses.
        image: how that looks, through the camera: the goal image, or the poses rendered.
        camera: of the image.
        estimate: what the goal image was taken for; None where poses were given.
        photo: a photograph of the poses through the camera, to look at; None where there is none.
    """

    goal: PoseGoal
    image: Float[np.ndarray, "h w 3"]
    camera: Camera
    estimate: EstimatedState | None
    photo: Float[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Planning:
    """A round of planning is done; the last one before `ActionExecuted` holds the plan.

    Attributes:
        number: actions executed so far.
        round: of the planner.
    """

    number: int
    round: PlanRound


@dataclass(frozen=True, eq=False, slots=True)
class ActionExecuted:
    """An action was executed.

    Attributes:
        number: of actions executed, this one included.
        action: velocity of the pusher [m/s].
    """

    number: int
    action: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False, slots=True)
class Stepped:
    """One round of the loop is over, or the loop is about to begin.

    Attributes:
        number: actions executed so far.
        steps: actions at most; more once a disturbance was noticed.
        estimate: where everything is now.
        offsets_m: of each object from where it should be, on the table's plane [m]; empty where that is not known.
        offsets_rad: likewise its orientation [rad].
        image_cost: mean squared difference between the goal image and the estimate rendered under its light.
        rendered: that rendering.
        seconds: spent on each stage of this round: "first", "goal", "estimate", "plan", "act"; those that there were.
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
    """Something that a person should know.

    Attributes:
        number: actions executed so far.
        matter: what kind of thing.
        text: a sentence.
        names: objects it is about.
    """

    number: int
    matter: Matter
    text: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Finished:
    """The last event.

    Attributes:
        number: actions executed.
        outcome: how it ended.
        text: a sentence.
        state: as estimated last.
    """

    number: int
    outcome: Outcome
    text: str
    state: SceneState


Event = Observed | Looking | GoalFound | Planning | ActionExecuted | Stepped | Noticed | Finished


# What can be chosen about an episode, also while it runs.


CostKind = Literal["pose", "image"]
MAX_STEPS = 1000


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """How an episode goes.

    Attributes:
        steps: actions at most, counted anew after each disturbance that is noticed. The paper has 30.
        replan_every: actions executed of each plan (the paper's r).
        cost: "pose" compares futures with the goal's poses, "image" their renderings with the goal image (the paper's).
        plan: how pushes are planned.
        planning: draw plans; where not, the last plan is followed to its end.
        acting: execute plans; where not, the world is only watched.
        despite_doubts: go on with a goal image that is not explained well.
        reached_m: objects this close to their goals have arrived [m].
        reached_rad: likewise for orientations [rad].
        renewed: count steps anew after disturbances; off where the number of actions is what is measured.

    Raises:
        InvalidInput: naming what is out of range.
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
