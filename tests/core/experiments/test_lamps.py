import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.experiments.lamps import EvaluateLamps, LampScore, evaluate_lamps, lamp_report, lamp_scene
from osfcore.fields.field_library import FieldLibrary

SCORE = LampScore(0, True, False, 2.0, 1.0, 1.0, 1.1, 20.0, False, 3, 2, 0.5)


def test_figures_of_known_and_unknown_lamps():
    unknown = replace(SCORE, direction_deg=8.0, distance_m=None, aim_mm=None)
    distant = replace(unknown, is_near=False, true_m=None)
    report = lamp_report((SCORE, unknown, distant))
    assert report["lamp_direction_deg_median"] == 5.0
    assert report["lamp_distance_percent_median"] == pytest.approx(10)
    assert report["lamp_aim_mm_median"] == 20
    assert report["lamp_undetermined"] == report["distant_undetermined"] == 1
    assert report["lamp_within_5deg"] == 0.5
    assert report["lamp_within_15percent"] == 1
    assert report["poses_15mm_10deg"] == pytest.approx(2 / 3)


def test_the_same_seed_draws_the_same_photographs(library):
    one, two = (lamp_scene(library, library.names(), 3, 0, 1, is_near=True, is_wooden=False) for _ in range(2))
    np.testing.assert_array_equal(one.photos[0].image, two.photos[0].image)
    assert one.photos[0].on_table
    np.testing.assert_allclose(one.direction, one.spot.direction, atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_near_lamps_are_found_and_the_distance_of_distant_ones_is_unknown(library, tmp_path):
    *_, last = evaluate_lamps(EvaluateLamps(tmp_path, tasks=1, seed=1), library, FieldLibrary(None))
    report = last.report
    assert report["lamp_direction_deg_median"] < 5
    assert report["lamp_distance_percent_median"] < 15
    assert report["lamp_diffuse"] == 0
    assert report["poses_total"] > 4
    assert report["poses_15mm_10deg"] > 0.6
    assert report["distant_undetermined"] == report["distant_tasks"] == 1
    assert json.loads((tmp_path / "report.json").read_text())["lamp_tasks"] == 1


def test_a_number_out_of_range_is_refused(library, tmp_path):
    with pytest.raises(InvalidInput):
        next(evaluate_lamps(EvaluateLamps(tmp_path, views=9), library, FieldLibrary(None)))
