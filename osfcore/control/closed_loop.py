"""Algorithm 1 of the paper as a generator of events: estimate, plan, act, and estimate again.

Deviations from the paper:

- Goal poses are estimated once, before anything moves. Pushes can then be aimed at them, and a goal image that does not
  match is reported at once.
- Each later estimate starts at the state that the dynamics model predicted.
- An object that was lost is searched. A lamp that was moved is estimated again.
- New plans are made if the objects stop approaching their goals.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from osfcore.control.estimators import EpisodeParts, SceneModels
from osfcore.control.events import (
    ActionExecuted,
    EpisodeSettings,
    Event,
    Finished,
    GoalFound,
    Look,
    Looking,
    Matter,
    Noticed,
    Observed,
    Outcome,
    Planning,
    Stepped,
)
from osfcore.control.goal import GoalImage, PhotoGoal, nearest_symmetric_goal, prefer_current_poses, snap_near_goals
from osfcore.control.prepared import PreparedLooks
from osfcore.control.world import Sight, World
from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import ImageModel
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.photometry import adapted
from osfcore.estimation.steps import EstimateStep, all_but_last
from osfcore.estimation.tracking import estimate_next
from osfcore.estimation.uncertainty import expected_fit, object_residuals, relative_residuals
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, planar_turn, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.geometry.workspace import PUSHER_RADIUS_M, WORKSPACE_HALF_M
from osfcore.planning.costs import ARM_M, PoseGoal
from osfcore.planning.parts import COSTS, CostInputs, PlannerInputs
from osfcore.planning.pushes import PushProposals
from osfcore.render.types import Quality, SceneBatch

_SHOWN = Quality(samples_per_side=2)
_LOST_AFTER = 2  # looks at which an object is doubted, one after another
_SEARCHES = 2  # for lost objects, at most, in one episode: each takes as long as a goal image
_RETREAT = 2  # actions away from the objects, before a search
_RETREAT_M_S = 0.2  # along the faster axis: slower than a push, in case it touches an object
_DISTURBANCES = frozenset({"lamp", "object", "found", "camera", "brightness"})  # steps restart after these
_RENEWALS = 10  # at most: something that flickers must not keep a robot going for ever


class Episode:
    """One episode: estimate, plan and push until the table looks like the goal (Algorithm 1 of the paper).

    `run` yields events. The episode pauses while the caller does not take the next event, and ends when the caller
    closes the generator.

    Args:
        world: the world to observe and act in.
        models: models of the objects.
        goal: a goal image, or goal poses.
        settings: settings. The attribute `settings` may be replaced while the episode runs.
        rng: random generator of everything random.
        start: estimate of the first frame, if there is one already. If None, it is estimated from images with masks.
        prepared: earlier estimates, which are used instead of new ones if they explain the images.
        parts: replacements of the estimators, the planner and the cost.

    Example:
        >>> world = Tabletop(assets, request=SceneRequest(names=(name,)))
        >>> world.arrange(seed=0)
        >>> episode = Episode(
        ...     world,
        ...     load_scene_models((name,), fields, assets, None),
        ...     PoseGoal.of(world.truth(), {name: there}),
        ...     EpisodeSettings(steps=30),
        ...     np.random.default_rng(0),
        ... )
        >>> type(next(episode.run())).__name__  # in full: for event in episode.run(): ...
        'Observed'
        >>> world.close()
    """

    settings: EpisodeSettings

    def __init__(
        self,
        world: World,
        models: SceneModels,
        goal: GoalImage | PoseGoal,
        settings: EpisodeSettings,
        rng: np.random.Generator,
        start: EstimatedState | None = None,
        prepared: PreparedLooks | None = None,
        parts: EpisodeParts | None = None,
    ) -> None:
        self.settings = settings
        self._world, self._models, self._target, self._rng = world, models, goal, rng
        proposals = PushProposals(models.shapes, models.pushes.rollout)
        self._parts = parts or EpisodeParts()
        self._planner = self._parts.planner(PlannerInputs(models.dynamics.rollout, proposals, settings.plan))
        self._start, self._prepared, self._how = start, prepared, self._parts.estimators
        self._number, self._is_stalled = 0, False
        self._counted_from, self._renewals = 0, 0  # actions before those that count toward settings.steps
        self._progress, self._sight = ProgressMonitor(), Sight()
        self._doubted: dict[str, int] = {}
        self._searches = 0
        self._timer = StageTimer()
        self._usual_models = self._scene = self._of_goal = AdaptedModels(models.appearance)
        self._before: SceneState | None = None  # one action before the estimate
        self._expected: SceneState | None = None  # what the last action should have led to

    def run(self) -> Iterator[Event]:
        """Run the episode; yield an event for each thing that happens. The last event is a `Finished`.

        Raises:
            InvalidInput: if the world has no masks for the first frame, or goal and scene have different objects.
            UnknownName: if there is no model of an object.
        """
        yield from self._begin()
        if not (yield from self._find_goal()):
            return
        yield self._stepped()
        while True:
            outcome = self._outcome()
            if outcome is not None:
                yield self._finished(*outcome)
                return
            if self.settings.planning:
                yield from self._plan()
            if self.settings.acting:
                yield from self._act()
            else:
                self._before = None
            yield from self._look_again()
            stepped = self._stepped()
            yield stepped
            distance = stepped.offsets_m + ARM_M * stepped.offsets_rad
            self._is_stalled = self._progress.is_stalled(float(distance.sum()))
            if self._is_stalled:
                self._planner.reset()
                yield self._noticed("stalled", "No object has come closer to its goal for a while; making a new plan.")

    # Looking

    def _begin(self) -> Iterator[Event]:
        observation = yield from self._observe(masks=self._start is None)
        if isinstance(self._target, PoseGoal) and set(self._target.names) != set(observation.names):
            raise InvalidInput("objects of the goal", ", ".join(self._target.names), ", ".join(observation.names))
        if self._start is None:
            steps = self._how.first_frame(self._models.appearance, observation, self._rng)
            found = yield from self._look("first", observation, steps)
            self._estimate = found.estimate
            self._scene = self._of_goal = self._scene.to(found.image_model, observation.names)
            observation = self._scene.normalized(observation)
            if found.image_model is not None and found.image_model.oddities:
                text = f"The images are unusual ({found.image_model.oddities}); estimates allow for it."
                yield self._noticed("pictures", text)
        else:
            self._estimate = self._start
        self._estimate = self._estimate.with_pusher(observation.pusher)
        fit = expected_fit(self._scene.models, observation, self._estimate.state)
        self._usual = object_residuals(fit)
        self._shares = dict(zip(observation.names, relative_residuals(fit).tolist(), strict=True))
        self._weak = frozenset(self._estimate.doubted)
        if not self._estimate.trusted:
            yield self._noticed("lost", f"The first estimate is doubtful: {self._estimate.reason}.")

    def _observe(self, *, masks: bool = False) -> Iterator[Event]:  # returns the Observation
        raw = self._world.observe(masks=masks)
        if raw.pusher is None:
            raise InvalidInput("pusher of the world", "missing", "its centre [m], in every observation of an episode")
        yield Observed(self._number, raw)
        observation, changes = self._sight.take(raw)
        for change in changes:
            yield self._noticed(change.matter, change.text)
        return self._scene.normalized(observation)

    def _look(
        self, look: Look, observation: Observation, steps: Iterator[EstimateStep]
    ) -> Iterator[Event]:  # returns the last EstimateStep
        """Use the prepared estimate if it fits; else run an estimator."""
        with self._timer.stage(look):
            step = None if self._prepared is None else self._prepared.step(look, self._models.appearance, observation)
        if step is None:
            return (yield from self._run_estimator(look, steps))
        yield Looking(self._number, look, step)
        what = "first frame" if look == "first" else "goal image"
        yield self._noticed("prepared", f"The estimate of the {what} was prepared with this example.")
        return step

    def _run_estimator(
        self, look: Look, steps: Iterator[EstimateStep]
    ) -> Iterator[Event]:  # returns the last EstimateStep
        last = None
        for step in self._timer.steps(look if look in ("first", "goal") else "estimate", steps):
            last = step
            yield Looking(self._number, look, step)
        if last is None or last.estimate is None:
            raise InvalidInput("last step of the estimator", "without an estimate", "one that holds it")
        return last

    def _look_again(self) -> Iterator[Event]:
        observation = yield from self._observe()
        before = self._estimate
        expected = before.state if self._expected is None else self._expected
        steps = self._how.later_frame(self._scene.models, observation, expected, self._rng, self._usual)
        found = yield from self._run_estimator("next", steps)
        self._estimate = found.estimate.with_pusher(observation.pusher)
        yield from self._noticed_changes(before, expected)
        yield from self._find_lost()
        self._expected = None

    def _noticed_changes(self, before: EstimatedState, expected: SceneState) -> Iterator[Event]:
        now = self._estimate.state
        angle = before.state.light.angle_to(now.light)
        if angle > _LAMP_RAD:
            yield self._noticed("lamp", f"The lamp was moved by {np.rad2deg(angle):.0f}°: found again.")
        names = moved_by_hand(expected, now)
        if names:
            self._planner.reset()
            self._before = None
            yield self._noticed("object", f"Somebody moved {', '.join(names)}: found again.", names)

    def _find_lost(self) -> Iterator[Event]:
        """Search objects that have been doubtful for some time, after the pusher has moved aside."""
        doubted = (name for name in self._estimate.doubted if name not in self._weak)
        self._doubted = {name: self._doubted.get(name, 0) + 1 for name in doubted}
        lost = tuple(name for name, looks in self._doubted.items() if looks >= _LOST_AFTER)
        if not lost or self._searches >= _SEARCHES:
            return
        self._searches += 1
        self._doubted = {}
        yield self._noticed("lost", f"Lost sight of {', '.join(lost)}; looking for it everywhere.", lost)
        if self.settings.acting:
            yield from self._retreat()
        observation = yield from self._observe()
        steps = relocalize(self._scene.models, observation, self._estimate, self._rng, self._how.goal)
        found = yield from self._run_estimator("search", steps)
        self._estimate = found.estimate.with_pusher(observation.pusher)
        self._planner.reset()
        self._before = None
        if self._estimate.trusted:
            yield self._noticed("found", f"Found {', '.join(lost)} again.", lost)

    def _retreat(self) -> Iterator[Event]:
        """Move the pusher away from the middle of the objects, so that it hides less."""
        state = self._estimate.state
        assert state.pusher is not None
        away = state.pusher[:2] - state.poses.position[:, :2].mean(axis=0)
        direction = away / max(float(np.abs(away).max()), 1e-6)
        for _ in range(min(_RETREAT, self._left())):
            yield self._execute(np.array([*(_RETREAT_M_S * direction), 0.0]))

    # The goal

    def _find_goal(self) -> Iterator[Event]:  # returns whether to go on
        target, state, estimate, doubts, photo = self._target, self._estimate.state, None, "", None
        if isinstance(target, GoalImage):
            shares = {name: share for name, share in self._shares.items() if name not in self._weak}
            steps = estimate_goal_image(self._usual_models, self._scene, target, state, self._how.goal, shares)
            found = yield from self._look("goal", target.observed(state.names), steps)
            self._of_goal = self._usual_models if found.image_model is None else self._scene
            shown = self._of_goal.normalized_goal(target)
            estimate = prefer_current_poses(self._of_goal.models, shown, found.estimate, state)
            goal, doubts = PoseGoal(estimate.state.names, estimate.state.poses), estimate.reason
            light, camera, image = estimate.state.light, target.camera, shown.image
            photo = None if shown is target else target
        else:
            goal, light, photo = target, state.light, target.photo if isinstance(target, PhotoGoal) else None
            camera = goal_camera() if photo is None else photo.camera
            image = self._rendered(replace(state, poses=target.poses_of(state.names)), camera, light)
        self._goal = snap_near_goals(goal, state, self._models.symmetries)
        self._light, self._camera, self._image = light, camera, image
        yield GoalFound(self._goal, image, camera, estimate, None if photo is None else photo.image)
        if doubts:
            yield self._noticed("goal", f"The goal image is not explained well: {doubts}.")
            if not self.settings.despite_doubts:
                yield self._stepped()
                yield self._finished("refused", f"Nothing was moved, because the goal image is doubtful: {doubts}.")
                return False
        return True

    # Planning and acting

    def _plan(self) -> Iterator[Event]:
        plan = self.settings.plan
        self._planner.settings = replace(plan, horizon=min(plan.horizon, self._left()))
        self._goal = nearest_symmetric_goal(self._goal, self._estimate.state, self._models.symmetries)
        make_cost = self._parts.cost or COSTS[self.settings.cost]
        cost = make_cost(CostInputs(self._goal, self._camera, self._image, self._light, self._of_goal.models.together))
        rounds = self._planner.plan(self._estimate.state, self._goal, cost, self._rng, self._before)
        for one in self._timer.steps("plan", rounds):
            yield Planning(self._number, one)

    def _act(self) -> Iterator[Event]:
        state = self._estimate.state
        actions = self._planner.nominal(min(self.settings.replan_every, self._left()))
        futures = self._models.dynamics.rollout(state, actions[None], self._before)
        for action in actions:
            yield self._execute(action)
        self._planner.shift(len(actions))
        self._before = state if len(actions) == 1 else _future(futures, len(actions) - 1, state)
        self._expected = _future(futures, len(actions), state)

    def _execute(self, action: Float[np.ndarray, "3"]) -> ActionExecuted:
        with self._timer.stage("act"):
            self._world.act(action)
        self._number += 1
        return ActionExecuted(self._number, action)

    # Reporting

    def _outcome(self) -> tuple[Outcome, str] | None:
        far, turned = offsets(self._goal, self._estimate.state)
        rolled = self._is_stalled & lies_otherwise(self._goal, self._estimate.state)  # and stays so
        if far.max() <= self.settings.reached_m and np.all(turned[~rolled] <= self.settings.reached_rad):
            if rolled.any():
                names = ", ".join(np.array(self._estimate.state.names)[rolled])
                return "reached", f"All objects are at their goals, but these lie on another side: {names}."
            return "reached", f"The table looks like the goal{'' if self._number else ' already'}."
        if self._left() <= 0:
            return "out of steps", f"All {self._number} pushes are done, but some objects are not at their goals."
        return None

    def _stepped(self) -> Stepped:
        estimate = self._estimate
        self._goal = nearest_symmetric_goal(self._goal, estimate.state, self._models.symmetries)
        far, turned = offsets(self._goal, estimate.state)
        rendered = self._rendered(estimate.state, self._camera, self._light)
        cost = float(((rendered - self._image) ** 2).mean())
        taken = self._timer.taken()
        return Stepped(
            self._number, self._counted_from + self.settings.steps, estimate, far, turned, cost, rendered, taken
        )

    def _rendered(self, state: SceneState, camera: Camera, light: Light) -> Float[np.ndarray, "h w 3"]:
        """Render the scene without the pusher, as the goal camera would see it."""
        batch = SceneBatch.of(replace(state, light=light, pusher=None))
        return self._of_goal.models.together.render(batch, (camera,), quality=_SHOWN).rgb[0, 0]

    def _left(self) -> int:
        """Return the number of actions that may still be executed."""
        return self._counted_from + self.settings.steps - self._number

    def _noticed(self, matter: Matter, text: str, names: tuple[str, ...] = ()) -> Noticed:
        if matter in _DISTURBANCES and self.settings.renewed and self._renewals < _RENEWALS:
            self._counted_from, self._renewals = self._number, self._renewals + 1
        return Noticed(self._number, matter, text, names)

    def _finished(self, outcome: Outcome, text: str) -> Finished:
        return Finished(self._number, outcome, text, self._estimate.state)


def _future(futures: Rollouts, step: int, state: SceneState) -> SceneState:
    """Return the predicted state after some actions, with the pusher where it is then."""
    poses = Pose(futures.positions[0, step], futures.quaternions[0, step])
    return replace(state, poses=poses, pusher=futures.pusher[0, step])


# Models and images that agree. Exposure, response, ambient light and table are kept as the first frame showed them.


@dataclass(frozen=True, eq=False, slots=True)
class AdaptedModels:
    """Models of the objects that are adapted to the images of a scene.

    Attributes:
        models: fields and table, with the scene's ambient light and albedo.
        image_model: image model of the images; None for images like those that the fields were trained for.
    """

    models: ObjectModels
    image_model: ImageModel | None = None

    def to(self, image_model: ImageModel | None, names: tuple[str, ...]) -> AdaptedModels:
        """Adapt these models to images with another image model. They must not be adapted yet.

        Args:
            image_model: image model of the images; None to change nothing.
            names: names of the objects that are needed.
        """
        return self if image_model is None else AdaptedModels(adapted(self.models, names, image_model), image_model)

    def normalized(self, observation: Observation) -> Observation:
        """Return an observation in the units of these models."""
        return observation if self.image_model is None else self.image_model.normalized(observation)

    def normalized_goal(self, goal: GoalImage) -> GoalImage:
        """Return a goal image in the units of these models."""
        return goal if self.image_model is None else replace(goal, image=self.normalized(goal.observed(())).images[0])


def estimate_goal_image(
    usual: AdaptedModels,
    scene: AdaptedModels,
    goal: GoalImage,
    prior: SceneState,
    config: GoalImageConfig | None = None,
    shares: Mapping[str, float] | None = None,
) -> Iterator[EstimateStep]:
    """Estimate the goal image with the image model of the scene and, if that is doubtful, with the usual one.

    Args:
        usual: models that are not adapted.
        scene: models adapted to the first frame.
        goal: one view.
        prior: present state of the scene.
        config: settings.
        shares: by object, its residual in the first frame as a share of its level, see `goal_allowance`.
    """
    best = yield from all_but_last(_estimated(scene, goal, prior, config, shares))
    if scene.image_model is not None and not _is_trusted(best):
        yield replace(best, estimate=None)
        other = yield from all_but_last(_estimated(usual, goal, prior, config, shares))
        best = other if _is_trusted(other) else best
    yield best


def _estimated(
    fitting: AdaptedModels,
    goal: GoalImage,
    prior: SceneState,
    config: GoalImageConfig | None,
    shares: Mapping[str, float] | None,
) -> Iterator[EstimateStep]:
    seen = fitting.normalized_goal(goal).observed(prior.names)
    for step in estimate_goal(fitting.models, seen, prior, config, shares):
        yield step if step.estimate is None else replace(step, image_model=fitting.image_model)


def _is_trusted(step: EstimateStep) -> bool:
    return step.estimate is not None and step.estimate.trusted


# Relocalization of lost objects without masks: template matching in one camera's image, then tracking in all images.


_TIED = 0.02  # share of the workspace by which cameras that see it equally well may differ
_PROBES = 21  # along a side of the workspace


def relocalize(
    models: ObjectModels,
    observation: Observation,
    last: EstimatedState,
    rng: np.random.Generator,
    config: GoalImageConfig | None = None,
) -> Iterator[EstimateStep]:
    """Search the whole table for doubtful objects. The last step has the better of the old and the new estimate.

    One image is searched, from a camera that sees most of the workspace. It is drawn at random among equally good ones,
    so that another search may use another camera.

    Args:
        models: models of the objects and the table.
        observation: all views, if possible without occlusions.
        last: the estimate whose doubtful objects are searched.
        rng: random generator of the search.
        config: settings of the search in the one image.
    """
    state = last.state
    lost = [n for n, doubt in enumerate(last.doubts) if doubt]
    shares = np.array([_share_of_workspace(camera) for camera in observation.cameras])
    view = int(rng.choice(np.flatnonzero(shares >= shares.max() - _TIED)))
    alone = Observation(
        observation.cameras[view : view + 1], observation.images[view : view + 1], observation.names, None, None,
        observation.time_s,
    )  # fmt: skip
    found = None
    for step in estimate_goal(models, alone, state, config):
        found = step.estimate
        yield replace(step, estimate=None)
    assert found is not None
    poses = Pose.stacked((found.state if n in lost else state).pose(name) for n, name in enumerate(state.names))
    expected = replace(state, poses=poses, pusher=observation.pusher)
    for step in estimate_next(models, observation, expected, rng):
        update = step.estimate
        is_worse = update is not None and sum(map(bool, update.doubts)) > len(lost)
        yield replace(step, estimate=last) if is_worse else step


def _share_of_workspace(camera: Camera) -> float:
    """Return the share of a grid of points on the workspace that a camera sees."""
    side = np.linspace(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, _PROBES)
    points = np.stack([*np.meshgrid(side, side), np.zeros((_PROBES, _PROBES))], axis=-1)
    depth = camera.T_world_camera.inverse().apply(points)[..., 2]
    pixels = camera.project(np.where(depth[..., None] > 0, points, np.nan))
    with np.errstate(invalid="ignore"):
        return float(np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=-1).mean())


# Monitoring of an episode: distance to the goal, stalled progress, and changes that no push explains.


_MAX_STALLED = 16  # actions without progress
_PROGRESS_M = 0.003
_LAMP_RAD = np.deg2rad(4.0)
_MOVED_M = 0.03  # an object this far from where it was expected, and out of the pusher's reach, was carried
_REACH_M = 0.2  # from the pusher to the middle of what it may have pushed, perhaps by way of another object


def offsets(goal: PoseGoal, state: SceneState) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Return the distance of each object from its goal on the table's plane [m], and its angle from the goal [rad]."""
    target = np.array([goal.pose(name).quaternion for name in state.names]).reshape(-1, 4)
    turned = rotation_angle(state.poses.quaternion, target)
    return np.linalg.norm(goal.offsets_m(state), axis=1), np.asarray(turned)


def lies_otherwise(goal: PoseGoal, state: SceneState) -> Bool[np.ndarray, "N"]:
    """Return which objects lie on another side than in the goal, so that no turn about the vertical is enough."""
    turns = (planar_turn(state.pose(name).quaternion, goal.pose(name).quaternion) for name in state.names)
    return np.array([turn is None for turn in turns], bool)


class ProgressMonitor:
    """Detects that the distance to the goal no longer shrinks."""

    def __init__(self) -> None:
        self._least, self._since = np.inf, 0

    def is_stalled(self, distance_m: float) -> bool:
        """Record the distance after an action; return whether it has not shrunk for 16 actions, then restart."""
        if distance_m < self._least - _PROGRESS_M:
            self._least, self._since = distance_m, 0
            return False
        self._since += 1
        if self._since < _MAX_STALLED:
            return False
        self._least, self._since = distance_m, 0
        return True


def moved_by_hand(expected: SceneState, now: SceneState) -> tuple[str, ...]:
    """Return objects that are not where they were expected and too far from the pusher to have been pushed."""
    assert now.pusher is not None
    shift = np.linalg.norm(now.poses.position - expected.poses.position, axis=1)
    ends = [now.pusher] if expected.pusher is None else [now.pusher, expected.pusher]
    away = np.min([np.linalg.norm(expected.poses.position[:, :2] - end[:2], axis=1) for end in ends], axis=0)
    is_moved = (shift > _MOVED_M) & (away > _REACH_M + PUSHER_RADIUS_M)
    return tuple(name for name, flag in zip(now.names, is_moved, strict=True) if flag)


# Wall time of the stages of an episode, without the time that its caller takes between two events.


StepT = TypeVar("StepT")


class StageTimer:
    """Sums the time of each stage [s]."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time within the context to a stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - began

    def steps(self, name: str, steps: Iterator[StepT]) -> Iterator[StepT]:
        """Yield steps, and add the time that each of them takes to a stage."""
        while True:
            with self.stage(name):
                step = next(steps, None)
            if step is None:
                return
            yield step

    def taken(self) -> dict[str, float]:
        """Return the time of each stage [s] since the last call."""
        taken, self._seconds = self._seconds, {}
        return taken
