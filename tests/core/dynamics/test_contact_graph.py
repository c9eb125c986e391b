import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.dynamics.graph import TRAVEL_M, adjacency, build_graph
from osfcore.dynamics.motion import Motion, Sweep
from osfcore.dynamics.shapes import PAIR_REACH_M, TOUCH_M
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, moved_state, scene, start, sweep_of


def graph_of(table, shapes, state, velocity=(0.3, 0.0), **changes):
    number, motion = start(table, shapes, state)
    motion = motion._replace(**changes)
    return build_graph(table, number, motion, sweep_of(motion, velocity))


def names_of(graph, state) -> set[str]:
    return {state.names[slot] for slot in graph.slot.tolist()}


def pairs_of(graph, state) -> list[tuple[str, str]]:
    slot = graph.slot.tolist()
    return [
        (state.names[slot[i]], state.names[slot[j]])
        for i, j in zip(graph.receiver.tolist(), graph.sender.tolist(), strict=True)
    ]


@given(seed=st.integers(0, 10**6), count=st.integers(1, 8), travel=st.floats(0, 0.2))
def test_adjacency_obeys_equation_8(seed, count, travel):
    rng = np.random.default_rng(seed)
    position = torch.as_tensor(rng.uniform(-0.2, 0.2, (3, count, 3)))
    extent = torch.as_tensor(rng.uniform(0.02, 0.1, (3, count)))
    linked = adjacency(position, extent, travel)
    for b, i, j in np.ndindex(3, count, count):
        near = np.linalg.norm(position[b, i] - position[b, j]) < extent[b, i] + extent[b, j] + travel
        assert bool(linked[b, i, j]) == (i != j and bool(near))
    assert torch.equal(linked, linked.transpose(1, 2))


def test_a_step_of_the_pusher_is_six_centimetres():
    assert pytest.approx(0.06) == TRAVEL_M


def test_what_the_push_can_reach_is_in_the_graph_and_nothing_else(shapes, table):
    state = crowd(shapes)
    graph = graph_of(table, shapes, state)
    assert names_of(graph, state) == {CAN, GELATIN, APPLE}  # a row of neighbours, the box far away
    assert graph.touched.sum() == 1
    assert set(pairs_of(graph, state)) == {(CAN, GELATIN), (GELATIN, CAN), (GELATIN, APPLE), (APPLE, GELATIN)}


def test_pushing_the_other_way_leaves_nothing_in_the_graph(shapes, table):
    state = scene(shapes, {CAN: (0.08, 0.0), GELATIN: (0.16, -0.02)})
    graph = graph_of(table, shapes, state, velocity=(-0.3, 0.0))
    assert len(graph.scene) == len(graph.receiver) == len(graph.pair.gap.distance) == 0


def test_neighbours_that_rest_are_in_no_graph_although_they_touch_each_other(shapes, table):
    state = scene(shapes, {CAN: (0.2, 0.0), GELATIN: (0.28, 0.0)})
    assert len(graph_of(table, shapes, state).scene) == 0


@pytest.mark.parametrize("part", ["linear", "angular"])
def test_what_moves_takes_part_with_its_neighbours(shapes, table, part):
    state = scene(shapes, {CAN: (0.2, 0.0), GELATIN: (0.28, 0.0), BOX: (-0.2, 0.0)})
    moving = torch.zeros(1, 3, 3)
    moving[0, 1, 2] = 0.01
    graph = graph_of(table, shapes, state, **{part: moving})
    assert names_of(graph, state) == {CAN, GELATIN}
    assert not graph.touched.any()


def test_pairs_come_in_both_orders_and_mirror_each_other(shapes, table):
    state = crowd(shapes)
    graph = graph_of(table, shapes, state)
    half = len(graph.receiver) // 2
    assert torch.equal(graph.receiver[:half], graph.sender[half:])
    assert torch.equal(graph.sender[:half], graph.receiver[half:])
    assert (graph.receiver != graph.sender).all()
    torch.testing.assert_close(graph.pair.gap.distance[:half], graph.pair.gap.distance[half:])
    torch.testing.assert_close(graph.pair.gap.normal[:half], -graph.pair.gap.normal[half:])
    torch.testing.assert_close(graph.pair.first_face[:half], graph.pair.second_face[half:])
    assert (graph.pair.gap.distance < PAIR_REACH_M).all()
    between = graph.pair.gap.point[half:] - graph.pair.gap.point[:half]
    torch.testing.assert_close(between, graph.pair.gap.distance[:half, None] * graph.pair.gap.normal[:half])


@pytest.mark.parametrize("away", [0.002, 0.006, 0.011, 0.02])
def test_a_can_is_touched_where_the_sweep_comes_close(shapes, table, away):
    """The pusher passes beside a can that is as good as round."""
    radius = float(shapes[CAN].half_extents[:2].mean())
    state = scene(shapes, {CAN: (0.0075, radius + PUSHER_RADIUS_M + away)})
    graph = graph_of(table, shapes, state)
    assert (len(graph.scene) == 1) == (away < TOUCH_M)
    if len(graph.scene):
        assert float(graph.pusher.halfway.distance) == pytest.approx(away, abs=1e-3)
        torch.testing.assert_close(graph.pusher.halfway.normal, torch.tensor([[0.0, -1.0]]), atol=0.05, rtol=0)


@pytest.mark.slow
@given(angle=st.floats(-3.1, 3.1), x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1))
def test_in_the_headings_frame_a_scene_looks_the_same_wherever_it_is(shapes, table, angle, x, y):
    state = crowd(shapes)
    speed = 0.25
    here = graph_of(table, shapes, state, velocity=(speed, 0.0))
    there = graph_of(table, shapes, moved_state(state, angle, (x, y)), (speed * np.cos(angle), speed * np.sin(angle)))
    for part in ("scene", "slot", "number", "touched", "receiver", "sender"):
        assert torch.equal(getattr(here, part), getattr(there, part))
    for part in ("rotation", "centre", "outline", "shift"):
        torch.testing.assert_close(getattr(here, part), getattr(there, part), atol=1e-5, rtol=0)
    for gap, same in zip((*here.pusher[:3], here.pair.gap), (*there.pusher[:3], there.pair.gap), strict=True):
        torch.testing.assert_close(gap.distance, same.distance, atol=1e-5, rtol=0)


def test_scenes_side_by_side_do_not_meet(shapes, table):
    state = crowd(shapes)
    number, motion = start(table, shapes, state)
    twice = motion._make(torch.cat([part, part]) for part in motion)
    graph = build_graph(table, number.expand(2, -1), twice, sweep_of(twice, (0.3, 0.0)))
    alone = build_graph(table, number, motion, sweep_of(motion, (0.3, 0.0)))
    assert len(graph.scene) == 2 * len(alone.scene)
    assert torch.equal(graph.scene[graph.receiver], graph.scene[graph.sender])
    assert len(graph.receiver) == 2 * len(alone.receiver)


def test_the_order_of_the_objects_does_not_matter(shapes, table):
    state = crowd(shapes)
    number, motion = start(table, shapes, state)
    order = [2, 0, 3, 1]
    other = motion._replace(
        **{name: getattr(motion, name)[:, order] for name in ("centre", "quaternion", "linear", "angular", "floor")}
    )
    a = build_graph(table, number, motion, sweep_of(motion, (0.3, 0.0)))
    b = build_graph(table, number[:, order], other, sweep_of(other, (0.3, 0.0)))
    place = {slot: row for row, slot in enumerate(a.slot.tolist())}
    rows = [place[order[slot]] for slot in b.slot.tolist()]
    assert torch.equal(a.centre[rows], b.centre)
    assert torch.equal(a.touched[rows], b.touched)
    assert {tuple(sorted((rows[i], rows[j]))) for i, j in zip(b.receiver.tolist(), b.sender.tolist(), strict=True)} == {
        tuple(sorted(pair)) for pair in zip(a.receiver.tolist(), a.sender.tolist(), strict=True)
    }


def test_scenes_in_which_nothing_happens_change_nothing_for_others(shapes, table):
    """Left, right, left: the middle scene has no objects in the graph, the others have the same."""
    state = scene(shapes, {CAN: (0.06, 0.0), GELATIN: (0.13, -0.02)})
    number, motion = start(table, shapes, state)
    three = Motion(*(part.expand(3, *part.shape[1:]) for part in motion))
    shift = torch.tensor([[0.015, 0.0], [-0.015, 0.0], [0.015, 0.0]])
    heading = shift / shift.norm(dim=1, keepdim=True)
    together = build_graph(table, number.expand(3, -1), three, Sweep(heading, shift))
    alone = build_graph(table, number, motion, Sweep(heading[:1], shift[:1]))
    count = len(alone.scene)
    assert count == 2
    assert together.scene.tolist() == [0] * count + [2] * count
    for half in (slice(0, count), slice(count, None)):
        torch.testing.assert_close(together.centre[half], alone.centre)
        assert torch.equal(together.slot[half], alone.slot)
