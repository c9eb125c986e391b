from dataclasses import replace

import numpy as np
import pytest

from app.jobs.kinds.episodes import RemoteWorld
from app.processes.messages.scene_messages import Act, ObservedScene, ObserveScene, SceneRecord, TakeView
from osfcore.errors import InvalidInput, NotThere, OsfError
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.io.image_file import to_uint8
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.support.errors import about

NAMES = ("005_tomato_soup_can", "009_gelatin_box")
SIDE = 32


class Stage:
    """Answers as the stage process does."""

    def __init__(self, world):
        self.world, self.asked = world, []

    def __call__(self, command):
        self.asked.append(command)
        match command:
            case Act():
                for action in command.actions:
                    self.world.act(action)
            case ObserveScene():
                return ObservedScene(self.record(command.id), self.world.observe(masks=command.masks))
            case TakeView():
                return to_uint8(self.world.render((command.camera,), with_pusher=command.pusher).images[0])
        return self.record(command.id)

    def record(self, scene):
        state = self.world.truth()
        return SceneRecord(scene, 0, "", SIDE, state, state, self.world.time_s, 1)


@pytest.fixture
def stage(library):
    world = Tabletop(library, cameras=default_cameras(SIDE), request=SceneRequest(names=NAMES))
    world.arrange(1)
    yield Stage(world)
    world.close()


@pytest.fixture
def remote(stage):
    return RemoteWorld(stage, "s1")


@pytest.mark.parametrize("masks", [False, True])
def test_what_the_cameras_see_comes_over(remote, stage, masks):
    seen, true = remote.observe(masks=masks), stage.world.observe(masks=masks)
    np.testing.assert_allclose(seen.images, true.images, atol=1e-6)
    assert seen.names == true.names
    np.testing.assert_allclose(seen.pusher, true.pusher, atol=1e-12)
    assert (seen.masks is None) == (not masks)
    if masks:
        np.testing.assert_array_equal(seen.masks, true.masks)


def test_actions_are_done_there(remote, stage):
    before = stage.world.truth()
    remote.act(np.array([0.1, -0.05, 0.0]))
    np.testing.assert_allclose(stage.world.truth().pusher - before.pusher, [0.02, -0.01, 0], atol=1e-9)
    np.testing.assert_array_equal(remote.truth().pusher, stage.world.truth().pusher)


def test_an_action_beyond_the_limits_is_not_even_sent(remote, stage):
    with pytest.raises(InvalidInput, check=about("action")):
        remote.act(np.array([9.0, 0.0, 0.0]))
    assert stage.asked == []


def test_the_truth_is_asked_for_without_moving_anything(remote, stage):
    np.testing.assert_array_equal(remote.truth().poses.position, stage.world.truth().poses.position)
    assert stage.world.time_s == 0
    assert [command.actions for command in stage.asked] == [()]


@pytest.mark.parametrize("size", [(SIDE, SIDE), (3 * SIDE, 2 * SIDE)])
def test_a_photo_shows_what_any_camera_sees_with_the_pusher(remote, stage, size):
    camera = replace(goal_camera(size[0]), height=size[1])
    photo = remote.photo(camera)
    assert photo.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(photo, stage.world.render((camera,)).images[0], atol=0.5 / 255 + 1e-6)
    (command,) = stage.asked
    assert (command.id, command.pusher) == ("s1", True)
    assert stage.world.time_s == 0


def test_what_the_stage_refuses_is_told():
    def refuse(_):
        raise NotThere("scene")

    remote = RemoteWorld(refuse, "s1")
    for call in (
        remote.observe,
        remote.truth,
        lambda: remote.act(np.zeros(3)),
        lambda: remote.photo(goal_camera(SIDE)),
    ):
        with pytest.raises(OsfError, match="no such scene"):
            call()


def test_nobody_resets_a_scene_of_the_service(remote):
    with pytest.raises(OsfError, match="reset"):
        remote.reset(0)
    remote.close()
    remote.close()
