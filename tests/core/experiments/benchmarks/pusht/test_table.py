import numpy as np
import pytest

from osfcore.dynamics.shapes import ShapeTable, part_outlines
from osfcore.experiments.pusht import cost_of, goal_of, pose_of, rollouts_of, scene_of, tee_shape
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M

STATE = np.array([100.0, 356.0, 5.0, -5.0, 256.0, 196.0, 0.0])


def area(corners):
    x, y = corners.T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2


def outlines(tee):
    return part_outlines(ShapeTable((tee_shape(),)), 0, pose_of(np.array(tee)))


def test_a_millimetre_is_a_pixel_and_the_middle_is_the_middle():
    scene = scene_of(STATE)
    np.testing.assert_allclose(
        scene.poses.position[0, :2], 0, atol=1e-12
    )  # the box around the T is 120 px wide and high
    np.testing.assert_allclose(scene.pusher, [-0.156, 0.1, PUSHER_CENTRE_Z_M], atol=1e-12)


def test_the_tee_is_two_boxes():
    shape = tee_shape()
    np.testing.assert_allclose(shape.half_extents[:2], 0.06, atol=1e-12)
    areas = [area(part) for part in outlines((256, 256, 0.0))]
    np.testing.assert_allclose(areas, [0.12 * 0.03, 0.03 * 0.09], rtol=1e-4)


def test_the_tee_lies_where_the_environment_draws_it():
    envs = pytest.importorskip("gym_pusht.envs.pusht")
    env = envs.PushTEnv()
    env.reset(seed=4)
    tee = (*env.block.position, env.block.angle)
    for shape in env.block.shapes:
        theirs = (np.array([env.block.local_to_world(v) for v in shape.get_vertices()]) - 256) / 1000
        ours = min(outlines(tee), key=lambda part: np.linalg.norm(part.mean(axis=0) - theirs.mean(axis=0)))
        nearest = np.linalg.norm(theirs[:, None] - ours, axis=-1).min(axis=1)
        np.testing.assert_allclose(nearest, 0, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5, 7.0])
def test_a_turn_is_about_the_origin_of_the_environments_tee(angle):
    origin = np.array([0.0, -0.06, 0.0])  # in our frame, whose origin is the middle of the box
    np.testing.assert_allclose(pose_of(np.array([300.0, 200.0, angle])).apply(origin)[:2], [0.044, -0.056], atol=1e-12)


def test_futures_and_scenes_agree_and_the_goal_costs_nothing():
    states = np.tile(STATE, (2, 4, 1))
    states[1, :, 4:] += (30.0, 0.0, 0.5)
    futures = rollouts_of(states)
    scene = scene_of(STATE)
    np.testing.assert_allclose(futures.positions[0, 2], scene.poses.position, atol=1e-12)
    np.testing.assert_allclose(futures.pusher[1, 3], scene.pusher, atol=1e-12)
    costs = cost_of(goal_of(STATE[4:]))(futures)
    assert costs[0] == pytest.approx(0, abs=1e-6)
    assert costs[1] > 0.03
