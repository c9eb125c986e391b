import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.dynamics.graph import (
    EDGE_FEATURES,
    MOTION,
    NODE_FEATURES,
    SHIFT_M,
    TURN_RAD,
    build_graph,
    inputs,
    mirrored,
)
from osfcore.dynamics.motion import Motion, Sweep
from osfcore.dynamics.shapes import MAP_SIDE, ObjectShape, ShapeTable, octahedral_directions
from osfcore.geometry.poses import quaternion_exp
from tests.core.dynamics.scenes import CAN, crowd, moved_state, scene, start, sweep_of

SIZES = {"node": NODE_FEATURES, "edge": EDGE_FEATURES, "motion": MOTION}


def seen(table, shapes, state, velocity, linear=None, angular=None):
    number, motion = start(table, shapes, state)
    for name, value in (("linear", linear), ("angular", angular)):
        if value is not None:
            motion = motion._replace(**{name: torch.as_tensor(value, dtype=torch.float32)[None]})
    return inputs(table, build_graph(table, number, motion, sweep_of(motion, velocity)))


@pytest.fixture(scope="module")
def example(shapes, table):
    return seen(table, shapes, crowd(shapes), (0.3, 0.0))


def test_sizes_are_as_stated(example):
    assert example.nodes.shape == (3, NODE_FEATURES)
    assert example.edges.shape == (1 + 4, EDGE_FEATURES)
    assert example.receiver.shape == (5,)
    assert example.sender.shape == (4,)
    assert example.frame.shape == (3, 3, 3)
    assert example.quasistatic.shape == (3, 3)


def test_numbers_are_of_the_order_of_one(example):
    for part in (example.nodes, example.edges, example.quasistatic):
        assert torch.isfinite(part).all()
        assert part.abs().max() < 10


def test_frames_are_rotations_about_the_vertical(example):
    eye = torch.eye(3).expand(3, 3, 3)
    torch.testing.assert_close(example.frame @ example.frame.transpose(1, 2), eye, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(example.frame), torch.ones(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(example.frame[:, 2], eye[:, 2])


def test_a_pushed_object_looks_along_its_push(shapes, table):
    """Its frame's x is the contact's normal, and the guess moves it that way."""
    found = seen(table, shapes, scene(shapes, {CAN: (0.0, 0.055)}), (0.0, 0.3))
    torch.testing.assert_close(found.frame[0, 0], torch.tensor([0.0, 1.0, 0.0]), atol=0.1, rtol=0)
    assert found.quasistatic[0, 0] > 0
    assert found.edges[0, 0] == 1


@pytest.mark.slow
@given(angle=st.floats(-3.1, 3.1), x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1), speed=st.floats(0.1, 0.3))
def test_a_scene_turned_and_shifted_gives_the_same_numbers(shapes, table, angle, x, y, speed):
    state = crowd(shapes)
    moving = np.random.default_rng(0).normal(size=(4, 3)) * 0.003
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    here = seen(table, shapes, state, (speed, 0.0), moving)
    there = seen(table, shapes, moved_state(state, angle, (x, y)), (speed * c, speed * s), moving @ turn.T)
    assert torch.equal(here.receiver, there.receiver)
    assert torch.equal(here.sender, there.sender)
    torch.testing.assert_close(here.nodes, there.nodes, atol=1e-3, rtol=0)
    torch.testing.assert_close(here.edges, there.edges, atol=2e-3, rtol=0)
    torch.testing.assert_close(here.quasistatic, there.quasistatic, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        here.frame @ torch.as_tensor(turn.T, dtype=torch.float32), there.frame, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("kind", SIZES)
def test_mirrored_twice_is_the_original(kind):
    values = torch.randn(20, SIZES[kind], generator=torch.Generator().manual_seed(0))
    flags = torch.arange(20) % 3 > 0
    once = mirrored(values, flags, kind)
    assert torch.equal(once[~flags], values[~flags])
    assert not torch.equal(once[flags], values[flags])
    assert torch.equal(mirrored(once, flags, kind), values)
    everywhere = torch.ones(20, dtype=torch.bool)  # every number comes from one place
    assert torch.equal(mirrored(values, everywhere, kind).abs().sort(dim=1)[0], values.abs().sort(dim=1)[0])


def test_a_mirrored_answer_is_a_mirrored_motion():
    answer = torch.arange(1.0, 7.0)[None]
    expected = torch.tensor([[1.0, -2, 3, -4, 5, -6]])  # a polar vector, then an axial one
    assert torch.equal(mirrored(answer, torch.tensor([True]), "motion"), expected)


def brick(half) -> ObjectShape:
    """The same in a mirror, to the last bit."""
    half = np.asarray(half)
    corners = np.where(octahedral_directions(MAP_SIDE) >= 0, half, -half).astype(np.float32)
    return ObjectShape(half, np.zeros(3), float(np.linalg.norm(half)), corners)


def test_a_mirrored_scene_gives_mirrored_numbers():
    """The augmentation of training, against a scene that is really built in the mirror."""
    table = ShapeTable((brick((0.03, 0.02, 0.025)), brick((0.04, 0.05, 0.02))))
    rng = np.random.default_rng(1)
    polar, axial = torch.tensor([1.0, -1, 1]), torch.tensor([-1.0, 1, -1])
    turn = quaternion_exp(np.array([[0, 0, 0.4], [0, 0, 1.1], [0, 0, -0.3]]))
    here = Motion(
        torch.tensor([[[0.06, 0.01, 0.026], [0.15, -0.02, 0.022], [0.05, 0.08, 0.024]]]),
        torch.as_tensor(turn, dtype=torch.float32)[None],
        torch.as_tensor(rng.normal(size=(1, 3, 3)) * 0.003, dtype=torch.float32),
        torch.as_tensor(rng.normal(size=(1, 3, 3)) * 0.05, dtype=torch.float32),
        torch.tensor([[0.01, 0.004]]),
        torch.zeros(1, 3),
    )
    there = here._replace(
        centre=here.centre * polar,
        quaternion=here.quaternion * torch.tensor([1.0, -1, 1, -1]),
        linear=here.linear * polar,
        angular=here.angular * axial,
        pusher=here.pusher * polar[:2],
    )
    number = torch.tensor([[0, 1, 0]])
    original, reflected = (
        inputs(table, build_graph(table, number, m, Sweep(torch.tensor([[1.0, 0]]), torch.tensor([[0.012, 0.0]]))))
        for m in (here, there)
    )
    assert len(original.edges) > 3
    assert torch.equal(original.receiver, reflected.receiver)
    nodes, edges = (torch.ones(len(part), dtype=torch.bool) for part in (original.nodes, original.edges))
    torch.testing.assert_close(mirrored(original.nodes, nodes, "node"), reflected.nodes, atol=1e-4, rtol=0)
    torch.testing.assert_close(mirrored(original.edges, edges, "edge"), reflected.edges, atol=1e-3, rtol=0)
    slide = original.quasistatic * torch.tensor([1.0, -1, -1])
    torch.testing.assert_close(slide, reflected.quasistatic, atol=1e-4, rtol=0)


def test_motion_is_told_in_units(shapes, table):
    found = seen(table, shapes, scene(shapes, {CAN: (0.2, 0.0)}), (0.0, 0.0), [[0.004, 0.0, 0.0]])
    np.testing.assert_allclose(found.nodes[0, 35:41], [0.004 / SHIFT_M, 0, 0, 0, 0, 0], atol=1e-6)
    turning = seen(table, shapes, scene(shapes, {CAN: (0.2, 0.0)}), (0.0, 0.0), angular=[[0.0, 0.0, 0.05]])
    np.testing.assert_allclose(turning.nodes[0, 35:41], [0, 0, 0, 0, 0, 0.05 / TURN_RAD], atol=1e-6)


def test_an_object_alone_that_moves_has_no_edges(shapes, table):
    found = seen(table, shapes, scene(shapes, {CAN: (0.2, 0.0)}), (0.0, 0.0), [[0.004, 0.0, 0.0]])
    assert found.edges.shape == (0, EDGE_FEATURES)
    assert torch.equal(found.quasistatic, torch.zeros(1, 3))
