"""Goals from an image or poses. Occluded objects stay where they are; symmetric orientations count as equal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import FINE_SIDE, ObjectModels, SceneParameters, loss_of, views_of
from osfcore.estimation.uncertainty import reason_for
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.objects.asset import Symmetry
from osfcore.planning.costs import PoseGoal

_NO_WORSE = 1.01  # times the loss, by which an object may explain the goal image worse where it is now
_STAYS_M, _STAYS_RAD = 0.006, 0.12  # a goal this close to where an object is, is where it is


@dataclass(frozen=True, eq=False, slots=True)
class GoalImage:
    """An image of how the table should look, without the pusher.

    Attributes:
        camera: camera that took the image.
        image: linear RGB in [0, 1].

    Raises:
        InvalidInput: if the image has another size than the camera's, or is not finite.

    Example:
        >>> image = models.together.render(SceneBatch.of(state), [goal_camera()]).rgb[0, 0]
        >>> GoalImage(goal_camera(), image).observed(state.names).images.shape
        (1, 128, 128, 3)
    """

    camera: Camera
    image: Float[np.ndarray, "h w 3"]

    def __post_init__(self) -> None:
        """Check that the camera fits."""
        size = (self.camera.height, self.camera.width, 3)
        if self.image.shape != size:
            raise InvalidInput("shape of the goal image", self.image.shape, f"{size}, the size of its camera")
        if not np.all(np.isfinite(self.image)):
            raise InvalidInput("goal image", "not finite", "radiance in [0, 1]")

    def observed(self, names: tuple[str, ...]) -> Observation:
        """Return the image as an observation of these objects, for `estimate_goal`."""
        return Observation((self.camera,), self.image[None], names, None, None, 0.0)


@dataclass(frozen=True, eq=False, slots=True)
class PhotoGoal(PoseGoal):
    """Poses that were found in a photograph, and the photograph itself, in its own encoding, for people to look at."""

    photo: GoalImage


def prefer_current_poses(
    models: ObjectModels, goal: GoalImage, estimate: EstimatedState, now: SceneState
) -> EstimatedState:
    """Change the estimate of a goal image: an object stays where it is now unless the image contradicts that.

    The image says nothing about an object that is hidden or outside it. Without this rule, such an object would be
    moved to wherever it is hidden best.

    Args:
        models: models of the objects and the table.
        goal: the goal image.
        estimate: estimate from the goal image.
        now: present state of the scene.
    """
    views = views_of(goal.observed(estimate.state.names), FINE_SIDE, samples=2)
    params = SceneParameters.of(estimate.state, None)
    least, doubts = loss_of(models, views, params), list(estimate.doubts)
    for n, name in enumerate(estimate.state.names):
        here = params.with_pose(n, now.pose(name))
        loss = loss_of(models, views, here)
        if loss <= _NO_WORSE * least:
            params, least, doubts[n] = here, min(loss, least), ""
    reason = reason_for(params.names, doubts)
    return replace(estimate, state=params.state(), doubts=tuple(doubts), reason=reason)


def snap_near_goals(goal: PoseGoal, state: SceneState, symmetries: Mapping[str, Symmetry]) -> PoseGoal:
    """Set the goal of each object that has arrived, within the error of estimates, to its present pose.

    Args:
        goal: goal pose of each object of the state.
        state: present state of the scene.
        symmetries: symmetries of the objects, by name. Each goal is first turned to the nearest orientation that looks
            the same.
    """
    goal = nearest_symmetric_goal(goal, state, symmetries)
    stay = {}
    for name in state.names:
        here, there = state.pose(name), goal.pose(name)
        shift = float(np.linalg.norm((there.position - here.position)[:2]))
        if shift <= _STAYS_M and rotation_angle(here.quaternion, there.quaternion) <= _STAYS_RAD:
            stay[name] = here
    return goal.replaced(stay)


def nearest_symmetric_goal(goal: PoseGoal, state: SceneState, symmetries: Mapping[str, Symmetry]) -> PoseGoal:
    """Replace each goal orientation by the one nearest to the object's present orientation that looks the same.

    Args:
        goal: goal pose of each object. Positions stay the same.
        state: present state of the scene.
        symmetries: symmetries of the objects, by name. An object that is missing keeps its goal.
    """
    turned = {}
    for name, symmetry in symmetries.items():
        if name in goal.names and symmetry.kind != "none":
            pose = goal.pose(name)
            nearest = _nearest_symmetric(symmetry, pose.quaternion, state.pose(name).quaternion)
            turned[name] = Pose(pose.position, nearest)
    return goal.replaced(turned)


def _nearest_symmetric(
    symmetry: Symmetry, goal: Float[np.ndarray, "4"], current: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "4"]:
    turns = [np.array([1.0, 0, 0, 0]), *map(np.asarray, symmetry.rotations)]
    if symmetry.kind == "continuous":
        # q turned by t about the axis, times the other's conjugate, has scalar part a cos(t/2) + b sin(t/2).
        quarter = quaternion_multiply(goal, np.array([0.0, *np.asarray(symmetry.axis)]))
        angle = 2 * np.arctan2(quarter @ current, goal @ current)
        turns = [quaternion_exp(angle * np.asarray(symmetry.axis))]
    alike = (quaternion_multiply(goal, turn) for turn in turns)
    return min(alike, key=lambda other: float(rotation_angle(other, current)))
