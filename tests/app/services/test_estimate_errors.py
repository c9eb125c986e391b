import numpy as np
import pytest

from app.services.estimate_errors import errors_of
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_multiply
from osfcore.geometry.states import SceneState

BOX, BOWL = "003_cracker_box", "024_bowl"
QUARTER = np.array([0.5**0.5, 0, 0, 0.5**0.5])  # about z


def state(positions, quaternions, light):
    return SceneState((BOX, BOWL), Pose(np.array(positions), np.array(quaternions)), Light(np.array(light)), None)


def test_errors_are_told_in_units_for_people_and_what_looks_alike_is_no_error(library):
    lying = [[0.1, 0.2, 0.3], [0.0, 0.1, 0.0]]
    truth = state(lying, [QUARTER, QUARTER], [0, 0, 1.0])
    turned = [quaternion_multiply(QUARTER, QUARTER)] * 2
    found = state(lying + np.array([[0.003, 0.004, 0], [0, 0, 0.001]]), turned, [1.0, 0, 1.0])
    told = errors_of(found, truth, library)
    assert [error["name"] for error in told["objects"]] == [BOX, BOWL]
    assert [error["position_mm"] for error in told["objects"]] == pytest.approx([5, 1])
    assert told["objects"][0]["rotation_deg"] == pytest.approx(90)
    assert told["objects"][1]["rotation_deg"] == pytest.approx(0, abs=1e-4)  # bowls turn freely
    assert told["light_deg"] == pytest.approx(45)


def test_objects_are_compared_by_name(library):
    truth = state([[0.1, 0, 0], [0, 0.1, 0]], [QUARTER, QUARTER], [0, 0, 1.0])
    swapped = SceneState((BOWL, BOX), truth.poses[[1, 0]], truth.light, None)
    told = errors_of(swapped, truth, library)
    assert [error["position_mm"] for error in told["objects"]] == pytest.approx([0, 0])
    assert told["light_deg"] == pytest.approx(0)
