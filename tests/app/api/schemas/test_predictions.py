import numpy as np
import pytest
from pydantic import ValidationError

from app.api.schemas.predictions import PredictionIn, StateIn
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import EstimatedState
from osfcore.io.scene_file import Scene, estimated_to_json, scene_to_json
from tests.app.storage.test_database import record
from tests.support.errors import about

STATE = record().state
OBJECT = {"name": "a", "position": [0, 0, 0.1], "quaternion": [1, 0, 0, 0]}


def test_files_can_be_sent_as_they_are():
    count = len(STATE.names)
    estimated = EstimatedState(STATE, np.full(count, 0.001), np.full(count, 0.01), 0.1, ("",) * count, "")
    for told in (scene_to_json(Scene(STATE, default_cameras())), estimated_to_json(estimated)):
        state = StateIn.model_validate(told).state()
        assert state.names == STATE.names
        np.testing.assert_allclose(state.poses.position, STATE.poses.position, atol=1e-12)
        np.testing.assert_allclose(state.light.position, STATE.light.position, atol=1e-12)


def test_light_and_pusher_may_be_missing():
    state = StateIn.model_validate({"objects": [OBJECT]}).state()
    assert state.pusher is None
    np.testing.assert_array_equal(state.light.position, [0, 0, 1])


@pytest.mark.parametrize(
    ("changed", "words"), [({"quaternion": [1, 1, 0, 0]}, "quaternion"), ({"quaternion": [0, 0, 0, 0]}, "quaternion")]
)
def test_quaternions_are_unit(changed, words):
    with pytest.raises(InvalidInput, match=words):
        StateIn.model_validate({"objects": [OBJECT | changed]}).state()


def test_an_object_is_there_once():
    with pytest.raises(InvalidInput, check=about("objects")):
        StateIn.model_validate({"objects": [OBJECT, OBJECT]}).state()


@pytest.mark.parametrize("actions", [[], [[]], [[0.1, 0, 0]], [[[0.1, 0]]], [[[float("nan"), 0, 0]]], [[[0, 0, "0"]]]])
def test_actions_have_three_levels_of_finite_numbers(actions):
    with pytest.raises(ValidationError):
        PredictionIn.model_validate({"actions": actions})
