import re
from xml.etree import ElementTree

import numpy as np

from osfcore.experiments.charts import Axis, Bar, Bars, Chart, Curve, cumulative, svg, write_charts

X, Y = Axis("x [mm]", 0, 10), Axis("share", 0, 1)
RISING = Curve("up", np.array([0.0, 2.0, 10.0]), np.array([0.0, 0.8, 1.0]), band=np.array([[0, 0.7, 1], [0, 0.9, 1]]))
BARS = Bars("b", Y, [Bar("short", 0.2, 0.1, 0.3), Bar("long & <wide>", 0.8, 0.7, 0.9)])


def chart(*curves, y=Y):
    return Chart('a "t"', X, y, curves)


def coloured(drawing, kind="stroke"):
    """Points of all paths of a drawing in some colour but the text's, in the order in which they are drawn."""
    paths = [path for path in ElementTree.fromstring(drawing).iter() if path.tag.endswith("}path")]
    found = [path.get("d", "") for path in paths if f"{kind}: #" in path.get("style", "")]
    return [np.array(re.findall(r"-?[\d.]+", points), float).reshape(-1, 2) for points in found]


def test_a_curve_is_drawn_where_it_should_be():
    line, *_ = coloured(svg([chart(RISING)]))
    assert (np.diff(line[:, 0]) > 0).all()
    assert (np.diff(line[:, 1]) < 0).all()  # upwards is toward smaller numbers
    (left, low), (middle, at), (right, high) = line
    assert abs((middle - left) / (right - left) - 0.2) < 1e-3
    assert abs((low - at) / (low - high) - 0.8) < 1e-3


def test_bars_are_as_long_as_their_values():
    short, long = (np.ptp(bar[:, 0]) for bar in coloured(svg([BARS]), "fill"))
    assert abs(long / short - 4) < 0.01
    first, second = (bar[:, 1].mean() for bar in coloured(svg([BARS]), "fill"))
    assert first < second  # the first one stands on top


def contrast(colour, other):
    """Ratio of luminances as WCAG 2 defines it."""

    def luminance(code):
        values = np.array([int(code[n : n + 2], 16) / 255 for n in (1, 3, 5)])
        return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722)

    dark, light = sorted([luminance(colour), luminance(other)])
    return (light + 0.05) / (dark + 0.05)


def test_a_drawing_can_be_read_on_light_and_dark_pages_beside_others():
    names = ("ours", "as published", "NeRF", "FitVid", "no action", "a", "b", "c", "d", "e")
    curves = [Curve(name, RISING.x, RISING.y / n) for n, name in enumerate(names, 1)]
    drawing = svg([chart(*curves), BARS])
    colours = set(re.findall(r"#[0-9a-f]{6}\b", drawing))
    assert len(colours) >= 8
    for colour in colours:
        assert contrast(colour, "#ffffff") > 3
        assert contrast(colour, "#131416") > 3
    assert "currentColor" in drawing
    assert "<style" not in drawing  # it would hold for the whole page
    ids = set(re.findall(r' id="([^"]*)"', drawing))
    used = set(re.findall(r'(?:href="|url\()#([\w]+)', drawing))
    assert ids == used  # others would only stand in a page several times
    assert drawing == svg([chart(*curves), BARS])  # no date, no chance
    assert "\n" not in drawing  # Markdown ends HTML at an empty line


def test_a_drawing_says_what_it_shows():
    root = ElementTree.fromstring(svg([chart(RISING), BARS]))
    assert root.get("role") == "img"
    assert root.get("aria-label") == 'a "t": share over x [mm]; b: share'
    words = "".join(root.itertext())
    for word in ("x [mm]", "share", "up", "long & <wide>"):
        assert word in words
    assert ">0.005" in svg([chart(RISING, y=Axis("y", 0, 0.02))])  # in full


def test_a_file_has_a_background(tmp_path):
    write_charts(tmp_path / "charts.svg", [chart(RISING)])
    text = (tmp_path / "charts.svg").read_text()
    assert text.startswith("<svg ")
    (paper, *_) = coloured(text, "fill")
    _, _, *size = map(float, ElementTree.fromstring(text).get("viewBox", "").split())
    np.testing.assert_allclose(np.ptp(paper, axis=0), size, atol=0.01)


def test_a_method_has_one_colour_in_all_charts():
    first, second = Curve("ours", RISING.x, RISING.y), Curve("NeRF", RISING.x, RISING.y / 2)

    def colours(*curves):
        return re.findall(r"fill: none; stroke: (#\w+)", svg([chart(*curves)]))

    assert set(colours(first, second)) == {*colours(first), *colours(second)}


def test_a_cumulative_curve_counts_values_up_to_each_place():
    curve = cumulative("a", [1.0, 2.0, 50.0], X, total=4)
    assert curve.y[0] == 0
    assert curve.y[-1] == 0.5  # one is beyond the axis, one has no value
    assert np.all(np.diff(curve.y) >= 0)
    assert curve.y[np.searchsorted(curve.x, 1.5)] == 0.25
    assert cumulative("none", [], X).y.max() == 0
