import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as module
from osfcore.errors import NoRoom
from osfcore.experiments.estimation_tasks import episode, first_frame, goals, take_frame
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.world.collect_pushes import DirectedPolicy
from osfcore.world.tasks import draw_scene, opened
from tests.core.experiments.solids import SOLIDS

CAMERAS = default_cameras(32)[:2]


@pytest.fixture(scope="module")
def draw():
    return draw_scene(SOLIDS, 2, 5, 0)


@pytest.fixture(scope="module")
def start(draw, library):
    return first_frame(draw, library, CAMERAS)


def same(a, b):
    np.testing.assert_array_equal(a.poses.position, b.poses.position)
    np.testing.assert_array_equal(a.poses.quaternion, b.poses.quaternion)
    np.testing.assert_array_equal(a.light.direction, b.light.direction)


def test_a_first_frame_is_the_draw_at_rest(draw, start, library):
    assert start.truth.names == start.observation.names == draw.names
    np.testing.assert_array_equal(start.truth.light.direction, draw.light.direction)
    assert np.rad2deg(np.arcsin(draw.light.direction[2])) >= 10
    assert start.observation.masks.shape == (2, 2, 32, 32)
    np.testing.assert_array_equal(start.observation.pusher, start.truth.pusher)
    assert start.absent == ("", "")
    again = first_frame(draw, library, CAMERAS)
    same(again.truth, start.truth)
    np.testing.assert_array_equal(again.observation.images, start.observation.images)


@pytest.fixture(scope="module")
def pushes(draw, library):
    return episode(draw, library, CAMERAS)


def test_an_episode_pushes_something_by_five_centimetres(pushes, start):
    assert len(pushes.frames) == 20
    assert max(pushes.moved_m) >= 0.05
    places = np.stack([frame.truth.poses.position[:, :2] for frame in pushes.frames])
    farthest = np.linalg.norm(places - start.truth.poses.position[:, :2], axis=2).max(axis=0)
    np.testing.assert_allclose(pushes.moved_m, farthest, atol=1e-12)
    assert np.linalg.norm(places[0] - start.truth.poses.position[:, :2], axis=1).max() < 0.1  # it goes on from there
    for frame in pushes.frames:
        assert frame.observation.masks is None
        np.testing.assert_array_equal(frame.observation.pusher, frame.truth.pusher)
        np.testing.assert_array_equal(frame.truth.light.direction, start.truth.light.direction)


def test_an_episode_is_the_same_for_the_same_draw(draw, library, pushes):
    again = episode(draw, library, CAMERAS)
    for one, other in zip(again.frames, pushes.frames, strict=True):
        same(one.truth, other.truth)


def test_pushes_that_move_nothing_are_drawn_again(draw, library, monkeypatch):
    made = []

    class Lazy(DirectedPolicy):
        """The first two rest."""

        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

        def action(self, state):
            return np.zeros(3) if len(made) < 3 else super().action(state)

    monkeypatch.setattr(module, "DirectedPolicy", Lazy)
    found = episode(draw, library, CAMERAS[:1])
    assert found.redrawn == len(made) - 1 >= 2
    assert max(found.moved_m) >= 0.05


def test_goals_move_one_object_more_each_time(draw, library, start):
    found = goals(draw, library, goal_camera(32))
    assert [len(goal.moved) for goal in found] == [1, 2]
    for goal in found:
        frame = goal.frame
        assert frame.observation.masks is frame.observation.pusher is frame.truth.pusher is None
        assert [camera.name for camera in frame.observation.cameras] == ["goal"]
        assert np.abs(frame.truth.light.direction - start.truth.light.direction).max() > 0.01
        for name in draw.names:
            before, after = start.truth.pose(name), frame.truth.pose(name)
            shift = np.linalg.norm(after.position - before.position)
            if name in goal.moved:
                assert 0.07 < shift < 0.21
                tilt = [rotate(pose.quaternion, np.eye(3))[:, 2] for pose in (before, after)]
                np.testing.assert_allclose(*tilt, atol=0.02)  # only about the vertical
            else:
                assert shift < 0.002
                assert rotation_angle(before.quaternion, after.quaternion) < 0.02


def test_what_fell_off_or_is_out_of_view_is_told(draw, library):
    with opened(draw, library) as world:
        state = world.truth()
        position = state.poses.position.copy()
        position[0] = 0.9, 0.0, -0.7
        world.restore(SceneState(state.names, Pose(position, state.poses.quaternion), state.light, state.pusher))
        assert take_frame(world, CAMERAS, masks=False).absent == ("off the table", "")
        position[0] = -0.55, -0.55, 0.1
        world.restore(SceneState(state.names, Pose(position, state.poses.quaternion), state.light, state.pusher))
        camera = default_cameras(32)[2:3]
        assert take_frame(world, camera, masks=False).absent[0] == "out of view"


def test_where_objects_do_not_fit_another_layout_is_tried(draw, library, monkeypatch):
    tried = []

    def arrange(world, seed):
        tried.append(seed)
        if len(tried) < 3:
            raise NoRoom(draw.names, 1)

    monkeypatch.setattr(module.Tabletop, "arrange", arrange)
    with opened(draw, library):
        assert tried == [draw.seed, draw.seed + 1, draw.seed + 2]

    def never(world, seed):
        raise NoRoom(draw.names, 1)

    monkeypatch.setattr(module.Tabletop, "arrange", never)
    with pytest.raises(NoRoom), opened(draw, library):
        pass
