import json
from dataclasses import replace

import pytest

from osfcore.experiments.estimation import EstimateReport, drift
from osfcore.experiments.estimation_scores import refused_frame
from tests.core.experiments.scores import frame, report, score, track

KEYS = {
    "objects_total",
    "frac_1cm_5deg",
    "position_mm_median",
    "rotation_deg_median",
    "adds_mm_median",
    "light_deg_median",
    "first_s_median",
    "refine_hz",
    "track_lost",
    "goal_frac_1cm_5deg",
    "frac_1cm_5deg_fixed_light",
    "two_sigma_coverage",
    "mean_position_std_mm",
    "flagged_good",
    "flagged_bad",
}


def test_all_keys_are_there_and_hold_what_was_measured():
    found = json.loads(json.dumps(report().to_json(), allow_nan=False))
    assert set(found) >= KEYS
    assert (found["tasks"], found["objects_total"]) == (2, 4)
    assert found["frac_1cm_5deg"] == 0.75
    assert found["position_mm_median"] == 1.5
    assert found["first_s_median"] == 2.0
    assert found["goal_frac_1cm_5deg"] == 7 / 8
    assert found["goal_frac_1cm_5deg_by_moved"] == {"1": 1.0, "2": 0.75}
    assert found["frac_1cm_5deg_fixed_light"] == found["fixed_light"]["frac_1cm_5deg"] == 0.5
    assert {n: row["frac_1cm_5deg"] for n, row in found["by_views"].items()} == {"1": 0.5, "2": 0.75, "4": 0.75}
    assert (found["refine_hz"], found["refine_s_p90"]) == (2.0, 0.5)
    assert found["mean_position_std_mm"] == 1.0
    assert found["two_sigma_coverage"] == found["two_sigma_coverage_light"] == 1.0  # the wrong frame's light is out
    assert (found["flagged_good"], found["flagged_bad"]) == (0.0, 1.0)
    assert (found["bad_cases"], found["bad_refused"], found["bad_confident_wrong"]) == (2, 1, 1)


def test_what_was_not_measured_is_null_under_the_same_keys():
    bare = EstimateReport(report().first).to_json()
    everything = report().to_json()
    assert set(bare) == {key for key in everything if not key.startswith("bad_")}
    assert bare["frac_1cm_5deg"] == 0.75
    empty = ("refine_hz", "track_lost", "goal_frac_1cm_5deg", "frac_1cm_5deg_fixed_light", "by_views")
    assert {bare[key] for key in empty} == {None}
    assert bare["flagged_bad"] == 1.0  # of first frames alone


def test_lost_tracks_are_episodes_and_those_that_began_wrong_are_told_apart():
    tracks = (
        track([0.0, 40.0, 40.0], [0.0, 50.0, 50.0]),
        track([40.0, 40.0, 40.0], [0.0, 0.0, 0.0], right=False),
        track([0.0, 40.0, 0.0]),
    )
    found = replace(report(), tracks=tracks).to_json()
    assert (found["track_episodes"], found["track_lost"], found["track_objects_lost"]) == (3, 2, 3)
    assert found["track_lost_from_wrong_start"] == 1


def test_what_is_off_the_table_is_counted_and_left_out():
    tracks = (track([1.0, 1.0, 1.0, 1.0, 1.0]), track([99.0] * 5, absent="off the table"))
    found = replace(report(), tracks=tracks).to_json()
    assert (found["track_off_table"], found["track_out_of_view"], found["track_lost"]) == (5, 0, 0)
    assert found["track_frac_1cm_5deg"] == 1
    assert found["drift_mm"]["5"] == 1.0


def test_drift_is_the_median_over_objects_at_a_step():
    tracks = [track([float(step) for step in range(20)], [float(step) + 2 for step in range(20)], rotation=3.0)]
    assert drift(tracks, 0) == {"5": 5.0, "10": 10.0, "15": 15.0, "20": 20.0}
    assert set(drift(tracks, 1).values()) == {3.0}
    assert drift([track([1.0])], 0) == {"5": None, "10": None, "15": None, "20": None}


def test_refusals_count_everywhere():
    refused = refused_frame(("can", "box"), "no masks", 0.5)
    lost = replace(track([0.0]), position_mm=(), rotation_deg=(), absent=(), seconds=(), refused="no masks")
    found = EstimateReport((refused,), (lost,), ((refused,),), (refused,), {1: (refused,), 2: (refused,)}).to_json()
    json.dumps(found, allow_nan=False)
    assert found["frac_1cm_5deg"] == found["goal_frac_1cm_5deg"] == 0
    assert found["first_refused"] == found["goal_refused"] == found["track_lost"] == 1
    assert found["position_mm_median"] is found["refine_hz"] is found["two_sigma_coverage"] is None


def test_a_boundless_deviation_does_not_spoil_the_mean():
    found = EstimateReport((frame(score(std_mm=None), score(std_mm=3.0)),)).to_json()
    assert found["mean_position_std_mm"] == pytest.approx(3.0)
