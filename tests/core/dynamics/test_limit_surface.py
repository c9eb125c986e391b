import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from osfcore.dynamics.motion import FRICTION, friction_arm, push_motion
from osfcore.geometry.polygons import circle

angles = st.floats(-3.1, 3.1)
offsets = st.floats(-0.06, 0.06)
depths = st.floats(1e-5, 0.01)
arms = st.floats(0.01, 0.06)
drags = st.floats(-0.01, 0.01)


def push(point, inward, depth, shift, arm) -> torch.Tensor:
    rows = [torch.tensor([v], dtype=torch.float64) for v in (point, inward, depth, shift, arm)]
    return push_motion(*rows)[0]


def contact_motion(way, point) -> torch.Tensor:
    return way[:2] + way[2] * torch.tensor([-point[1], point[0]])


@given(angle=angles, distance=st.floats(0.01, 0.06), depth=depths, arm=arms)
def test_through_the_centre_it_moves_by_the_depth_and_does_not_turn(angle, distance, depth, arm):
    inward = (math.cos(angle), math.sin(angle))
    way = push((-distance * inward[0], -distance * inward[1]), inward, depth, (0.0, 0.0), arm)
    torch.testing.assert_close(way[:2], depth * torch.tensor(inward, dtype=torch.float64), atol=1e-12, rtol=1e-9)
    assert abs(way[2]) < 1e-9


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, drag=drags)
def test_the_contact_gives_way_by_the_depth_whatever_slides(point, angle, depth, arm, drag):
    """After a slide, nothing penetrates: the contact has moved along its normal as far as it had to."""
    inward = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    tangent = torch.tensor([-inward[1], inward[0]])
    assume(float(inward @ torch.tensor(point, dtype=torch.float64)) < 0)  # a contact lies before its object
    assume(abs(float(tangent @ torch.tensor(point, dtype=torch.float64))) < 3 * arm)
    way = push(point, inward.tolist(), depth, (drag * tangent).tolist(), arm)
    assert float(contact_motion(way, point) @ inward) == pytest.approx(depth, rel=1e-6)


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, drag=drags)
def test_the_force_stays_within_the_friction_cone_and_on_the_limit_surface(point, angle, depth, arm, drag):
    """Force and displacement are parallel here: the displacement may lean by the angle of friction at most, and turns
    by the force's moment about the centre over the arm squared."""
    inward = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    tangent = torch.tensor([-inward[1], inward[0]])
    way = push(point, inward.tolist(), depth, (drag * tangent).tolist(), arm)
    normal, side = float(way[:2] @ inward), float(way[:2] @ tangent)
    assert normal > 0
    assert abs(side) <= FRICTION * normal * (1 + 1e-6)
    moment = point[0] * float(way[1]) - point[1] * float(way[0])
    assert float(way[2]) == pytest.approx(moment / arm**2, rel=1e-5, abs=1e-9)


@given(point=st.tuples(offsets, offsets), depth=depths, arm=arms, drag=st.floats(-1, 1))
def test_within_the_cone_the_contact_sticks_to_what_pushes(point, depth, arm, drag):
    shift = (depth, drag * depth)
    way = push(point, (1.0, 0.0), depth, shift, arm)
    if abs(float(way[1])) < FRICTION * float(way[0]) * (1 - 1e-9):
        torch.testing.assert_close(contact_motion(way, point), torch.tensor(shift, dtype=torch.float64))


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, shift=st.tuples(drags, drags))
def test_in_a_mirror_it_slides_in_the_mirror(point, angle, depth, arm, shift):
    inward = (math.cos(angle), math.sin(angle))
    way = push(point, inward, depth, shift, arm)
    mirrored = push((point[0], -point[1]), (inward[0], -inward[1]), depth, (shift[0], -shift[1]), arm)
    torch.testing.assert_close(mirrored, way * torch.tensor([1.0, -1, -1], dtype=torch.float64), atol=1e-10, rtol=1e-6)


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, shift=st.tuples(drags, drags))
def test_turning_the_contact_turns_the_slide(point, angle, depth, arm, shift):
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)

    def turned(v):
        return (turn @ torch.tensor(v, dtype=torch.float64)).tolist()

    way = push(point, (1.0, 0.0), depth, shift, arm)
    other = push(turned(point), turned((1.0, 0.0)), depth, turned(shift), arm)
    torch.testing.assert_close(other[:2], turn @ way[:2], atol=1e-9, rtol=1e-6)
    torch.testing.assert_close(other[2], way[2], atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("depth", [0.0, -0.001])
def test_what_is_not_touched_does_not_slide(depth):
    way = push((-0.03, 0.01), (1.0, 0.0), depth, (0.005, 0.002), 0.03)
    assert torch.equal(way, torch.zeros(3, dtype=torch.float64))


def test_a_push_beside_the_centre_turns_away_from_it():
    assert push((-0.03, 0.02), (1.0, 0.0), 0.001, (0.001, 0.0), 0.03)[2] < 0
    assert push((-0.03, -0.02), (1.0, 0.0), 0.001, (0.001, 0.0), 0.03)[2] > 0


@given(radius=st.floats(0.01, 0.1), scale=st.floats(0.1, 10))
def test_the_lever_grows_with_the_outline(radius, scale):
    disc = radius * circle(64)[None]
    assert float(friction_arm(disc)) == pytest.approx(1.2 * radius, rel=1e-5)
    torch.testing.assert_close(friction_arm(scale * disc), scale * friction_arm(disc))
