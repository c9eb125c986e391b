"""Images: image figures, image methods."""

from concurrent.futures import Future

import numpy as np
import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.charts import Axis
from osfcore.experiments.harness import Piece, TaskCache, TaskResult
from osfcore.experiments.images import (
    FIELD_METHODS,
    TITLES,
    chart_of,
    check_methods,
    common_names,
    field_path,
    load_appearance,
    measured,
    summary,
    tables_of,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.inspection.contact_sheet import Comparison
from tests.core.experiments.nerfs import write_nerfs
from tests.core.experiments.solids import SOLIDS

# Image figures


NONE = float("nan")
OURS, THEIRS = np.array([[4.0, 6.0], [8.0, 10.0], [0.0, 2.0]]), np.array([[1.0, 3.0], [5.0, 7.0], [-3.0, -1.0]])
SPANS = {"all": [0, 1], "first": [0]}


def test_tasks_are_averaged_over_spans_and_along_x():
    told = summary({"ours": {"psnr": OURS}}, SPANS)
    assert told["against"] == {}
    row = told["methods"]["ours"]["psnr"]
    assert row["along"] == [4, 6]
    assert row["spans"]["all"]["mean"] == 5
    assert row["spans"]["first"]["mean"] == 4
    low, high = row["spans"]["all"]["interval"]
    assert 1 <= low < 5 < high <= 9


def test_an_even_difference_has_no_interval():
    told = summary({"paper": {"psnr": THEIRS}, "ours": {"psnr": OURS}}, SPANS)
    assert told["against"] == {"paper": {"psnr": {key: {"difference": 3, "interval": None} for key in SPANS}}}


def test_nothing_is_compared_without_ours():
    told = summary({"paper": {"psnr": THEIRS}}, SPANS)
    assert (set(told["methods"]), told["against"]) == ({"paper"}, {})


def test_what_was_not_measured_does_not_count():
    ours, theirs = OURS.copy(), THEIRS.copy()
    ours[0, 0] = ours[1, 0] = ours[1, 1] = NONE
    theirs[2] = NONE
    told = summary({"ours": {"psnr": ours}, "nerf": {"psnr": theirs}}, SPANS)
    row = told["methods"]["ours"]["psnr"]
    assert row["along"] == [0, 4]
    assert row["spans"]["all"]["mean"] == pytest.approx((6 + 1) / 2)
    assert told["against"]["nerf"]["psnr"]["all"] == {"difference": 4, "interval": None}
    nothing = {"difference": None, "interval": None}
    assert told["against"]["nerf"]["psnr"]["first"] == nothing
    bare = summary({"ours": {"psnr": np.full((2, 1), NONE)}}, {"all": [0]})["methods"]["ours"]["psnr"]
    assert bare == {"along": [None], "spans": {"all": {"mean": None, "interval": None}}}


def test_a_chart_begins_below_the_lowest_mean():
    tables = {"ours": {"psnr": np.array([[31.0, NONE]])}, "fitvid": {"psnr": np.array([[23.0, 27.0]])}}
    chart = chart_of(tables, "psnr", Axis("step", 0, 2), [1, 2], "PSNR [dB]", 5.0)
    assert (chart.y.label, chart.y.low, chart.y.high) == ("PSNR [dB]", 20, None)
    assert [curve.name for curve in chart.curves] == ["ours", "FitVid"]
    np.testing.assert_array_equal(chart.curves[0].y, [31, NONE])
    np.testing.assert_array_equal(chart.curves[1].x, [1, 2])
    empty = chart_of({"ours": {"psnr": np.array([[NONE]])}}, "psnr", Axis("step", 0, 2), [1], "PSNR [dB]", 5.0)
    assert empty.y.low == 0


def made(value):
    black = np.zeros((16, 16, 3), np.uint8)
    return TaskResult({"psnr": [value, None]}, (Comparison("", black, black),))


def pieces(folder, done):
    def work(method, number):
        done.append((method, number))
        return made(float(number))

    return {
        method: [
            Piece(f"{n}", TaskCache(folder / method), {}, lambda method=method, n=n: work(method, n)) for n in range(2)
        ]
        for method in ("ours", "paper")
    }


def run(given, executor=None):
    steps, generator = [], measured(given, executor)
    while True:
        try:
            steps.append(next(generator))
        except StopIteration as stop:
            return steps, stop.value


class Elsewhere:
    def submit(self, work, *arguments):
        future = Future()
        future.set_result(work(*arguments))
        return future


@pytest.mark.parametrize("executor", [None, Elsewhere()])
def test_pieces_are_done_once_and_sorted_by_method(tmp_path, executor):
    done = []
    steps, results = run(pieces(tmp_path, done), executor)
    assert [(step.done, step.total, step.report) for step in steps] == [(n, 4, None) for n in range(4)]
    assert sorted(done) == [(method, n) for method in ("ours", "paper") for n in range(2)]
    tables = tables_of(results, ("psnr",))
    for method in ("ours", "paper"):
        np.testing.assert_array_equal(tables[method]["psnr"], [[0, NONE], [1, NONE]])
    again, taken_over = run(pieces(tmp_path, done), executor)
    assert again == []
    assert len(done) == 4
    assert [one.figures for one in taken_over["paper"]] == [one.figures for one in results["paper"]]


# Image methods


def test_methods_come_once_and_in_order():
    assert check_methods(["nerf", "ours", "nerf"], FIELD_METHODS) == ("ours", "nerf")
    assert set(FIELD_METHODS) <= set(TITLES)
    with pytest.raises(InvalidInput, match="magic"):
        check_methods(["magic", "ours"], FIELD_METHODS)
    with pytest.raises(InvalidInput, match="none"):
        check_methods([], FIELD_METHODS)


def test_all_methods_know_the_objects_that_are_drawn(library, tmp_path):
    write_nerfs(tmp_path)
    fields = FieldLibrary(None)
    known = common_names(("ours",), None, fields, library, tmp_path, 3)
    assert set(SOLIDS) < set(known)
    assert all(fields.has(name) and library.has(name) for name in known)
    for methods in (("nerf",), ("paper",), ("nerf", "paper", "ours")):
        names = common_names(methods, None, fields, library, tmp_path, 3)
        assert set(SOLIDS) <= set(names) <= set(known)
        for name in names:
            for method in methods:
                assert field_path(method, name, fields, tmp_path).is_file()
    assert common_names(FIELD_METHODS, (SOLIDS[1], SOLIDS[0], SOLIDS[1]), fields, library, tmp_path, 2) == (
        SOLIDS[1],
        SOLIDS[0],
    )


def test_what_cannot_be_shown_by_all_is_told(library, tmp_path):
    fields = FieldLibrary(None)
    with pytest.raises(UnknownName, match="teapot"):
        common_names(("ours",), ("teapot",), fields, library, tmp_path, 1)
    with pytest.raises(UnknownName, match="011_banana"):
        common_names(("paper",), ("011_banana",), fields, library, tmp_path, 1)
    with pytest.raises(MissingAssets, match="011_banana"):
        common_names(("ours",), ("011_banana",), fields, library, tmp_path, 1)
    with pytest.raises(InvalidInput, match="objects in a scene is 9"):
        common_names(("ours",), None, fields, library, tmp_path, 9)
    with pytest.raises(InvalidInput, match="at least 3"):
        common_names(("ours",), SOLIDS[:2], fields, library, tmp_path, 3)


def test_each_method_shows_all_that_are_asked_for(tmp_path):
    write_nerfs(tmp_path)
    renderers = {m: load_appearance(m, SOLIDS, FieldLibrary(None), tmp_path).together for m in FIELD_METHODS}
    assert all(renderer.names == SOLIDS for renderer in renderers.values())
    assert len({type(renderer) for renderer in renderers.values()}) == len(FIELD_METHODS)
