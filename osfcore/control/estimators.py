"""How a closed loop estimates: the configurations of its three estimators."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.goal_image import GoalImageConfig
from osfcore.estimation.tracking import TrackingConfig
from osfcore.geometry.light import Light


@dataclass(frozen=True, slots=True)
class Estimators:
    """Configurations of the estimators.

    Attributes:
        first: of the first frame.
        later: of all frames after it.
        goal: of the goal image, and of the search for lost objects.
    """

    first: FirstFrameConfig = field(default_factory=FirstFrameConfig)
    later: TrackingConfig = field(default_factory=TrackingConfig)
    goal: GoalImageConfig = field(default_factory=GoalImageConfig)

    @staticmethod
    def with_known_lights(light: Light, goal_light: Light) -> Estimators:
        """Estimators of poses alone, which take the lights of scene and goal image for known."""
        held, goal_held = (tuple(float(x) for x in one.direction) for one in (light, goal_light))
        return Estimators(
            FirstFrameConfig(held_light=held),  # pyright: ignore[reportArgumentType]
            TrackingConfig(lamp_above=np.inf),
            GoalImageConfig(held_light=goal_held),  # pyright: ignore[reportArgumentType]
        )
