import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.geometry.polygons import circle, direction_index, gap_between, gap_to_point

COUNT = 64
angles = st.floats(-3.2, 3.2)
places = st.floats(-0.3, 0.3)


def turn(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]])


def rectangle(a: float, b: float, angle: float = 0.0, at=(0.0, 0.0)) -> torch.Tensor:
    """Farthest corners of a rectangle with half sides a, b, in each of the directions of the circle."""
    corners = torch.tensor([[a, b], [-a, b], [-a, -b], [a, -b]]) @ turn(angle).T
    return (corners[(circle(COUNT) @ corners.T).argmax(dim=1)] + torch.tensor(at))[None]


def to_rectangle(point, a, b) -> float:
    """Signed distance of a point from a rectangle around the origin."""
    away = np.abs(point) - [a, b]
    return float(np.linalg.norm(np.maximum(away, 0)) + min(away.max(), 0))


@pytest.mark.parametrize("count", [8, 64])
def test_directions_find_themselves_and_their_neighbourhood(count):
    torch.testing.assert_close(circle(count)[count // 4], torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0)
    own = torch.arange(count)
    for off in (0.0, 0.45, -0.45):
        angle = (own + off) * (2 * math.pi / count)
        found = direction_index(3 * torch.stack([angle.cos(), angle.sin()], dim=1), count)
        assert torch.equal(found, own)


@given(
    a=st.floats(0.01, 0.1), b=st.floats(0.01, 0.1), angle=angles, x=places, y=places, shift=st.tuples(places, places)
)
@settings(max_examples=40)
def test_gap_of_a_rectangle_to_a_point(a, b, angle, x, y, shift):
    point = torch.tensor([[x, y]]) @ turn(angle).T + torch.tensor([shift])
    gap = gap_to_point(rectangle(a, b, angle, shift), point)
    assert float(gap.distance) == pytest.approx(to_rectangle([x, y], a, b), abs=2e-6)
    reached = gap.point + gap.distance[:, None] * gap.normal
    torch.testing.assert_close(reached, point, atol=1e-6, rtol=0)
    on = ((gap.point - torch.tensor([shift])) @ turn(angle))[0].numpy()  # back in the rectangle's own frame
    assert to_rectangle(on, a, b) == pytest.approx(0, abs=1e-6)
    if abs(float(gap.distance)) > 1e-4:
        assert float(gap.normal.norm()) == pytest.approx(1, abs=1e-3)


@given(
    first=st.tuples(st.floats(0.01, 0.1), st.floats(0.01, 0.1)),
    second=st.tuples(st.floats(0.01, 0.1), st.floats(0.01, 0.1)),
    apart=st.floats(-0.015, 0.2),
    beside=st.floats(-0.5, 0.5),
    angle=angles,
)
@settings(max_examples=40)
def test_gap_of_rectangles_that_face_each_other(first, second, apart, beside, angle):
    """Side to side: the distance is that of the sides, overlapping or not, at any angle of the pair."""
    offset = turn(angle) @ torch.tensor([first[0] + second[0] + apart, beside * (first[1] + second[1])])
    one, other = rectangle(*first, angle), rectangle(*second, angle, offset.tolist())
    gap = gap_between(one, other)
    deep = abs(beside) * (first[1] + second[1]) - first[1] - second[1]  # overlap along the sides
    assert float(gap.distance) == pytest.approx(max(apart, deep), abs=2e-6)
    if apart > deep + 1e-4:
        torch.testing.assert_close(gap.normal[0], turn(angle)[:, 0], atol=1e-3, rtol=0)
    back = gap_between(other, one)
    assert float(back.distance) == pytest.approx(float(gap.distance), abs=1e-6)


@given(angle=angles, x=st.floats(-0.04, 0.04), y=st.floats(-0.02, 0.02))
@settings(max_examples=40)
def test_overlapping_outlines_moved_apart_by_the_gap_just_touch(angle, x, y):
    one, other = rectangle(0.05, 0.03, 0.3), rectangle(0.02, 0.04, angle, (x, y))
    gap = gap_between(one, other)
    assert float(gap.distance) < 0
    assert float(gap.normal.norm()) == pytest.approx(1, abs=1e-3)
    apart = gap_between(one, other - gap.distance[:, None, None] * gap.normal[:, None])
    assert float(apart.distance) == pytest.approx(0, abs=2e-6)


def test_a_dent_does_not_tear_outlines_apart():
    """Farthest points found with an error may come back a little before they go on."""
    one, other = rectangle(0.05, 0.03), rectangle(0.05, 0.03, 0.0, (0.11, 0.0))
    one[0, 24] = torch.tensor([-0.05, 0.0298])  # between two points on the far corner
    assert float(gap_between(one, other).distance) == pytest.approx(0.01, abs=1e-4)


def test_many_outlines_are_looked_at_independently():
    outlines = torch.cat([rectangle(0.05, 0.03, 0.2 * k, (0.02 * k, 0.0)) for k in range(5)])
    others = 0.02 * circle(COUNT) + torch.tensor([[[0.1, 0.03 * k]] for k in range(5)])
    together = gap_between(outlines, others)
    assert gap_between(outlines[:0], others[:0]).distance.shape == (0,)
    points = gap_to_point(outlines, others[:, 0])
    for k in range(5):
        alone = gap_between(outlines[k : k + 1], others[k : k + 1])
        torch.testing.assert_close(together.distance[k], alone.distance[0])
        one = gap_to_point(outlines[k : k + 1], others[k : k + 1, 0])
        torch.testing.assert_close(points.distance[k], one.distance[0])
