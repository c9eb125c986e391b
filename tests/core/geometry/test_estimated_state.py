import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState

STATE = SceneState(("a", "b"), Pose.identity(2), Light(np.array([0, 0, 1.0])), None)
GOOD = {"state": STATE, "position_std": np.array([0.001, np.inf]), "rotation_std": np.zeros(2), "light_std": 0.0,
        "doubts": ("", ""), "reason": ""}  # fmt: skip


def test_an_estimate_is_trusted_unless_there_is_a_reason():
    assert EstimatedState(**GOOD).trusted
    assert not EstimatedState(**GOOD | {"doubts": ("", "odd"), "reason": "b: odd"}).trusted


def test_no_objects_are_fine():
    nothing = SceneState((), Pose.identity(0), STATE.light, None)
    assert EstimatedState(nothing, np.zeros(0), np.zeros(0), 0.1, (), "").trusted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_std": np.zeros(3)}, "position_std is .* must be 2 numbers of at least 0"),
        ({"position_std": np.array([0.1, -0.1])}, "position_std"),
        ({"rotation_std": np.array([0.1, np.nan])}, "rotation_std"),
        ({"rotation_std": np.zeros((2, 1))}, "rotation_std"),
        ({"light_std": -1.0}, "light_std is -1"),
        ({"light_std": np.nan}, "light_std is nan"),
        ({"doubts": ("",)}, "doubts is 1, but it must be one for each of 2 objects"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(change, message):
    with pytest.raises(InvalidInput, match=message):
        EstimatedState(**GOOD | change)
