import numpy as np
import pytest

from osfcore.experiments.charts import Axis
from osfcore.experiments.harness import Piece, TaskCache, TaskResult
from osfcore.experiments.images import chart_of, measured, summary, tables_of
from osfcore.inspection.contact_sheet import Comparison

NONE = float("nan")
OURS, THEIRS = np.array([[4.0, 6.0], [8.0, 10.0], [0.0, 2.0]]), np.array([[1.0, 3.0], [5.0, 7.0], [-3.0, -1.0]])
SPANS = {"all": [0, 1], "first": [0]}


def test_tasks_are_averaged_over_spans_and_along_x_and_compared_in_pairs():
    found = summary({"paper": {"psnr": THEIRS}, "ours": {"psnr": OURS}}, SPANS)
    row = found["methods"]["ours"]["psnr"]
    assert row["along"] == [4, 6]
    assert row["spans"]["all"]["mean"] == 5
    assert row["spans"]["first"]["mean"] == 4
    low, high = row["spans"]["all"]["interval"]
    assert 1 <= low < 5 < high <= 9
    assert found["against"] == {"paper": {"psnr": {key: {"difference": 3, "interval": None} for key in SPANS}}}
    assert summary({"paper": {"psnr": THEIRS}}, SPANS)["against"] == {}


def test_what_was_not_measured_does_not_count():
    ours, theirs = OURS.copy(), THEIRS.copy()
    ours[0, 0] = ours[1, 0] = ours[1, 1] = NONE
    theirs[2] = NONE
    found = summary({"ours": {"psnr": ours}, "nerf": {"psnr": theirs}}, SPANS)
    row = found["methods"]["ours"]["psnr"]
    assert row["along"] == [0, 4]
    assert row["spans"]["all"]["mean"] == pytest.approx((6 + 1) / 2)
    assert found["against"]["nerf"]["psnr"]["all"] == {"difference": 4, "interval": None}
    assert found["against"]["nerf"]["psnr"]["first"] == {"difference": None, "interval": None}
    bare = summary({"ours": {"psnr": np.full((2, 1), NONE)}}, {"all": [0]})["methods"]["ours"]["psnr"]
    assert bare == {"along": [None], "spans": {"all": {"mean": None, "interval": None}}}


def test_a_chart_begins_below_the_lowest_mean():
    tables = {"ours": {"psnr": np.array([[31.0, NONE]])}, "fitvid": {"psnr": np.array([[23.0, 27.0]])}}
    chart = chart_of(tables, "psnr", Axis("step", 0, 2), [1, 2], "PSNR [dB]", 5.0)
    assert (chart.y.low, chart.y.high) == (20, None)
    np.testing.assert_array_equal(chart.curves[0].y, [31, NONE])
    np.testing.assert_array_equal(chart.curves[1].x, [1, 2])
    empty = chart_of({"ours": {"psnr": np.array([[NONE]])}}, "psnr", Axis("step", 0, 2), [1], "PSNR [dB]", 5.0)
    assert empty.y.low == 0


def test_results_are_sorted_by_method(tmp_path):
    def piece(method, number):
        black = np.zeros((16, 16, 3), np.uint8)
        result = TaskResult({"psnr": [number, None]}, (Comparison("", black, black),))
        return Piece(f"{number}", TaskCache(tmp_path / method), {}, lambda: result)

    results = {}

    def steps():
        results.update((yield from measured({"ours": [piece("ours", 3)], "paper": [piece("paper", 5)]}, None)))

    assert [(step.done, step.total, step.report) for step in steps()] == [(0, 2, None), (1, 2, None)]
    tables = tables_of(results, ("psnr",))
    np.testing.assert_array_equal(tables["ours"]["psnr"], [[3, NONE]])
    np.testing.assert_array_equal(tables["paper"]["psnr"], [[5, NONE]])
