import numpy as np
import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.charts import Axis
from osfcore.experiments.images import FIELD_METHODS, common_names, field_path, image_charts, summary
from osfcore.fields.field_library import FieldLibrary
from tests.support.errors import about
from tests.support.solids import SOLIDS, write_nerfs

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
    shown = {"ours": [[31.0, NONE, 9.0]], "fitvid": [[23.0, 27.0, 9.0]]}
    tables = {method: {"psnr": np.array(rows), "ssim": np.array(rows) / 100} for method, rows in shown.items()}
    psnr, ssim = image_charts(summary(tables, {}), Axis("step", 0, 2), [1, 2])
    assert (psnr.y.low, psnr.y.high) == (20, None)
    assert ssim.y.low == pytest.approx(0.2)
    np.testing.assert_array_equal(psnr.curves[0].y, [31, NONE])  # the third has no place
    np.testing.assert_array_equal(psnr.curves[1].x, [1, 2])
    none = {"ours": {key: np.array([[NONE]]) for key in ("psnr", "ssim")}}
    assert image_charts(summary(none, {}), Axis("step", 0, 2), [1])[0].y.low == 0


# Methods


def test_all_methods_know_the_objects_that_are_drawn(library, tmp_path):
    write_nerfs(tmp_path)
    fields = FieldLibrary(None)
    for methods in (("ours",), ("nerf", "paper", "ours")):
        names = common_names(methods, None, fields, library, tmp_path, 3)
        assert set(SOLIDS) <= set(names) <= set(library.names())
        assert all(field_path(method, name, fields, tmp_path).is_file() for name in names for method in methods)
    again = (SOLIDS[1], SOLIDS[0], SOLIDS[1])
    assert common_names(FIELD_METHODS, again, fields, library, tmp_path, 2) == SOLIDS[:2]


@pytest.mark.parametrize(
    ("methods", "names", "count", "error", "what"),
    [
        (("ours",), ("teapot",), 1, UnknownName, "teapot"),
        (("paper",), ("011_banana",), 1, UnknownName, "011_banana"),
        (("ours",), ("011_banana",), 1, MissingAssets, "011_banana"),
        (("ours",), None, 9, InvalidInput, "objects in a scene"),
        (("ours",), SOLIDS[:2], 3, InvalidInput, "number of objects"),
    ],
)
def test_what_some_method_cannot_show_is_refused(library, tmp_path, methods, names, count, error, what):
    with pytest.raises(error, check=about(what)):
        common_names(methods, names, FieldLibrary(None), library, tmp_path, count)
