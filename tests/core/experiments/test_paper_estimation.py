import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.experiments import paper_estimation as published
from osfcore.experiments.harness import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import rotation_angle
from osfcore.inspection.contact_sheet import Comparison
from osfcore.paper.estimation import PaperEstimationConfig
from tests.support.errors import about
from tests.support.solids import SOLIDS

LITTLE = PaperEstimationConfig(
    masked_iterations=2, masked_population=6, joint_iterations=2, joint_population=6, side=16
)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    return published.EvaluatePaperEstimation(
        folder / "out", folder / "data", SOLIDS, tasks=2, objects=2, settings=("little",), fields="ours", size=32
    )


@pytest.fixture
def little(monkeypatch):
    monkeypatch.setattr(published, "SETTINGS", {"little": published.Setting(LITTLE, "24")})


def report_of(config, library):
    *_, last = published.evaluate_paper_estimation(config, FieldLibrary(None), library)
    return last.report


def test_each_setting_estimates_the_same_scenes_of_both_families(asked, library, little):
    report = report_of(asked, library)
    assert json.loads((asked.out / published.REPORT_FILE).read_text()) == report
    assert set(report["families"]) == {"any", "upright"}
    for rows in report["families"].values():
        assert rows["little"]["objects"] == 4
        assert 0 <= rows["little"]["share"] <= 1
    assert report_of(asked, library) == report  # what was measured is taken over
    for case in report["preferred"]:
        assert case["deg"] > 10
        assert case["eq5"] < case["eq5_true"]
    assert (asked.out / published.PREFERRED_FILE).exists() == bool(report["preferred"])


def test_what_cannot_be_measured_is_refused(asked, library, tmp_path, little):
    for change, error in (({"settings": ("many",)}, UnknownName), ({"families": ("odd",)}, InvalidInput)):
        with pytest.raises(error):
            report_of(replace(asked, out=tmp_path / "out", **change), library)
    with pytest.raises(InvalidInput, check=about("tasks")):
        report_of(replace(asked, out=tmp_path / "out", tasks=0), library)
    assert not (tmp_path / "out").exists()


def test_no_orientation_is_far_from_one_of_the_24_starts():
    """The farthest orientations from the rotations of a cube are off by 62.8 deg."""
    starts = published.start_orientations("24", np.zeros((0, 4)))
    random = np.random.default_rng(0).standard_normal((500, 4))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    nearest = np.rad2deg(rotation_angle(random[:, None], starts[None])).min(axis=1)
    assert len(starts) == 24
    assert 50 < nearest.max() < 62.9


def test_resting_starts_are_the_resting_orientations_turned_about_the_vertical():
    lying = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0], [1.0, 0, 0, 0]])
    starts = published.start_orientations("resting", lying)
    assert len(starts) == 8
    for quaternion in lying:
        turns = np.sort(np.rad2deg(rotation_angle(starts, quaternion[None])))
        np.testing.assert_allclose(turns[:4], (0, 90, 90, 90), atol=1e-5)


def test_a_loss_that_prefers_a_wrong_pose_is_counted():
    """Of two objects that are turned wrongly, the first fits better than the truth does."""
    seen = {"mm": [1.0, 3.0, 50.0], "deg": [90.0, 2.0, 40.0], "eq5": [0.1, 0.2, 0.3], "eq5_true": [0.2, 0.1, 0.1]}
    row = published.summary([{**seen, "eq6": 0.4, "eq6_true": 0.3, "light_deg": 5.0, "seconds": 2.0}])
    assert (row["objects"], row["turned_wrongly"]) == (3, 2)
    assert row["share"] == pytest.approx(1 / 3, abs=1e-4)
    assert (row["eq5_prefers_wrong"], row["eq6_prefers_wrong"]) == (0.5, 0)


def test_the_clearest_case_of_each_object_comes_first():
    """Of three estimates: of two objects, one of which was found wrongly twice."""

    def result(number, names, eq5, preferred):
        picture = np.full((8, 8, 3), number, np.uint8)
        figures = {"names": names, "deg": [90.0] * 2, "mm": [1.0] * 2, "eq5": eq5, "eq5_true": [1.0] * 2}
        shown = [Comparison("", picture, picture)] * (1 + 2 * len(preferred))
        return TaskResult({**figures, "preferred": preferred}, tuple(shown))

    results = [result(0, ["a", "b"], [0.9, 2.0], [0]), result(1, ["b", "a"], [0.4, 0.5], [0, 1])]
    results.append(result(2, ["a"], [3.0], []))
    cases = published.preferred_cases(results)
    assert [(case["name"], case["eq5"]) for case, _ in cases] == [("b", 0.4), ("a", 0.5)]
    assert all(len(pictures) == 3 and pictures[0][0, 0, 0] == 1 for _, pictures in cases)
