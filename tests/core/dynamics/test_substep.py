import numpy as np
import pytest
import torch

from osfcore.dynamics.graph import advance, unroll
from osfcore.dynamics.motion import SLEEP_M, SLEEP_RAD, SUBSTEPS, lowest_point, pusher_path
from tests.core.dynamics.scenes import BOX, CAN, crowd, network, scene, start, sweep_of

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
