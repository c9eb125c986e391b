from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.estimators import load_scene_models
from osfcore.experiments.rearrangement import Course, prediction_errors
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

BOX = "009_gelatin_box"
PUSH = np.array([0.0, 0.15, 0.0])


@pytest.fixture(scope="module")
def models(library):
    return load_scene_models((BOX,), FieldLibrary(None), library, None)


def pushed(library, models, count=6):
    """The course of straight pushes of a box, whose estimates are the truth."""
    world = Tabletop(library, request=SceneRequest(names=(BOX,)))
    world.arrange(2)
    box = world.truth().pose(BOX)
    world.load(replace(world.truth(), pusher=box.position * [1, 1, 0] + [0, -0.09, 0.062]))
    course = Course()
    for number in range(count + 1):
        if number:
            world.act(PUSH)
            course.actions[number] = PUSH
        course.true[number] = course.estimated[number] = world.truth()
    world.close()
    return course


def test_a_straight_push_of_a_box_is_predicted_within_a_centimetre(library, models):
    course = pushed(library, models)
    told = prediction_errors(course, models)
    assert len(told["mm"]) == len(told["deg"]) >= 2  # of three starts
    assert max(told["mm"]) < 10


def test_what_did_not_move_does_not_count(library, models):
    course = pushed(library, models)
    for number, state in course.true.items():
        course.true[number] = replace(state, poses=course.true[0].poses)
    assert prediction_errors(course, models) == {"mm": [], "deg": []}


def test_an_estimate_that_is_off_shows_in_the_error(library, models):
    course = pushed(library, models, count=4)
    exact = prediction_errors(course, models)["mm"]
    first = course.estimated[0]
    shift = np.array([0.3, 0, 0])  # out of the pusher's way
    course.estimated = {0: replace(first, poses=Pose(first.poses.position + shift, first.poses.quaternion))}
    off = prediction_errors(course, models)["mm"]
    assert off[0] > 290 > exact[0]


def test_starts_without_four_actions_after_them_are_left_out(library, models):
    course = pushed(library, models, count=3)
    assert prediction_errors(course, models) == {"mm": [], "deg": []}
    course = pushed(library, models, count=4)
    del course.actions[2]
    assert prediction_errors(course, models) == {"mm": [], "deg": []}
