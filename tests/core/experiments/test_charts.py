import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.experiments.charts import COLOURS, Axis, Curve, chart, cumulative, round_limit, side_by_side

X, Y = Axis("x [mm]", 0, 10), Axis("share", 0, 1)


def coloured(image, number=0):
    """Where a curve's colour is, above the legend."""
    return np.argwhere((image[:200] == COLOURS[number]).all(axis=-1))


def test_a_curve_is_drawn_where_it_should_be():
    image = chart("t", X, Y, [Curve("up", np.array([0.0, 10.0]), np.array([0.5, 1.0]))])
    rows, columns = coloured(image).T
    assert image.dtype == np.uint8
    assert np.corrcoef(rows, columns)[0, 1] < -0.99  # upwards is toward smaller rows
    empty = chart("t", X, Y, [])
    assert len(coloured(empty)) == 0
    assert empty.shape == image.shape


def test_what_lies_outside_is_cut_off_and_gaps_stay_open():
    x = np.linspace(-5, 15, 50)
    wild = chart("t", X, Y, [Curve("wild", x, np.where(x > 5, 1e12, -1e12))])
    left, right = coloured(wild)[:, 1].min(), coloured(wild)[:, 1].max()
    straight = chart("t", X, Y, [Curve("half", np.array([0.0, 10.0]), np.array([0.5, 0.5]))])
    assert coloured(straight)[:, 1].min() <= left <= right <= coloured(straight)[:, 1].max()
    gap = chart("t", X, Y, [Curve("gap", np.array([0.0, 3, 5, 7, 10]), np.array([0.5, 0.5, np.nan, 0.5, 0.5]))])
    columns = np.unique(coloured(gap)[:, 1])
    assert np.diff(columns).max() > 100
    nothing = chart("t", X, Y, [Curve("nan", np.arange(3.0), np.full(3, np.nan), dots=True)])
    assert len(coloured(nothing)) == 0


def test_points_may_be_marked():
    one = np.array([5.0]), np.array([0.5])
    assert len(coloured(chart("t", X, Y, [Curve("a", *one, dots=True)]))) > 30


def test_legends_stand_at_the_bottom_or_the_top():
    curves = [Curve("a", np.array([]), np.array([])), Curve("b", np.array([]), np.array([]))]
    assert len(coloured(chart("t", X, Y, curves), 1)) == 0
    assert len(coloured(chart("t", X, Y, curves, legend="top"), 1)) > 10


def test_a_cumulative_curve_counts_values_up_to_each_place():
    curve = cumulative("a", [1.0, 2.0, 50.0], X, total=4)
    assert curve.y[0] == 0
    assert curve.y[-1] == 0.5  # one is beyond the axis, one has no value
    assert np.all(np.diff(curve.y) >= 0)
    assert curve.y[np.searchsorted(curve.x, 1.5)] == 0.25
    assert cumulative("none", [], X).y.max() == 0


@given(st.floats(1e-6, 1e9))
def test_limits_are_round_and_hold_everything(most):
    limit = round_limit(most)
    assert most * (1 - 1e-9) <= limit <= 2.5 * most
    assert f"{limit:e}"[0] in "125"
    assert round_limit(limit) == pytest.approx(limit)


def test_charts_stand_in_a_row_and_ranges_must_grow():
    image = chart("t", X, Y, [])
    assert side_by_side([image, image]).shape == (image.shape[0], 2 * image.shape[1], 3)
    with pytest.raises(InvalidInput, match="range of axis z"):
        Axis("z", 1, 1)
