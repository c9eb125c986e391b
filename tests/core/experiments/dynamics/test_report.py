import json

import numpy as np
import pytest

from osfcore.experiments.dynamics import DynamicsReport, Scored, report_json
from osfcore.experiments.dynamics_scores import Predicted, constant, errors, windows_of
from osfcore.objects.asset import Symmetry
from tests.core.experiments.pushes import NAMES, episode

STABLE = [
    "windows",
    "median_mm_1",
    "median_deg_1",
    "median_mm_4",
    "median_deg_4",
    "median_mm_10",
    "median_deg_10",
    "median_mm_30",
    "still_drift_mm_30",
    "constant_mm_4",
    "constant_mm_10",
    "analytic_mm_4",
    "rollout_steps_per_s",
    "by_objects",
    "unseen_objects_mm_4",
]


def scored(off_mm: float, names: tuple[str, ...] = NAMES, *, without: bool = False) -> Scored:
    """A predictor that is off by so much along y; the quasi-static model by twice as much."""
    windows = windows_of([episode(speed=0.01, turn=0.02, names=names)])
    symmetries = {name: Symmetry("none", reason="label") for name in names}

    def off(mm: float) -> Predicted:
        return Predicted(windows.positions[:, 2:] + [0, 1e-3 * mm, 0], windows.quaternions[:, 2:])

    kinds = {"network": off(off_mm), "analytic": off(2 * off_mm), "constant": constant(windows)}
    if without:
        kinds["without"] = off(3 * off_mm)
    found = {who: errors(windows, predicted, symmetries) for who, predicted in kinds.items()}
    return Scored(windows, kinds["network"], found)


def report(**changes: object) -> DynamicsReport:
    three = (*NAMES, "004_sugar_box")
    sets = {"directed 2": scored(1.0), "paper 2": scored(1.0)}
    sets |= {"directed 3": scored(2.0, three), "paper 3": scored(4.0, three)}
    given = {"by_set": sets, "unseen": None, "unseen_names": (), "rollout_steps_per_s": 1e4}
    return DynamicsReport(**(given | changes))


def test_where_all_pairs_were_met_in_training_none_are_told():
    told = report_json(report(holds_out_pairs=False))
    assert told["unseen_pairs"] == {"windows": 0, "median_mm_4": None, "constant_mm_4": None}
    assert set(told) == set(report_json(report()))


def test_figures_are_those_of_three_objects_that_moved():
    told = report_json(report())
    assert set(STABLE) <= set(told)
    assert told == json.loads(json.dumps(told, allow_nan=False))
    assert told["windows"] == 4  # one moved object in two windows of each policy
    assert told["median_mm_4"] == pytest.approx(3.0)  # half of them 2, half 4
    assert told["median_deg_4"] == pytest.approx(0, abs=1e-3)
    assert told["analytic_mm_4"] == pytest.approx(6.0)
    assert told["constant_mm_10"] == pytest.approx(100, rel=1e-3)
    assert told["still_drift_mm_30"] == pytest.approx(3.0)
    assert set(told["by_objects"]) == {"2", "3"}
    assert told["by_objects"]["2"]["median_mm_4"] == pytest.approx(1.0)
    assert told["by_policy"]["paper"]["median_mm_4"] == pytest.approx(4.0)
    assert told["by_name"]["005_tomato_soup_can"]["windows"] == 4
    assert told["by_name"]["009_gelatin_box"]["median_mm_4"] is None  # never moved
    assert told["unseen_objects_mm_4"] is None


def test_objects_never_seen_are_scored_by_both_networks():
    told = report_json(report(unseen=scored(1.0, without=True), unseen_names=NAMES[:1]))
    assert told["unseen_objects"] == [NAMES[0]]
    assert told["unseen_objects_mm_4"] == pytest.approx(3.0)
    assert told["seen_objects_mm_4"] == pytest.approx(1.0)
    nothing = report_json(report(unseen=scored(1.0, without=True), unseen_names=NAMES[1:]))
    assert nothing["unseen_objects_windows"] == 0


def test_pairs_that_never_meet_in_training_are_scored_apart():
    pair = ("005_tomato_soup_can", "010_potted_meat_can")
    sets = {"directed 3": scored(1.0), "paper 3": scored(5.0, pair)}
    told = report_json(report(by_set=sets))["unseen_pairs"]
    assert told == {"windows": 2, "median_mm_4": pytest.approx(5.0), "constant_mm_4": pytest.approx(40, rel=1e-3)}


def test_without_any_motion_there_are_no_medians():
    windows = windows_of([episode()])
    symmetries = {name: Symmetry("none", reason="label") for name in NAMES}
    found = errors(windows, constant(windows), symmetries)
    still = Scored(windows, constant(windows), dict.fromkeys(("network", "analytic", "constant"), found))
    told = report_json(report(by_set={"directed 3": still}))
    assert (told["windows"], told["median_mm_4"], told["still_drift_mm_30"]) == (0, None, 0.0)
    assert np.isfinite(told["rollout_steps_per_s"])
