from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from app.api.schemas.goals import DraftIn, DraftKeep, DraftOut, DraftPatch, GoalIn, GoalOut
from app.services.goals.goals import Draft
from app.storage.records import GoalRecord
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import MAX_OBJECTS

PLACED = {"name": "box", "position": [0.1, 0.2, 0.3], "quaternion": [1, 0, 0, 0]}
POSES = (("box", Pose(np.array([0.1, 0.2, 0.3]), np.array([1.0, 0, 0, 0]))),)


def goal(**changes):
    at = "2026-01-01T00:00:00.000Z"
    return replace(GoalRecord("a", "Mine", at, "composed", "s", goal_camera(64), POSES), **changes)


@pytest.mark.parametrize("body", [{"objects": [PLACED]}, {"random": {}}, {"scene": None, "random": {"moved": None}}])
def test_a_goal_is_either_laid_out_or_drawn(body):
    assert GoalIn.model_validate(body).name == "Goal"


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"objects": [PLACED], "random": {}},
        {"objects": []},
        {"objects": [PLACED] * (MAX_OBJECTS + 1)},
        {"objects": [{**PLACED, "position": [0, 0]}]},
        {"objects": [{**PLACED, "position": [0, 0, float("nan")]}]},
        {"random": {"seed": -1}},
        {"random": {"moved": 0}},
        {"random": {"moved": MAX_OBJECTS + 1}},
        {"random": {}, "name": ""},
        {"random": {}, "name": "x" * 101},
        {"random": {}, "scene": ""},
        {"random": {}, "more": 1},
    ],
)
def test_anything_else_is_refused(body):
    with pytest.raises(ValidationError):
        GoalIn.model_validate(body)


def test_drafts_name_a_scene_objects_and_in_the_end_themselves():
    assert DraftIn.model_validate({}).scene is None
    ((name, pose),) = DraftPatch.model_validate({"objects": [PLACED]}).named_poses()
    assert (name, pose.position.tolist()) == ("box", PLACED["position"])
    assert DraftKeep.model_validate({}).name
    for model, body in ((DraftPatch, {}), (DraftPatch, {"objects": []}), (DraftKeep, {"name": ""})):
        with pytest.raises(ValidationError):
            model.model_validate(body)


def test_a_goal_is_told_with_what_is_known_of_it():
    told = GoalOut.of(goal())
    assert (told.width, told.height, told.camera.name, told.scene) == (64, 64, "goal", "s")
    assert [entry.model_dump() for entry in told.objects] == [PLACED]
    photo = GoalOut.of(goal(source="upload", scene=None, poses=None))
    assert (photo.scene, photo.objects) == (None, None)
    assert GoalOut.model_validate_json(told.model_dump_json()) == told


def test_a_draft_is_told_in_words_for_people():
    told = DraftOut.of(Draft("s", (*POSES, ("mug", POSES[0][1])), "They overlap.", 4), {"box": "A box"})
    assert [entry.label for entry in told.objects] == ["A box", "mug"]
    assert (told.scene, told.problem, told.revision) == ("s", "They overlap.", 4)
