import cv2
import numpy as np

from osfcore.experiments.charts import Axis, Bar, Chart, Curve, cumulative, write_bars, write_charts

X, Y = Axis("x [mm]", 0, 10), Axis("share", 0, 1)
BLUE = (180, 119, 31)  # of matplotlib's first curve, BGR


def drawn(tmp_path, *curves, y=Y):
    """Pixels of two charts of these curves in a row."""
    write_charts(tmp_path / "chart.png", [Chart("t", X, y, curves)] * 2)
    return cv2.imread(str(tmp_path / "chart.png"))


def blue(image):
    return np.argwhere((image == BLUE).all(axis=-1))


def test_a_curve_is_drawn_where_it_should_be(tmp_path):
    rising = Curve("up", np.array([0.0, 2.0, 10.0]), np.array([0.0, 0.8, 1.0]))
    image = drawn(tmp_path, rising)
    rows, columns = blue(image[:, : image.shape[1] // 2]).T
    left, right = columns < np.quantile(columns, 0.2), columns > np.quantile(columns, 0.8)
    assert rows[left].mean() > rows[right].mean()  # upwards is toward smaller rows


def test_axes_that_are_given_cut_off_and_open_ones_show_all(tmp_path):
    high = Curve("high", np.array([0.0, 10.0]), np.array([5.0, 5.0]))
    assert len(blue(drawn(tmp_path, high))) < len(blue(drawn(tmp_path, high, y=Axis("y", 0))))  # the legend's remains


def test_bars_are_as_long_as_their_values(tmp_path):
    write_bars(tmp_path / "bars.png", "t", Y, [Bar("a", 0.2, 0.1, 0.3), Bar("b", 0.8, 0.7, 0.9)])
    rows = blue(cv2.imread(str(tmp_path / "bars.png")))[:, 0]
    between = (rows.min() + rows.max()) / 2
    assert (rows > between).sum() > 2 * (rows < between).sum()  # the first one stands on top


def test_a_cumulative_curve_counts_values_up_to_each_place():
    curve = cumulative("a", [1.0, 2.0, 50.0], X, total=4)
    assert curve.y[0] == 0
    assert curve.y[-1] == 0.5  # one is beyond the axis, one has no value
    assert np.all(np.diff(curve.y) >= 0)
    assert curve.y[np.searchsorted(curve.x, 1.5)] == 0.25
    assert cumulative("none", [], X).y.max() == 0
