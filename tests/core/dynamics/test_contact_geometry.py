import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.dynamics.shapes import PAIR_REACH_M, ShapeTable, outlines, pair_contact, pusher_contact, solids
from osfcore.geometry.polygons import gap_to_point
from osfcore.geometry.torch_rotations import facing
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import angle_bracket, boxes

STILL = torch.zeros(1, 2)


def seen(table, placed):
    """Solids and whole outlines of objects given as number: (x, y, z of the centre, turn about z)."""
    numbers = torch.tensor([number for number, *_ in placed])
    centre = torch.tensor([where[:3] for _, *where in placed], dtype=torch.float32)
    heading = torch.tensor([[np.cos(where[3]), -np.sin(where[3])] for _, *where in placed], dtype=torch.float32)
    rotation = facing(heading)
    outline = outlines(table, numbers, rotation, centre)
    return solids(table, numbers, rotation, centre, outline), outline


def test_the_pusher_fits_into_a_corner_that_the_hull_would_fill():
    """A bracket of two arms, 12 cm long and 4 cm wide, with the pusher in its corner."""
    bracket = angle_bracket()
    parts, outline = seen(ShapeTable((bracket,)), [(0, -0.055, -0.055, 0.02, 0.0)])  # arms at x, y < -0.035
    contact = pusher_contact(parts, STILL)
    for gap in contact[:3]:
        assert float(gap.distance) == pytest.approx(0.035 - PUSHER_RADIUS_M, abs=1e-4)
    whole = gap_to_point(outline, STILL)
    assert float(whole.distance) < 0.035 - 0.02  # the hull's hypotenuse is nearer


def test_the_face_is_the_side_of_the_nearest_part():
    parts, _ = seen(ShapeTable((angle_bracket(),)), [(0, -0.055, -0.04, 0.02, 0.0)])  # the other arm is 3.5 cm away
    face = pusher_contact(parts, STILL).face[0]
    torch.testing.assert_close(face, torch.tensor([[0.045, -0.02], [-0.075, -0.02]]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("turn", np.linspace(0, 6, 7))
def test_a_convex_object_is_touched_at_its_hull(turn):
    box = boxes(((0.0, 0.0, 0.0), (0.03, 0.02, 0.04)))
    parts, outline = seen(ShapeTable((box,)), [(0, 0.06, 0.01, 0.04, turn)])
    contact = pusher_contact(parts, STILL)
    whole = gap_to_point(outline, STILL)
    assert torch.equal(parts.outline, outline)
    assert float(contact.before.distance) == pytest.approx(float(whole.distance) - PUSHER_RADIUS_M, abs=1e-7)


def test_what_is_cut_into_parts_is_touched_where_the_whole_is():
    """A box, and the same box of eight parts: parts change nothing where there is no hollow."""
    whole = boxes(((0.0, 0.0, 0.0), (0.04, 0.04, 0.04)))
    eighths = [(place, (0.02, 0.02, 0.02)) for place in itertools.product((-0.02, 0.02), repeat=3)]
    cut = replace(whole, parts=boxes(*eighths).parts)
    table = ShapeTable((whole, cut))
    for turn in (0.0, 0.3, 0.9):
        parts, outline = seen(table, [(0, 0.08, 0.01, 0.04, turn), (1, 0.08, 0.01, 0.04, turn)])
        contact = pusher_contact(parts, torch.tensor([[0.01, 0.002]]).expand(2, 2))
        for gap in contact[:3]:
            torch.testing.assert_close(gap.distance[0], gap.distance[1], atol=1e-4, rtol=0)
            torch.testing.assert_close(gap.normal[0], gap.normal[1], atol=1e-3, rtol=0)
        sides, outline = seen(table, [(0, 0.0, 0.0, 0.04, turn), (0, 0.1, 0.0, 0.04, 0.0), (1, 0.1, 0.0, 0.04, 0.0)])
        pairs = pair_contact(sides, outline, torch.tensor([0, 0]), torch.tensor([1, 2]))
        torch.testing.assert_close(pairs.gap.distance[0], pairs.gap.distance[1], atol=2e-3, rtol=0)


def test_what_is_above_the_pusher_is_not_touched():
    """A mushroom 20 cm high: a stem of 2 cm, and a cap of 8 cm from 14 cm upward."""
    mushroom = boxes(((0.0, 0.0, -0.03), (0.01, 0.01, 0.07)), ((0.0, 0.0, 0.07), (0.04, 0.04, 0.03)))
    parts, _ = seen(ShapeTable((mushroom,)), [(0, 0.04, 0.0, 0.1, 0.0)])
    assert float(pusher_contact(parts, STILL).before.distance) == pytest.approx(0.03 - PUSHER_RADIUS_M, abs=1e-4)
    lower, _ = seen(ShapeTable((mushroom,)), [(0, 0.04, 0.0, 0.07, 0.0)])
    assert float(pusher_contact(lower, STILL).before.distance) < 0


def test_an_object_that_is_wholly_out_of_reach_is_far_away():
    box = boxes(((0.0, 0.0, 0.0), (0.03, 0.02, 0.04)))
    parts, _ = seen(ShapeTable((box,)), [(0, 0.0, 0.0, 0.3, 0.0)])
    assert float(pusher_contact(parts, STILL).halfway.distance) > 0.5


def test_brackets_that_hold_each_other_do_not_overlap():
    """Two brackets, one turned by 180 degrees, the ends of its arms 2 cm off within the other's corner."""
    table = ShapeTable((angle_bracket(),))
    parts, outline = seen(table, [(0, 0.0, 0.0, 0.02, 0.0), (0, 0.14, 0.08, 0.02, np.pi)])
    both = torch.tensor([0]), torch.tensor([1])
    contact = pair_contact(parts, outline, *both)
    assert float(contact.gap.distance) == pytest.approx(0.02, abs=5e-4)
    assert float(contact.gap.distance) < PAIR_REACH_M
    back = pair_contact(parts, outline, *both[::-1])
    torch.testing.assert_close(back.gap.distance, contact.gap.distance)
    torch.testing.assert_close(back.gap.normal, -contact.gap.normal, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.first_face, contact.second_face, atol=1e-5, rtol=0)


def test_parts_one_above_the_other_do_not_touch():
    """A low box under the cap of the mushroom, beside its stem."""
    mushroom = boxes(((0.0, 0.0, -0.03), (0.01, 0.01, 0.07)), ((0.0, 0.0, 0.07), (0.04, 0.04, 0.03)))
    low = boxes(((0.0, 0.0, 0.0), (0.01, 0.01, 0.02)))
    table = ShapeTable((mushroom, low))
    parts, outline = seen(table, [(0, 0.0, 0.0, 0.1, 0.0), (1, 0.035, 0.0, 0.02, 0.0)])
    contact = pair_contact(parts, outline, torch.tensor([0]), torch.tensor([1]))
    assert float(contact.gap.distance) == pytest.approx(0.015, abs=1e-4)
    torch.testing.assert_close(contact.gap.normal, torch.tensor([[1.0, 0.0]]), atol=1e-4, rtol=0)


def test_the_order_of_parts_does_not_matter():
    bracket = angle_bracket()
    table = ShapeTable((bracket, replace(bracket, parts=bracket.parts[::-1])))
    parts, _ = seen(table, [(number, 0.02, -0.055, 0.02, 0.7) for number in (0, 1)])
    contact = pusher_contact(parts, torch.zeros(2, 2))
    assert torch.equal(contact.before.distance[0], contact.before.distance[1])
    assert torch.equal(contact.before.point[0], contact.before.point[1])
