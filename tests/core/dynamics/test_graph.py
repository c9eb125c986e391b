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
    write_network,
)
from osfcore.dynamics.motion import Motion, Sweep
from osfcore.dynamics.shapes import MAP_SIDE, TOUCH_M, ObjectShape, ShapeTable, octahedral_directions
from osfcore.errors import CorruptFile
from osfcore.geometry.poses import quaternion_exp
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, network, scene, start, sweep_of
from tests.support.errors import about

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


def test_what_the_push_can_reach_is_in_the_graph_and_nothing_else(shapes, table):
    state = crowd(shapes)
    graph = graph_of(table, shapes, state)
    assert names_of(graph, state) == {CAN, GELATIN, APPLE}  # a row of neighbours, the box far away
    assert graph.touched.sum() == 1
    assert set(pairs_of(graph, state)) == {(CAN, GELATIN), (GELATIN, CAN), (GELATIN, APPLE), (APPLE, GELATIN)}
    state = scene(shapes, {CAN: (0.08, 0.0), GELATIN: (0.16, -0.02)})
    graph = graph_of(table, shapes, state, velocity=(-0.3, 0.0))
    assert len(graph.scene) == len(graph.receiver) == len(graph.pair.gap.distance) == 0
    neighbours = scene(shapes, {CAN: (0.2, 0.0), GELATIN: (0.28, 0.0)})  # they touch each other
    assert len(graph_of(table, shapes, neighbours).scene) == 0


@pytest.mark.parametrize("part", ["linear", "angular"])
def test_what_moves_takes_part_with_its_neighbours(shapes, table, part):
    state = scene(shapes, {CAN: (0.2, 0.0), GELATIN: (0.28, 0.0), BOX: (-0.2, 0.0)})
    moving = torch.zeros(1, 3, 3)
    moving[0, 1, 2] = 0.01
    graph = graph_of(table, shapes, state, **{part: moving})
    assert names_of(graph, state) == {CAN, GELATIN}
    assert not graph.touched.any()


@pytest.mark.slow
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


# Features


SIZES = {"node": NODE_FEATURES, "edge": EDGE_FEATURES, "motion": MOTION}


def seen(table, shapes, state, velocity, linear=None, angular=None):
    number, motion = start(table, shapes, state)
    for name, value in (("linear", linear), ("angular", angular)):
        if value is not None:
            motion = motion._replace(**{name: torch.as_tensor(value, dtype=torch.float32)[None]})
    return inputs(table, build_graph(table, number, motion, sweep_of(motion, velocity)))


def test_a_pushed_object_looks_along_its_push(shapes, table):
    """Its frame's x is the contact's normal, and the guess moves it that way."""
    found = seen(table, shapes, scene(shapes, {CAN: (0.0, 0.055)}), (0.0, 0.3))
    torch.testing.assert_close(found.frame[0, 0], torch.tensor([0.0, 1.0, 0.0]), atol=0.1, rtol=0)
    assert found.quasistatic[0, 0] > 0
    assert found.edges[0, 0] == 1


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


def test_motion_is_in_units_and_an_object_alone_has_no_edges(shapes, table):
    found = seen(table, shapes, scene(shapes, {CAN: (0.2, 0.0)}), (0.0, 0.0), [[0.004, 0.0, 0.0]])
    np.testing.assert_allclose(found.nodes[0, 35:41], [0.004 / SHIFT_M, 0, 0, 0, 0, 0], atol=1e-6)
    assert found.edges.shape == (0, EDGE_FEATURES)
    assert not found.quasistatic.any()
    turning = seen(table, shapes, scene(shapes, {CAN: (0.2, 0.0)}), (0.0, 0.0), angular=[[0.0, 0.0, 0.05]])
    np.testing.assert_allclose(turning.nodes[0, 35:41], [0, 0, 0, 0, 0, 0.05 / TURN_RAD], atol=1e-6)


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


@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_nodes_and_edges_does_not_matter(seed):
    nodes, edges, receiver, sender = graph(seed=seed)
    g = torch.Generator().manual_seed(seed)
    order, pushed, pairs = (torch.randperm(count, generator=g) for count in (6, 2, 8))
    place = order.argsort()  # where each node went
    edge = torch.cat([pushed, 2 + pairs])
    answer = network()(nodes, edges, receiver, sender)
    other = network()(nodes[order], edges[edge], place[receiver[edge]], place[sender[pairs]])
    torch.testing.assert_close(other, answer[order], atol=1e-5, rtol=0)


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


def test_any_number_of_nodes_and_edges():
    for nodes, pushed, pairs in ((1, 1, 0), (5, 0, 4), (0, 0, 0)):
        features, *edges = graph(max(nodes, 1), pushed, pairs)
        answer = network()(features[:nodes], *edges)
        assert answer.shape == (nodes, MOTION)
        assert torch.isfinite(answer).all()


# Substep


def after(net, table, shapes, state, velocity=(0.3, 0.0), mirror=None):
    number, motion = start(table, shapes, state)
    with torch.inference_mode():
        return motion, advance(net, table, number, motion, sweep_of(motion, velocity), mirror)


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


def test_seen_in_a_mirror_the_first_guess_is_the_same(shapes, table):
    state = crowd(shapes)
    plain = after(network(silent=True), table, shapes, state)[1]
    mirrored = after(network(silent=True), table, shapes, state, mirror=torch.tensor([True]))[1]
    torch.testing.assert_close(mirrored.centre, plain.centre)
    other = after(network(), table, shapes, state, mirror=torch.tensor([True]))[1]
    unflagged = after(network(), table, shapes, state, mirror=torch.tensor([False]))[1]
    assert not torch.equal(other.centre, unflagged.centre)  # a network that learned nothing favours a side
    assert torch.equal(unflagged.centre, after(network(), table, shapes, state)[1].centre)


# Network weights


def repacked(meta=None, **tensors) -> bytes:
    """The file of a network with some tensors or words changed; None leaves one out."""
    content = load(network_bytes(network())) | tensors
    words = {"format": FORMAT, "hidden": "16", "steps": "3"} | (meta or {})
    kept = {name: value for name, value in content.items() if value is not None}
    return save(kept, {name: word for name, word in words.items() if word is not None})


@pytest.mark.parametrize(("hidden", "steps"), [(1, 1), (16, 3)])
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


BIAS = "decoder.4.bias"


def test_files_that_hold_no_network_are_refused(tmp_path):
    path, whole = tmp_path / "a.safetensors", network_bytes(network())
    for reason, files in {
        "no network": (b"not a network at all", whole[:-1], repacked({"hidden": None}), repacked({"hidden": "many"})),
        FORMAT: (repacked({"format": "pushes-0"}), save(load(whole))),
        "out of range": (repacked({"hidden": "1000000"}), repacked({"steps": "0"})),
        "do not fit": (repacked({"hidden": "17"}), repacked(**{BIAS: None}), repacked(more=torch.zeros(7))),
        "finite": (repacked(**{BIAS: torch.full((6,), float("nan"))}),),
    }.items():
        for data in files:
            path.write_bytes(data)
            with pytest.raises(CorruptFile, check=about(reason)) as caught:
                read_network(path)
            assert caught.value.path == str(path)


def test_the_shipped_network_is_small_and_whole(tmp_path):
    assert shipped().stat().st_size < 2_500_000
    assert read_network(shipped()).hidden >= 16
    with pytest.raises(CorruptFile):
        read_network(tmp_path / "nowhere.safetensors")
