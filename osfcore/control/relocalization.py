"""Relocalization of lost objects without masks: template matching in one camera's image, then tracking in all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from osfcore.estimation.goal_image import estimate_goal
from osfcore.estimation.goal_refinement import GoalImageConfig
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import estimate_next
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation, SceneState


def relocalize(
    models: ObjectModels,
    observation: Observation,
    last: EstimatedState,
    rng: np.random.Generator,
    config: GoalImageConfig | None = None,
) -> Iterator[EstimateStep]:
    """Look for the doubted objects anywhere on the table; the last step holds the better of both estimates.

    Args:
        models: fields of the objects and the table.
        observation: all views, at best without anything in front.
        last: the estimate whose doubted objects are looked for.
        rng: of the search.
        config: how the one image is searched.
    """
    state = last.state
    lost = [n for n, doubt in enumerate(last.doubts) if doubt]
    view = int(rng.integers(len(observation.cameras)))
    alone = Observation(
        observation.cameras[view : view + 1], observation.images[view : view + 1], observation.names, None, None,
        observation.time_s,
    )  # fmt: skip
    first_frame = None
    for step in estimate_goal(models, alone, state, config):
        first_frame = step.estimate
        yield replace(step, estimate=None)
    assert first_frame is not None, "the last step brings the estimate"
    expected = replace(_with_poses_of(state, first_frame.state, lost), pusher=observation.pusher)
    for step in estimate_next(models, observation, expected, rng):
        update = step.estimate
        is_worse = update is not None and sum(map(bool, update.doubts)) > len(lost)
        yield replace(step, estimate=last) if is_worse else step


def _with_poses_of(state: SceneState, other: SceneState, numbers: list[int]) -> SceneState:
    """The state with some of its objects where another one has them."""
    positions, quaternions = state.poses.position.copy(), state.poses.quaternion.copy()
    for n in numbers:
        pose = other.pose(state.names[n])
        positions[n], quaternions[n] = pose.position, pose.quaternion
    return replace(state, poses=Pose(positions, quaternions))
