"""Graph: contact graph, features, propagation network, network weights, substep."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save

from osfcore.dynamics.graph import (
    EDGE_FEATURES,
    FORMAT,
    MOTION,
    NODE_FEATURES,
    SHIFT_M,
    TRAVEL_M,
    TURN_RAD,
    PropagationNetwork,
    adjacency,
    advance,
    build_graph,
    inputs,
    mirrored,
    network_bytes,
    read_network,
    shipped,
    unroll,
    write_network,
)
from osfcore.dynamics.motion import SLEEP_M, SLEEP_RAD, SUBSTEPS, Motion, Sweep, lowest_point, pusher_path
from osfcore.dynamics.shapes import MAP_SIDE, PAIR_REACH_M, TOUCH_M, ObjectShape, ShapeTable, octahedral_directions
from osfcore.errors import CannotWrite, CorruptFile
from osfcore.geometry.poses import quaternion_exp
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, moved_state, network, scene, start, sweep_of

# Contact graph


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


# Features


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


# Propagation network


def graph(nodes: int = 6, pushed: int = 2, pairs: int = 8, seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    receiver = torch.randint(nodes, (pushed + pairs,), generator=g)
    return (
        torch.randn(nodes, NODE_FEATURES, generator=g),
        torch.randn(pushed + pairs, EDGE_FEATURES, generator=g),
        receiver,
        torch.randint(nodes, (pairs,), generator=g),
    )


@pytest.mark.parametrize("seed", range(3))
def test_permuting_nodes_permutes_the_answer(seed):
    nodes, edges, receiver, sender = graph(seed=seed)
    order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
    place = order.argsort()  # where each node went
    answer = network()(nodes, edges, receiver, sender)
    torch.testing.assert_close(
        network()(nodes[order], edges, place[receiver], place[sender]), answer[order], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_edges_does_not_matter(seed):
    nodes, edges, receiver, sender = graph(seed=seed)
    g = torch.Generator().manual_seed(seed)
    pushed, pairs = torch.randperm(2, generator=g), torch.randperm(8, generator=g)
    order = torch.cat([pushed, 2 + pairs])
    answer = network()(nodes, edges, receiver, sender)
    other = network()(nodes, edges[order], receiver[order], sender[pairs])
    torch.testing.assert_close(other, answer, atol=1e-5, rtol=0)


def test_graphs_side_by_side_do_not_disturb_each_other():
    one, other = graph(seed=1), graph(nodes=3, pushed=1, pairs=2, seed=2)
    (nodes, edges, receiver, sender), (nodes2, edges2, receiver2, sender2) = one, other
    both = network()(
        torch.cat([nodes, nodes2]),
        torch.cat([edges[:2], edges2[:1], edges[2:], edges2[1:]]),
        torch.cat([receiver[:2], receiver2[:1] + 6, receiver[2:], receiver2[1:] + 6]),
        torch.cat([sender, sender2 + 6]),
    )
    torch.testing.assert_close(both, torch.cat([network()(*one), network()(*other)]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_effects_travel_one_edge_a_step(steps):
    """A chain 0 -> 1 -> 2 -> 3: what changes at 0 is felt as far as the steps go."""
    torch.manual_seed(0)
    net = PropagationNetwork(16, steps).eval()
    nodes, edges, _, _ = graph(4, 0, 3)
    sender, receiver = torch.tensor([0, 1, 2]), torch.tensor([1, 2, 3])
    other = nodes.clone()
    other[0] += 1
    with torch.inference_mode():
        changed = (net(other, edges, receiver, sender) - net(nodes, edges, receiver, sender)).abs().amax(dim=1)
    assert (changed > 0).tolist() == [k <= steps for k in range(4)]


@pytest.mark.parametrize(("nodes", "pushed", "pairs"), [(1, 1, 0), (1, 0, 0), (5, 0, 4), (0, 0, 0)])
def test_any_number_of_nodes_and_edges(nodes, pushed, pairs):
    g = graph(max(nodes, 1), pushed, pairs)
    answer = network()(g[0][:nodes], *g[1:])
    assert answer.shape == (nodes, MOTION)
    assert torch.isfinite(answer).all()


def test_every_parameter_learns():
    net = network()
    net(*graph()).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_the_same_seed_makes_the_same_network():
    first, second = network(3).state_dict(), network(3).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


# Substep


NETWORKS = {"first guess": {"silent": True}, "random": {}}


@pytest.fixture(params=NETWORKS)
def any_network(request):
    return network(**NETWORKS[request.param])


def after(net, table, shapes, state, velocity=(0.3, 0.0), mirror=None):
    number, motion = start(table, shapes, state)
    with torch.inference_mode():
        return motion, advance(net, table, number, motion, sweep_of(motion, velocity), mirror)


def test_what_nothing_can_touch_stays_bit_by_bit(shapes, table, any_network):
    state = crowd(shapes)
    before, then = after(any_network, table, shapes, state)
    box = state.names.index(BOX)
    assert torch.equal(then.centre[0, box], before.centre[0, box])
    assert torch.equal(then.quaternion[0, box], before.quaternion[0, box])
    assert not then.linear[0, box].any()
    assert not torch.equal(then.centre[0, 0], before.centre[0, 0])


def test_the_pusher_goes_its_way_whatever_it_meets(shapes, table, any_network):
    before, then = after(any_network, table, shapes, crowd(shapes))
    torch.testing.assert_close(then.pusher - before.pusher, torch.tensor([[0.015, 0.0]]))
    assert torch.equal(then.floor, before.floor)


def test_displacements_are_those_of_the_poses(shapes, table, any_network):
    before, then = after(any_network, table, shapes, crowd(shapes))
    torch.testing.assert_close(then.centre - before.centre, then.linear, atol=1e-7, rtol=0)
    angle = 2 * torch.acos((then.quaternion * before.quaternion).sum(dim=-1).double().clamp(max=1))
    torch.testing.assert_close(angle.float(), then.angular.norm(dim=-1), atol=2e-3, rtol=0)
    torch.testing.assert_close(then.quaternion.norm(dim=-1), torch.ones(1, 4))


def test_nothing_sinks(shapes, table):
    state = crowd(shapes)
    for seed in range(20):
        before, then = after(network(seed), table, shapes, state)
        number, _ = start(table, shapes, state)
        low = lowest_point(table, number[0], then.centre[0], then.quaternion[0])
        assert torch.all(low >= before.floor[0] - 1e-6)


def test_what_hardly_moves_rests(shapes, table):
    """A network whose answer is tiny: no object creeps."""
    net = network()
    with torch.no_grad():
        for part in net.decoder[-1].parameters():
            part *= 1e-4
    state = scene(shapes, {CAN: (0.06, 0.0, (0.004, 0.006, 0.4))}, pusher=(0.006, 0.0))
    before, then = after(net, table, shapes, state, velocity=(0.0, 0.0))
    assert torch.equal(then.centre, before.centre)
    assert torch.equal(then.quaternion, before.quaternion)
    assert not then.linear.any()
    assert SLEEP_M > 1e-5
    assert SLEEP_RAD > 1e-4


def test_the_first_guess_pushes_a_can_out_of_the_way(shapes, table):
    """Through its centre: it goes as deep as the pusher would go into it."""
    reach = float(shapes[CAN].half_extents[:2].mean()) + 0.015
    state = scene(shapes, {CAN: (reach + 0.005, 0.0)}, pusher=(0.0, 0.0))
    before, then = after(network(silent=True), table, shapes, state)
    np.testing.assert_allclose((then.centre - before.centre)[0, 0, :2], [0.010, 0], atol=1e-3)


def test_away_from_the_push_the_first_guess_does_nothing(shapes, table):
    reach = float(shapes[CAN].half_extents[:2].mean()) + 0.015
    state = scene(shapes, {CAN: (reach + 0.001, 0.0)})
    before, then = after(network(silent=True), table, shapes, state, velocity=(-0.3, 0.0))
    assert torch.equal(then.centre, before.centre)


def test_seen_in_a_mirror_the_first_guess_is_the_same(shapes, table):
    state = crowd(shapes)
    plain = after(network(silent=True), table, shapes, state)[1]
    mirrored = after(network(silent=True), table, shapes, state, mirror=torch.tensor([True]))[1]
    torch.testing.assert_close(mirrored.centre, plain.centre)
    other = after(network(), table, shapes, state, mirror=torch.tensor([True]))[1]
    unflagged = after(network(), table, shapes, state, mirror=torch.tensor([False]))[1]
    assert not torch.equal(other.centre, unflagged.centre)  # a network that learned nothing favours a side
    assert torch.equal(unflagged.centre, after(network(), table, shapes, state)[1].centre)


def test_gradients_reach_the_network_and_are_finite(shapes, table):
    net = network()
    number, motion = start(table, shapes, crowd(shapes))
    then = advance(net, table, number, motion, sweep_of(motion, (0.3, 0.0)))
    (then.centre.square().sum() + then.quaternion[..., 1].sum()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


VELOCITY = torch.tensor([[[0.3, 0.0]], [[0.25, 0.1]], [[-0.1, 0.2]]])


def run(net, table, shapes, velocity=VELOCITY):
    number, motion = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        return list(unroll(net, table, number, motion, velocity))


def test_every_substep_is_told_and_the_pusher_goes_its_path(shapes, table):
    motions = run(network(), table, shapes)
    assert len(motions) == SUBSTEPS * len(VELOCITY)
    path = pusher_path(np.zeros(2), VELOCITY[:, 0].numpy())
    found = torch.cat([m.pusher for m in motions]).numpy()
    np.testing.assert_allclose(found, path[1:], atol=1e-6)


def test_one_substep_is_one_advance(shapes, table):
    net = network()
    number, motion = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        expected = advance(net, table, number, motion, sweep_of(motion, (0.3, 0.0)))
    torch.testing.assert_close(run(net, table, shapes)[0], expected)


def test_a_longer_plan_begins_as_a_shorter_one(shapes, table):
    net = network()
    short, long = run(net, table, shapes, VELOCITY[:1]), run(net, table, shapes)
    for a, b in zip(short, long, strict=False):
        assert torch.equal(a.centre, b.centre)


def test_going_on_from_the_middle_is_going_on(shapes, table):
    net = network()
    whole = run(net, table, shapes)
    number, _ = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        rest = list(unroll(net, table, number, whole[SUBSTEPS - 1], VELOCITY[1:]))
    torch.testing.assert_close(rest[-1], whole[-1])


# Network weights


def repacked(meta=None, **tensors) -> bytes:
    """The file of a network with some tensors or words changed; None leaves one out."""
    content = load(network_bytes(network())) | tensors
    words = {"format": FORMAT, "hidden": "16", "steps": "3"} | (meta or {})
    kept = {name: value for name, value in content.items() if value is not None}
    return save(kept, {name: word for name, word in words.items() if word is not None})


@pytest.mark.parametrize(("hidden", "steps"), [(1, 1), (16, 3), (40, 5)])
def test_a_round_trip_loses_no_more_than_half_precision(tmp_path, hidden, steps):
    torch.manual_seed(0)
    original = PropagationNetwork(hidden, steps)
    write_network(tmp_path / "a.safetensors", original)
    back = read_network(tmp_path / "a.safetensors")
    assert (back.hidden, back.steps) == (hidden, steps)
    assert not back.training
    for name, value in original.state_dict().items():
        torch.testing.assert_close(back.state_dict()[name], value, rtol=2**-10, atol=1e-7)
    with torch.inference_mode():
        torch.testing.assert_close(back(*graph()), original(*graph()), rtol=0, atol=0.02)


def test_what_was_read_is_written_without_further_loss(tmp_path):
    write_network(tmp_path / "a.safetensors", network())
    once = read_network(tmp_path / "a.safetensors")
    again, first = load(network_bytes(once)), load((tmp_path / "a.safetensors").read_bytes())
    assert set(again) == set(first)
    assert all(torch.equal(again[name], first[name]) for name in first)


BIAS = "decoder.4.bias"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: b"", "no network"),
        (lambda: b"not a network at all", "no network"),
        (lambda: network_bytes(network())[:100], "no network"),
        (lambda: network_bytes(network())[:-1], "no network"),
        (lambda: repacked({"format": "pushes-0"}), f"not of the format {FORMAT}"),
        (lambda: repacked({"format": None}), f"not of the format {FORMAT}"),
        (lambda: save(load(network_bytes(network()))), f"not of the format {FORMAT}"),
        (lambda: repacked({"hidden": None}), "no network"),
        (lambda: repacked({"hidden": "many"}), "no network"),
        (lambda: repacked({"hidden": "0"}), "out of range"),
        (lambda: repacked({"hidden": "1000000"}), "out of range"),
        (lambda: repacked({"steps": "0"}), "out of range"),
        (lambda: repacked({"hidden": "17"}), "do not fit"),
        (lambda: repacked(**{BIAS: None}), "do not fit"),
        (lambda: repacked(**{BIAS: torch.zeros(7)}), "do not fit"),
        (lambda: repacked(more=torch.zeros(7)), "do not fit"),
        (lambda: repacked(**{BIAS: torch.full((6,), float("nan"))}), "not all finite"),
        (lambda: repacked(**{BIAS: torch.full((6,), float("inf"))}), "not all finite"),
    ],
)
def test_files_that_hold_no_network_are_told(tmp_path, data, words):
    path = tmp_path / "a.safetensors"
    path.write_bytes(data())
    with pytest.raises(CorruptFile, match=words) as caught:
        read_network(path)
    assert "a.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_places_that_cannot_be_read_or_written_are_told(tmp_path):
    with pytest.raises(CorruptFile):
        read_network(tmp_path / "nowhere.safetensors")
    with pytest.raises(CorruptFile):
        read_network(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_network(tmp_path / "file" / "a.safetensors", network())


def test_the_shipped_network_is_small_and_whole():
    assert shipped().stat().st_size < 2_500_000
    assert read_network(shipped()).hidden >= 16
    assert shipped("else").name == "else.safetensors"
