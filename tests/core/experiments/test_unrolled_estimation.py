import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.unrolled_estimation as unrolled
from osfcore.errors import InvalidInput
from osfcore.estimation.steps import EstimateStep
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.objects.catalogue import CATALOGUE
from osfcore.paper.estimation import PaperEstimationConfig
from osfcore.progress import Progress
from tests.support.errors import about

NAMES = ("003_cracker_box", "013_apple")
SYMMETRIES = {name: CATALOGUE[name].symmetry for name in NAMES}
OVERHEAD = Light(np.array([0.0, 0.0, 1.0]))


def state(shift_m=0.0, turn_deg=0.0, light=OVERHEAD, below_m=0.0) -> SceneState:
    """Two objects, the first of them moved along x and turned about the vertical; the second lower."""
    turn = quaternion_exp(np.array([[0.0, 0.0, np.deg2rad(turn_deg)], [0.0, 0.0, 0.0]]))
    return SceneState(NAMES, Pose(np.array([[shift_m, 0, 0], [0.1, 0, -below_m]]), turn), light, None)


def steps(*states) -> list[EstimateStep]:
    return [EstimateStep(Progress(n, len(states), ""), "objects", one) for n, one in enumerate(states)]


def test_errors_are_those_of_poses_and_light():
    tilted = Light.from_angles(0.0, np.deg2rad(60))
    along = unrolled.errors_along(steps(state(below_m=2.0), state(0.02, 10.0, tilted)), state(), SYMMETRIES)
    assert along["mm"] == [None, pytest.approx(10.0)]  # of one object not yet looked at; the mean of 20 mm and 0
    assert along["deg"] == [None, pytest.approx(5.0)]
    assert along["light_deg"] == [0.0, pytest.approx(30.0)]


def test_moments_part_where_the_light_first_moves():
    moved = state(light=Light.from_angles(0.3, 1.0))
    assert unrolled.moments_of(steps(*[state()] * 4, *[moved] * 5)) == [0, 3, 4, 6, 8]
    assert unrolled.moments_of(steps(state(), moved)) == [0, 0, 1, 1, 1]
    assert unrolled.moments_of(steps(*[state()] * 3)) == [0, 1, 2, 2, 2]  # it never does


def test_medians_are_over_frames():
    rows = [{"mm": [None, 3.0, 1.0], "deg": [1.0, 2.0, 0.0], "light_deg": [value] * 3} for value in (2.0, 4.0, 9.0)]
    found = unrolled.summary([{**row, "moments": [0, 0, 1, 1, 2]} for row in rows])
    assert found["frames"] == 3
    assert found["moments"] == {"mm": [None, None, 3, 3, 1], "deg": [1, 1, 2, 2, 0], "light_deg": [4.0] * 5}
    assert (found["along"]["mm"][0], found["along"]["mm"][-1], len(found["along"]["mm"])) == (None, 1, 101)


@pytest.mark.slow
def test_a_frame_is_estimated_by_both_methods_and_shown(library, tmp_path):
    little = PaperEstimationConfig(
        masked_iterations=2, masked_population=8, joint_iterations=2, joint_population=4, side=32
    )
    asked = unrolled.UnrollEstimates(
        tmp_path / "out", tmp_path / "data", ("009_gelatin_box",), tasks=1, methods=("paper", "ours"), objects=1,
        published=little, size=64,
    )  # fmt: skip
    *_, last = unrolled.unrolled_estimates(asked, FieldLibrary(None), library)
    assert json.loads((asked.folder / unrolled.REPORT_FILE).read_text()) == last.report
    ours = last.report["methods"]["ours"]["moments"]
    assert ours["mm"][-1] < 5
    assert ours["light_deg"][-1] < 5 < ours["light_deg"][0]
    assert list(last.report["methods"]) == ["ours", "paper"]
    height, width, _ = cv2.imread(str(asked.folder / unrolled.IMAGES_FILE)).shape
    assert height > 4 * 64  # near and far by each method
    assert width > 6 * 64  # what is seen, and five moments
    assert (asked.folder / unrolled.CHART_FILE).exists()
    with pytest.raises(InvalidInput, check=about("methods")):
        next(unrolled.unrolled_estimates(replace(asked, methods=("nerf",)), FieldLibrary(None), library))
