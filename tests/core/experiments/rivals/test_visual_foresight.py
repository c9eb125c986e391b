from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.goal import GoalImage
from osfcore.errors import InvalidInput
from osfcore.experiments.rearrangement_runs import Ended
from osfcore.experiments.rivals import visual_foresight as foresight
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.world.tasks import TaskSet, draw_task
from tests.support.errors import about

SIDE, SPREAD_M = 16, 0.15
SETTINGS = foresight.ForesightSettings(samples=48, horizon=4, rounds=2, temperature=0.1)
CAMERA = goal_camera(SIDE)
AXIS = np.linspace(-0.4, 0.4, SIDE)


def blob(place) -> np.ndarray:
    """What shows where something is: a Gaussian around places (..., 2) on a square of 0.8 m."""
    place = np.asarray(place)[..., None, None, :]
    x, y = np.meshgrid(AXIS, AXIS)
    height = np.exp(-((x - place[..., 0]) ** 2 + (y - place[..., 1]) ** 2) / (2 * SPREAD_M**2))
    return np.repeat(height[..., None], 3, axis=-1)


class BlobWorld:
    """The pusher is all there is."""

    def __init__(self, cameras=None):
        self.cameras = (default_cameras(SIDE)[0], CAMERA) if cameras is None else cameras
        self.place, self.actions = np.zeros(2), []

    def reset(self, seed):
        raise NotImplementedError

    def observe(self, *, masks=False):
        seen = {"goal": blob(self.place)}
        images = np.stack([seen.get(c.name, np.zeros((SIDE, SIDE, 3))) for c in self.cameras])
        return Observation(self.cameras, images, (), None, np.array([*self.place, 0.06]), 0.0)

    def act(self, action):
        self.actions.append(action)
        self.place = self.place + STEP_S * action[:2]

    def close(self):
        pass


class BlobPredictor:
    """Knows where the last frame's blob goes, and what was asked."""

    def __init__(self):
        self.asked = []

    def predict(self, context_frames, actions, pusher, *, between=None):
        self.asked.append((context_frames, actions, pusher, between))
        x, y = np.meshgrid(AXIS, AXIS)
        height = context_frames[1, ..., 0]
        peak = np.unravel_index(height.argmax(), height.shape)
        near = (np.abs(x - AXIS[peak[1]]) < 0.2) & (np.abs(y - AXIS[peak[0]]) < 0.2)
        weight = height**4 * near
        place = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        return blob(place + STEP_S * np.cumsum(actions[..., :2], axis=1))


def goal_at(place) -> GoalImage:
    return GoalImage(CAMERA, blob(place))


def run(place, settings=SETTINGS, steps=8, seed=0, predictor=None):
    goal, world = goal_at(place), BlobWorld()
    planner = foresight.VisualForesight(predictor or BlobPredictor(), goal.image, settings)
    return world, list(foresight.foresee(world, goal, planner, steps, np.random.default_rng(seed)))


@pytest.mark.parametrize("place", [(0.15, 0.0), (-0.1, 0.12)])
def test_it_moves_to_where_the_goal_image_shows_it(place):
    world, steps = run(place)
    assert np.linalg.norm(world.place - place) < 0.03
    assert steps[-1].plan.costs.min() < 0.1 * steps[0].plan.costs.min()
    assert [step.number for step in steps] == list(range(8))
    for action, step in zip(world.actions, steps, strict=True):
        np.testing.assert_array_equal(action, step.action)
        np.testing.assert_array_equal(action, step.plan.actions[0])
        assert np.abs(action).max() <= MAX_SPEED_M_S
        assert action[2] == 0


def test_the_predictor_gets_both_frames_and_the_action_between_them():
    predictor = BlobPredictor()
    world, steps = run((0.1, 0.0), settings=replace(SETTINGS, rounds=1), steps=3, predictor=predictor)
    assert [between is None for *_, between in predictor.asked] == [True, False, False]
    np.testing.assert_array_equal(predictor.asked[0][0][0], predictor.asked[0][0][1])
    for (context, actions, pusher, between), before, now in zip(predictor.asked[1:], steps, steps[1:], strict=False):
        np.testing.assert_allclose(pusher[:2], STEP_S * sum(step.action[:2] for step in steps[: now.number]))
        np.testing.assert_array_equal(context[0], before.image)
        np.testing.assert_array_equal(context[1], now.image)
        np.testing.assert_array_equal(between, before.action)
        assert actions.shape == (48, 4, 3)
        np.testing.assert_allclose(actions[0, :3], before.plan.actions[1:], atol=1e-12)  # warm-started
    assert len(world.actions) == 3


def test_costs_are_squared_differences_from_the_goal_summed_over_steps():
    """Whatever is done, this predictor sees the same: half a unit away from the goal in every pixel."""

    class Constant:
        def predict(self, context_frames, actions, pusher, *, between=None):
            return np.full((*actions.shape[:2], SIDE, SIDE, 3), 0.5, np.float32)

    planner = foresight.VisualForesight(Constant(), np.zeros((SIDE, SIDE, 3)), SETTINGS)
    plan = planner.plan(np.zeros((2, SIDE, SIDE, 3)), np.zeros(3), None, np.random.default_rng(0))
    np.testing.assert_allclose(plan.costs, 4 * 0.25, atol=1e-12)
    assert np.abs(plan.actions).max() < MAX_SPEED_M_S  # equal costs: the mean of all


def test_a_world_that_does_not_show_the_goals_view_is_refused():
    goal, larger = goal_at((0.0, 0.1)), GoalImage(goal_camera(32), np.zeros((32, 32, 3)))
    planner = foresight.VisualForesight(BlobPredictor(), goal.image, SETTINGS)
    for world, wanted in ((BlobWorld(default_cameras(SIDE)), goal), (BlobWorld(), larger)):
        with pytest.raises(InvalidInput, check=about("cameras")):
            list(foresight.foresee(world, wanted, planner, 1, np.random.default_rng(0)))
        assert world.actions == []


def test_settings_out_of_range_are_refused():
    for bad, subject in (({"samples": 1}, "samples"), ({"smoothing": 1.0}, "noise")):
        with pytest.raises(InvalidInput, check=about(subject)):
            foresight.ForesightSettings(**bad)


def test_a_task_is_done_in_the_simulator_from_its_goal_image_alone(library):
    task = draw_task(library, TaskSet(("009_gelatin_box",), objects=1), 1).task
    predictor = BlobPredictor()
    rng = np.random.default_rng(0)
    settings = foresight.ForesightSettings(samples=4, horizon=2, rounds=1)
    *steps, ended = foresight.run_visual_foresight(task, library, predictor, settings, 2, rng, size=SIDE)
    assert all(isinstance(step, foresight.Foreseen) for step in steps)
    assert len(steps) == 2
    assert isinstance(ended, Ended)
    assert ended.image.shape == ended.goal.shape == (SIDE, SIDE, 3)
    way = STEP_S * sum(step.action for step in steps)
    np.testing.assert_allclose(ended.state.pusher, task.start.pusher + way, atol=1e-12)
    assert np.abs(ended.image - ended.goal).max() > 0.05  # something has to move
