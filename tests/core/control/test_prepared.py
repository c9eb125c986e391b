import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.closed_loop import Episode
from osfcore.control.events import EpisodeSettings, GoalFound, Looking, Stepped
from osfcore.control.goal import GoalImage
from osfcore.control.prepared import PreparedLook, PreparedLooks, prepared_from_json, prepared_to_json
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.planning.mppi import PlanSettings
from tests.support.tabletop_scenes import CAN, models, sure, table

KNOWN = models()
SMALL = EpisodeSettings(steps=1, plan=PlanSettings(samples=16, horizon=4))


@pytest.fixture
def world(library):
    world = table(library)
    yield world
    world.close()


@pytest.fixture
def goal(world):
    return GoalImage(goal_camera(), world.render((goal_camera(),), with_pusher=False).images[0])


@pytest.fixture
def prepared(world, goal):
    truth = world.truth()
    looks = (world.observe(), truth), (goal.observed(truth.names), replace(truth, pusher=None))
    return PreparedLooks(*(PreparedLook.of(KNOWN.appearance, seen, sure(state)) for seen, state in looks))


def test_it_explains_what_it_was_made_from_and_nothing_else(world, prepared):
    assert prepared.first.explains(KNOWN.appearance, world.observe())
    pose = world.truth().pose(CAN)
    world.move_object(CAN, Pose(pose.position + [0.02, 0.0, 0.0], pose.quaternion))
    assert not prepared.first.explains(KNOWN.appearance, world.observe())


@pytest.mark.slow
def test_an_episode_takes_what_fits_and_looks_itself_for_the_rest(world, goal, prepared):
    """The can is moved after the preparation: the first frame is estimated anew, the goal image is not."""
    pose = world.truth().pose(CAN)
    world.move_object(CAN, Pose(pose.position + [0.0, 0.05, 0.0], pose.quaternion))
    episode = Episode(world, KNOWN, goal, SMALL, np.random.default_rng(0), prepared=prepared)
    looks = {"first": 0, "goal": 0, "next": 0}
    for event in episode.run():
        if isinstance(event, Looking):
            looks[event.look] += 1
        if isinstance(event, Stepped):
            break
        if isinstance(event, GoalFound):
            np.testing.assert_allclose(event.goal.pose(CAN).position, pose.position, atol=1e-6)
    assert looks["first"] > 5
    assert looks["goal"] == 1
    truth = world.truth()
    np.testing.assert_allclose(event.estimate.state.poses.position, truth.poses.position, atol=3e-3)


def test_it_is_the_same_once_written_and_read_and_what_is_not_whole_is_refused(prepared):
    read = prepared_from_json(json.loads(json.dumps(prepared_to_json(prepared))))
    for mine, theirs in ((prepared.first, read.first), (prepared.goal, read.goal)):
        np.testing.assert_allclose(mine.residuals, theirs.residuals, atol=1e-6)
        np.testing.assert_allclose(mine.estimate.state.poses.position, theirs.estimate.state.poses.position, atol=1e-12)
        assert mine.estimate.state.names == theirs.estimate.state.names
    data = prepared_to_json(prepared)
    few = {"first": {**data["first"], "residuals": [0.1]}}
    for spoil in ({"goal": None}, {"first": {"estimate": {}, "residuals": []}}, few):
        with pytest.raises(InvalidInput):
            prepared_from_json({**data, **spoil})
