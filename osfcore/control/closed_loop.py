"""Algorithm 1: estimate, plan, act, look again, as a generator of events over a world.

Deviations from the paper: goal poses are found once, before anything moves, so that pushes can be aimed at them and a
goal that cannot be explained is told at once; each later estimate begins at what the dynamics model predicted; an
object that was lost is looked for, a lamp that was moved is estimated again, and where nothing gets better plans are
drawn anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.control.adapted_models import AdaptedModels, estimate_goal_image
from osfcore.control.episode_settings import EpisodeSettings
from osfcore.control.estimators import EpisodeParts
from osfcore.control.events import (
    ActionExecuted,
    Event,
    Finished,
    GoalFound,
    Look,
    Looking,
    Noticed,
    Observed,
    Outcome,
    Planning,
    Stepped,
)
from osfcore.control.goal import GoalImage, PhotoGoal, nearest_symmetric_goal, prefer_current_poses, snap_near_goals
from osfcore.control.monitor import ProgressMonitor, lamp_moved, lies_otherwise, moved_by_hand, offsets
from osfcore.control.prepared_look import PreparedLooks
from osfcore.control.relocalization import relocalize
from osfcore.control.scene_models import SceneModels
from osfcore.control.sight import Sight
from osfcore.control.stage_timer import StageTimer
from osfcore.control.world_protocol import World
from osfcore.errors import InvalidInput
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.uncertainty import expected_fit, object_residuals, relative_residuals
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import Observation, SceneState
from osfcore.planning.parts import COSTS, CostInputs, PlannerInputs
from osfcore.planning.pose_cost import ARM_M, Cost, PoseGoal
from osfcore.planning.push_proposals import PushProposals
from osfcore.render.types import Quality, SceneBatch

_SHOWN = Quality(samples_per_side=2)
_LOST_AFTER = 2  # looks at which an object is doubted, one after another
_SEARCHES = 2  # for lost objects, at most, in one episode: each takes as long as a goal image
_RETREAT = 2  # actions away from the objects, before a search
_DISTURBANCES = frozenset({"lamp", "object", "found", "camera", "brightness"})  # after which steps are counted anew
_RENEWALS = 10  # at most: something that flickers must not keep a robot going for ever


class Episode:
    """One table on its way to a goal.

    Whoever drives it takes events one by one: not asking for the next one is a pause, closing the generator is the end.

    Args:
        world: cameras and pusher.
        models: of the objects.
        goal: an image, or poses, perhaps with a photograph of them.
        settings: may be replaced while the episode runs.
        rng: draws everything.
        start: what is known of the first frame already; without it, it is estimated from images with masks.
        prepared: estimates that are used in place of new ones where they explain the images.
        parts: that estimate, plan and compare futures.
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
        """Everything, until a `Finished`.

        Raises:
            InvalidInput: if the world gives no masks for the first frame, or goal and scene hold other objects.
            UnknownName: if an object is not known.
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
                yield self._noticed("stalled", "Nothing has come nearer for some time; drawing new plans.")

    # Looking

    def _begin(self) -> Iterator[Event]:
        observation = yield from self._observe(masks=self._start is None)
        self._check_objects(observation.names)
        if self._start is None:
            steps = self._how.first_frame(self._models.appearance, observation, self._rng)
            found = yield from self._look("first", observation, steps)
            self._estimate = found.estimate
            self._scene = self._of_goal = self._scene.to(found.image_model, observation.names)
            observation = self._scene.normalized(observation)
            if found.image_model is not None and found.image_model.told:
                yield self._noticed("pictures", f"The pictures are unusual ({found.image_model.told}); allowed for.")
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
        yield Observed(self._number, raw)
        observation, changes = self._sight.take(raw)
        for change in changes:
            yield self._noticed(change.matter, change.text)
        return self._scene.normalized(observation)

    def _look(
        self, look: Look, observation: Observation, steps: Iterator[EstimateStep]
    ) -> Iterator[Event]:  # returns the last EstimateStep
        """What was prepared, if it fits; else what an estimator finds."""
        with self._timer.stage(look):
            step = None if self._prepared is None else self._prepared.step(look, self._models.appearance, observation)
        if step is None:
            return (yield from self._run_estimator(look, steps))
        yield Looking(self._number, look, step)
        what = "first frame" if look == "first" else "goal image"
        yield self._noticed("prepared", f"The estimate of the {what} was prepared with this example.")
        return step

    def _check_objects(self, names: tuple[str, ...]) -> None:
        if isinstance(self._target, PoseGoal) and set(self._target.names) != set(names):
            raise InvalidInput("objects of the goal", ", ".join(self._target.names), ", ".join(names))

    def _run_estimator(
        self, look: Look, steps: Iterator[EstimateStep]
    ) -> Iterator[Event]:  # returns the last EstimateStep
        last = None
        for step in self._timer.steps(look if look in ("first", "goal") else "estimate", steps):
            last = step
            yield Looking(self._number, look, step)
        assert last is not None
        assert last.estimate is not None, "the last step brings the estimate"
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
        angle = lamp_moved(before.state.light, now.light)
        if angle is not None:
            yield self._noticed("lamp", f"The lamp was moved by {np.rad2deg(angle):.0f}°: found again.")
        names = moved_by_hand(expected, now)
        if names:
            self._planner.reset()
            self._before = None
            yield self._noticed("object", f"Somebody moved {', '.join(names)}: found again.", names)

    def _find_lost(self) -> Iterator[Event]:
        """Look anew for what has been doubted for some time, once the pusher has made room."""
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
        """Draw the pusher back from the middle of the objects, so that it hides less."""
        state = self._estimate.state
        assert state.pusher is not None
        away = state.pusher[:2] - state.poses.position[:, :2].mean(axis=0)
        direction = away / max(float(np.abs(away).max()), 1e-6)
        for _ in range(min(_RETREAT, self._left())):
            yield self._execute(np.array([*(0.2 * direction), 0.0]))

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
                yield self._finished("refused", f"Nothing was moved, for the goal image is doubtful: {doubts}.")
                return False
        return True

    # Planning and acting

    def _plan(self) -> Iterator[Event]:
        plan = self.settings.plan
        self._planner.settings = replace(plan, horizon=min(plan.horizon, self._left()))
        self._goal = nearest_symmetric_goal(self._goal, self._estimate.state, self._models.symmetries)
        rounds = self._planner.plan(self._estimate.state, self._goal, self._cost(), self._rng, self._before)
        for one in self._timer.steps("plan", rounds):
            yield Planning(self._number, one)

    def _cost(self) -> Cost:
        make = self._parts.cost or COSTS[self.settings.cost]
        return make(CostInputs(self._goal, self._camera, self._image, self._light, self._of_goal.models.together))

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

    # Telling

    def _outcome(self) -> tuple[Outcome, str] | None:
        far, turned = offsets(self._goal, self._estimate.state)
        rolled = self._is_stalled & lies_otherwise(self._goal, self._estimate.state)  # and stays so
        if far.max() <= self.settings.reached_m and np.all(turned[~rolled] <= self.settings.reached_rad):
            if rolled.any():
                names = ", ".join(np.array(self._estimate.state.names)[rolled])
                return "reached", f"Everything is in its place, but on another side than in the goal: {names}."
            return "reached", f"The table looks like the goal{'' if self._number else ' already'}."
        if self._left() <= 0:
            return "out of steps", f"All {self._number} pushes are done, and not everything is in its place."
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
        """The scene without the pusher, as the goal image would show it."""
        batch = SceneBatch.of(replace(state, light=light, pusher=None))
        return self._of_goal.models.together.render(batch, (camera,), quality=_SHOWN).rgb[0, 0]

    def _left(self) -> int:
        """Actions that may still be executed."""
        return self._counted_from + self.settings.steps - self._number

    def _noticed(self, matter: str, text: str, names: tuple[str, ...] = ()) -> Noticed:
        if matter in _DISTURBANCES and self.settings.renewed and self._renewals < _RENEWALS:
            self._counted_from, self._renewals = self._number, self._renewals + 1
        return Noticed(self._number, matter, text, names)  # pyright: ignore[reportArgumentType]

    def _finished(self, outcome: Outcome, text: str) -> Finished:
        return Finished(self._number, outcome, text, self._estimate.state)


def _future(futures: Rollouts, step: int, state: SceneState) -> SceneState:
    """The predicted state after some actions; the pusher where it is then, for nothing has been pushed since."""
    poses = Pose(futures.positions[0, step], futures.quaternions[0, step])
    return replace(state, poses=poses, pusher=futures.pusher[0, step])
